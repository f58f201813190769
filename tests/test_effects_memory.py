"""Hysteresis, heating, play, cogging and a second mode against scipy's integration of their equations."""

import dataclasses
import functools
import math
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import expm
from scipy.optimize import brentq
from sticking import Joint

import rotflex_jax.effects as fx
from rotflex_jax.errors import InputError
from rotflex_jax.joints import paper, single_inertia
from rotflex_jax.mechanism import Exponential, Mechanism, SmoothRK4, linearise, simulate, simulate_states
from rotflex_jax.mechanism.assembly import rest_state
from rotflex_jax.mechanism.simulate import _free_outputs
from rotflex_jax.mechanism.step import advance_memories
from rotflex_jax.runtime.xla import double_precision

J_HUB, J_ARM, K = 0.0021, 0.0059, 1.61
RESISTANCE, EMF = 2.6, 0.00767 * 70  # also the torque per current
exactly = functools.partial(solve_ivp, method="DOP853", rtol=1e-10, atol=1e-13)

# -- the laws as in their sources ---------------------------------------------------------------


def bouc_wen(z, w, width, beta):
    """Rate of the state."""
    return w / width * (1 - abs(z) * (beta * np.sign(w * z) + 1 - beta))


def lugre(z, w, rise, slow, presliding, level, damping):
    """Rate of the state (deflection over presliding), and the torque: sigma_0 bend + sigma_1(w) d bend/dt."""
    g = level * (1 + rise * np.exp(-((w / slow) ** 2)))
    sigma_0, sigma_1, bend = level / presliding, damping * np.exp(-((w / slow) ** 2)), presliding * z
    rate = w - sigma_0 * abs(w) / g * bend
    return rate / presliding, -(sigma_0 * bend + sigma_1 * rate)


def heating(warm, m, rate, time):
    """Rate of the relative rise of the resistance, and the torque that is lost."""
    return rate * m**2 / (1 + warm) - warm / time, m / (1 + warm) - m


LUGRE = {"level": 0.03, "rise": 0.5, "slow": 0.3, "presliding": 0.004, "damping": 0.01}
HEAT = {"rate": 400.0, "time": 0.3}  # fast and strong, so that it shows in a short run

# -- with a given motion ------------------------------------------------------------------------


def motion(t):
    """Speed [rad/s] with reversals of many sizes, and voltage [V]."""
    return 0.5 * np.sin(9 * t) + 0.3 * np.sin(31 * t + 1), 2 * np.cos(5 * t)


IMPOSED: dict[str, tuple[fx.Memory, Callable, float]] = {
    "bouc_wen": (fx.BoucWen("hub", 0.02, 0.02, 0.7), lambda z, w, v: bouc_wen(z, w, 0.02, 0.7), 1.0),
    "bouc_wen without loss": (
        fx.BoucWen("hub", 0.02, 0.02, 0.0),
        lambda z, w, v: w / 0.02 * (1 - abs(z)),
        1.0,
    ),
    "lugre": (fx.LuGre("hub", **LUGRE), lambda z, w, v: lugre(z, w, **LUGRE)[0], 1.0),
    "heating": (
        fx.Heating("hub", **HEAT),
        lambda z, w, v: heating(z, EMF / RESISTANCE * (v - EMF * w), **HEAT)[0],
        HEAT["rate"],
    ),
}


@pytest.mark.parametrize("name", IMPOSED)
def test_state_under_a_given_motion(name):
    effect, law, unit = IMPOSED[name]
    mechanism, span = single_inertia(0.002) + effect, 1.6
    t = np.linspace(0, span, 101)
    expected = exactly(lambda t, z: law(z, *motion(t)), (0, span), [0.0], t_eval=t, max_step=0.01).y[0]

    @functools.partial(jax.jit, static_argnums=1)
    def states(values, n):
        held, gates, h = mechanism.structure.with_values(values), jnp.ones(4), jnp.asarray(span / n)
        w, v = map(jnp.asarray, motion((np.arange(n) + 0.5) * span / n))

        def body(z, wv):
            return advance_memories(held, z, jnp.stack([jnp.zeros_like(wv[0]), wv[0]]), wv[1], gates, h), z

        last, z = jax.lax.scan(body, jnp.zeros(1), (w, v))
        return unit * jnp.concatenate([z, last[None]])[:: n // 100, 0]

    with double_precision():
        errors = [np.abs(states(jnp.asarray(mechanism.values), n) - expected).max() for n in (400, 1600)]
    assert np.abs(expected).max() > 0.3
    assert errors[0] < 0.02
    assert errors[1] < errors[0] / 10  # order two


@pytest.mark.parametrize("beta", [0.0, 0.1, 0.4, 0.9])
@pytest.mark.parametrize("width", [1e-2, 1e-3, 1e-4, 1e-6])
def test_a_bouc_wen_state_stays_within_its_limits_where_a_sample_is_many_widths(width, beta):
    """Reversals at 5 rad/s and 2 ms; one step of the linearised law would reach values up to 1e34."""
    mechanism, Ts = single_inertia(0.002) + fx.BoucWen("hub", 0.02, width, beta), 0.002
    gates, v = jnp.ones(4), jnp.zeros(())
    for dtype in (jnp.float32, jnp.float64):
        with double_precision():
            held = mechanism.structure.with_values(jnp.asarray(mechanism.values, dtype))
            on, volt, h = gates.astype(dtype), v.astype(dtype), jnp.asarray(Ts, dtype)

            def after(z, speed, held=held, on=on, volt=volt, h=h, dtype=dtype):
                x = jnp.asarray([0.0, speed], dtype)
                return advance_memories(held, z, x, volt, on, h)

            z = jnp.asarray([-0.9], dtype)
            for speed in (5.0, 5.0, 5.0, -5.0, -5.0, -5.0):
                z = after(z, speed)
                assert np.abs(z).max() <= 1.0
                if width <= 1e-3 and beta > 0.0:  # the motion of a sample is ten widths or more
                    np.testing.assert_allclose(z, np.sign(speed), atol=1e-3 if beta > 0.1 else 0.3)
            slope = jax.jvp(lambda z: after(z, 5.0), (jnp.asarray([-0.9], dtype),), (jnp.ones(1, dtype),))[1]
            assert np.isfinite(slope).all()


def test_a_bouc_wen_state_that_starts_beyond_its_limits_returns_at_once():
    mechanism = single_inertia(0.002) + fx.BoucWen("hub", 0.02, 0.01, 0.1)
    for start in (-9.0, 9.0):
        s = simulate_states(mechanism, np.sin(np.arange(400) / 20), 0.002, np.array([0.0, 0.5, start]))
        assert np.abs(s[1:, 2]).max() <= 1.0 and np.isfinite(s).all()


def test_lugre_slides_at_its_level_and_bends_before():
    friction = fx.LuGre("hub", **LUGRE)
    with double_precision():
        for w in (-2.0, -0.3, -0.01, 0.05, 0.3, 5.0):
            span = (0, 40 * LUGRE["presliding"] / abs(w))
            z = exactly(lambda _, z, w=w: np.asarray(friction.flow(z, 0.0, w, 0.0)), span, [0.0]).y[0, -1]
            level = 0.03 * (1 + 0.5 * math.exp(-((w / 0.3) ** 2)))
            assert float(friction.force(z, 0.0, w, 0.0)) == pytest.approx(-math.copysign(level, w), rel=1e-8)


def test_small_swings_on_bristles():
    """J x'' = -sigma_0 x - sigma_1 x' for a motion far smaller than the presliding."""
    J, sigma_0, sigma_1 = 0.002, 0.03 / 0.004, 0.01
    axis = single_inertia(J, motor=fx.Motor(torque_constant=0.0)) + fx.LuGre("hub", **LUGRE)
    Ts, start = 0.001, 1e-6
    s = simulate_states(axis, np.zeros(400), Ts, np.array([0.0, start]), Exponential(substeps=16))
    decay = sigma_1 / (2 * J)
    swing = np.sqrt(sigma_0 / J - decay**2)
    t = np.arange(400) * Ts
    expected = start / swing * np.exp(-decay * t) * np.sin(swing * t)
    np.testing.assert_allclose(s[:, 0], expected, rtol=0, atol=3e-5 * start / swing)


def given_by_bristles(friction, w):
    """Power to the port plus power stored [W] at a deflection of 2 g, where this sum is largest."""
    z = 2 * (1 + friction.rise * math.exp(-((w / friction.slow) ** 2)))
    rate, torque = (float(f(z, 0.0, w, 0.0)) for f in (friction.flow, friction.force))
    return torque * w + friction.level * friction.presliding * z * rate


def test_lugre_gives_energy_only_beyond_its_known_speed():
    """The bound sigma_1(w) |w| <= 4 level g is sharp at a deflection of 2 g."""
    friction = fx.LuGre("hub", level=0.03, rise=2.0, slow=10.0, presliding=0.004, damping=0.1)

    def beyond(w):
        slow = math.exp(-((w / 10.0) ** 2))
        return 0.1 * slow * w - 4 * 0.03 * (1 + 2.0 * slow)

    bound = brentq(beyond, 0.1, 10 / math.sqrt(2))
    assert given_by_bristles(friction, 0.999 * bound) < 0 < given_by_bristles(friction, 1.001 * bound)


def test_lugre_with_little_damping_gives_no_energy_at_any_speed():
    friction = fx.LuGre("hub", level=0.03, rise=0.0, slow=0.3, presliding=0.004, damping=9 * 0.03 / 0.3)
    speeds = np.geomspace(1e-3, 100.0, 300)
    assert max(given_by_bristles(friction, w) for w in speeds) < 0
    more = dataclasses.replace(friction, damping=10 * 0.03 / 0.3)
    assert max(given_by_bristles(more, w) for w in speeds) > 0


def test_a_motor_that_stands_warms_to_a_known_level():
    """In equilibrium, rate z^2 + z = m^2 time, with the torque m of the cold motor: a closed form."""
    m, rate, time = EMF / RESISTANCE * 2.0, 3.0, 0.4
    lone = single_inertia(0.5, motor=fx.Motor(back_emf=0.0), damping=0.3) + fx.Heating("hub", rate, time)
    s = simulate_states(lone, np.full(1500, 2.0), 0.02)
    warm = (math.sqrt(1 + 4 * rate * m**2 * time) - 1) / 2
    assert warm > 0.1
    assert rate * s[-1, 2] == pytest.approx(warm, rel=1e-6)
    assert s[-1, 1] == pytest.approx(m / (1 + warm) / 0.3, rel=1e-6)


@pytest.mark.parametrize("port", ["joint", "arm"])
def test_heat_needs_a_motor(port):
    with pytest.raises(InputError, match=f"Heating was put at '{port}', but it needs a port with a motor"):
        paper() + fx.Heating(port)
    with pytest.raises(InputError, match="needs a port with a motor"):
        paper().without("motor", "hub") + fx.Heating("hub")


# -- in the joint -------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class Case:
    """Effects, and their equations written out: torques on (theta, alpha), and rates of their states.

    `torques(q, w, z, m)` is given the torque `m` of the cold motor at a settled current, like the effects;
    `z` is in the order of `effects`.
    """

    effects: tuple[fx.Effect, ...]
    torques: Callable
    states: int = 0
    inductance: float | None = None

    @property
    def mechanism(self) -> Mechanism:
        return functools.reduce(lambda m, e: m + e, self.effects, paper(inductance=self.inductance))

    def reference(self, u, Ts, hold, settled=True):
        """States (N, 5 + states) at the samples of a voltage that changes every `hold` samples."""
        joint, L = Joint(), self.inductance
        inverse, x, out = np.linalg.inv(joint.mass), np.zeros(5 + self.states), []

        def flow(_, s, v):
            q, w, z = s[:2], s[2:4], s[5:]
            at_once = (v - EMF * w[0]) / RESISTANCE
            i, di = (at_once, 0.0) if L is None else (s[4], (at_once - s[4]) * RESISTANCE / L)
            torque, rates = self.torques(q, w, z, EMF * (at_once if settled else i))
            return np.concatenate([w, inverse @ (np.array([EMF * i, -K * q[1]]) + torque), [di], rates])

        for k in range(0, len(u), hold):
            t = np.arange(hold + 1) * Ts
            run = exactly(flow, (0, t[-1]), x, t_eval=t, max_step=1.2 * Ts, args=(u[k],))
            x = run.y[:, -1]
            out.append(run.y[:, :-1].T)
        return np.concatenate(out)


def at_hub(torque):
    return np.array([torque, 0.0])


def at_joint(torque):
    return np.array([0.0, torque])


def heated(q, w, z, m):
    rate, lost = heating(z[0], m, **HEAT)
    return at_hub(lost), [rate]


def saturating(q, w, z, m):
    return at_hub(m / (1 + 4.0 * abs(m)) - m), []


def hot_and_saturating(q, w, z, m):
    rate, lost = heating(z[0], m, **HEAT)
    return at_hub((m + lost) / (1 + 4.0 * abs(m + lost)) - m), [rate]


def friction(q, w, z, m):
    hub, tau = lugre(z[0], w[0], **LUGRE)
    return at_hub(tau) - at_joint(0.02 * z[1]), [hub, bouc_wen(z[1], w[1], 0.02, 0.5)]


def ripple(q, w, z, m):
    return at_hub(-0.02 * np.sin(8 * q[0]) + 0.01 * np.cos(8 * q[0])), []


def loose(q, w, z, m):
    return at_joint(K * np.clip(q[1], -0.006, 0.006)), []


SECOND = (8e-4, 14.0, 0.03)


def third_mass(q, w, z, m):
    """The part of the second mode, with absolute angle `z[0]` and speed `z[1]`."""
    inertia, frequency, damping = SECOND
    W = 2 * np.pi * frequency
    accelerated = -(W**2) * (z[0] - q.sum()) - 2 * damping * W * (z[1] - w.sum())
    return np.full(2, -inertia * accelerated), [z[1], accelerated]


def everything(q, w, z, m):
    laws = ((third_mass, z[:2]), (heated, z[2:3]), (friction, z[3:]), (ripple, z), (loose, z))
    said = [law(q, w, part, m) for law, part in laws]
    return sum(torque for torque, _ in said), [rate for _, rates in said for rate in rates]


_HEATING = fx.Heating("hub", **HEAT)
_FRICTION = (fx.LuGre("hub", **LUGRE), fx.BoucWen("joint", 0.02, 0.02, 0.5))
_RIPPLE = fx.Cogging("hub", sine=0.02, cosine=-0.01, periods=8.0)
_LOOSE = fx.JointPlay("joint", play=0.006, stiffness=K)
_MODE = fx.SecondMode("arm", *SECOND)
CASES = {
    "heating": Case((_HEATING,), heated, 1),
    "heating with a current": Case((_HEATING,), heated, 1, inductance=5e-3),
    "saturating motor": Case((fx.TorqueSaturation("hub", loss=4.0),), saturating),
    "heating and saturating motor": Case(
        (_HEATING, fx.TorqueSaturation("hub", loss=4.0)), hot_and_saturating, 1
    ),
    "lugre and bouc_wen": Case(_FRICTION, friction, 2),
    "cogging": Case((_RIPPLE,), ripple),
    "joint_play": Case((_LOOSE,), loose),
    "everything": Case((_MODE, _HEATING, *_FRICTION, _RIPPLE, _LOOSE), everything, 5, inductance=5e-3),
}
Ts, N, HOLD, FINE = 0.004, 60, 5, 8


def voltage() -> np.ndarray:
    return np.repeat(np.random.default_rng(1).normal(size=N // HOLD), HOLD)


def outputs(mechanism: Mechanism, fine: int) -> np.ndarray:
    """Outputs with `fine` steps a sample, always by the same program of N * FINE steps."""
    u = np.resize(np.repeat(voltage(), fine), N * FINE)
    return simulate(mechanism, u, Ts / fine)[: N * fine : fine]


@pytest.mark.parametrize("name", CASES)
def test_joint_converges_to_its_written_equations(name):
    case = CASES[name]
    expected = case.reference(voltage(), Ts, HOLD)[:, :2]
    bare = outputs(paper(inductance=case.inductance), 1)
    assert np.abs(expected - bare).max() > 5e-3
    errors = [np.abs(outputs(case.mechanism, fine) - expected).max() for fine in (1, FINE)]
    assert errors[0] < (2e-4 if name != "everything" else 1e-3)
    assert errors[1] < errors[0] / 40  # order two


def test_heat_of_a_true_current():
    """The voltage changes every sample; the time constant of the current is about 1/58 of a sample."""
    case = dataclasses.replace(CASES["heating with a current"], inductance=0.18e-3)
    u = np.random.default_rng(3).normal(size=N)
    truth = case.reference(u, Ts, 1, settled=False)
    found = simulate_states(case.mechanism, u, Ts)
    warm = HEAT["rate"] * found[:, 5]
    assert truth[:, 5].max() > 0.3
    np.testing.assert_allclose(warm, truth[:, 5], rtol=0, atol=0.05 * truth[:, 5].max())
    np.testing.assert_allclose(found[:, :2], truth[:, :2], rtol=0, atol=0.02 * np.abs(truth[:, :2]).max())


def test_both_steppers_agree_on_everything():
    mechanism, u = CASES["everything"].mechanism, np.repeat(voltage(), FINE)
    mine = simulate(mechanism, u, Ts / FINE)
    classical = simulate(mechanism, u, Ts / FINE, solver=SmoothRK4(substeps=4))
    np.testing.assert_allclose(mine, classical, rtol=0, atol=2e-5)


# -- second mode --------------------------------------------------------------------------------


def three_masses(inertia, frequency, damping, v_damping=EMF**2 / RESISTANCE):
    """Hub, arm and part by their absolute angles; the motor damps the hub."""
    k, W = inertia * (2 * np.pi * frequency) ** 2, 2 * np.pi * frequency
    c = 2 * damping * W * inertia
    M = np.diag([J_HUB, J_ARM, inertia])
    stiff = np.array([[K, -K, 0], [-K, K + k, -k], [0, -k, k]])
    loss = np.array([[v_damping, 0, 0], [0, c, -c], [0, -c, c]])
    inverse = np.linalg.inv(M)
    A = np.block([[np.zeros((3, 3)), np.eye(3)], [-inverse @ stiff, -inverse @ loss]])
    return A, np.concatenate([np.zeros(3), inverse @ [EMF / RESISTANCE, 0, 0]])


def by_size(roots):
    return sorted(roots, key=lambda c: (round(c.imag, 6), c.real))


def test_three_masses_have_their_eigenvalues():
    A, _ = three_masses(*SECOND)
    found = np.linalg.eigvals(linearise(paper() + _MODE).A)
    # One system has the angle of the part from its port, the other its absolute angle; both have six states.
    np.testing.assert_allclose(by_size(found), by_size(np.linalg.eigvals(A)), rtol=1e-9, atol=1e-8)


def test_three_masses_move_as_written():
    A, B = three_masses(*SECOND)
    big = np.zeros((7, 7))
    big[:6, :6], big[:6, 6] = A, B
    step, x, expected = expm(big * Ts), np.zeros(6), []
    for v in voltage():
        expected.append([x[0], x[1] - x[0]])
        x = (step @ np.append(x, v))[:6]
    np.testing.assert_allclose(simulate(paper() + _MODE, voltage(), Ts), expected, rtol=0, atol=1e-11)


@pytest.mark.parametrize("port", ["hub", "arm", "joint"])
def test_the_part_rings_at_its_own_frequency_on_a_port_that_is_held(port):
    part = fx.SecondMode(port, *SECOND)
    own = np.array(part.stamp().own)
    W, damping = 2 * np.pi * SECOND[1], SECOND[2]
    expected = -damping * W + 1j * W * math.sqrt(1 - damping**2)
    np.testing.assert_allclose(by_size(np.linalg.eigvals(own))[1], expected, rtol=1e-12)
    # The same for a port that is too heavy to move.
    heavy = paper(hub_inertia=1e9, arm_inertia=1e9) + part
    roots = np.linalg.eigvals(linearise(heavy).A)
    assert np.abs(roots - expected).min() < 1e-5 * W


def test_a_slow_push_moves_the_part_with_its_port():
    """Far below its frequency the part acts as additional inertia of its port."""
    inertia = SECOND[0]
    with_part, heavier = paper() + fx.SecondMode("arm", inertia, 2e3, 0.5), paper(arm_inertia=J_ARM + inertia)
    np.testing.assert_allclose(
        simulate(with_part, voltage(), Ts), simulate(heavier, voltage(), Ts), rtol=0, atol=2e-5
    )


# -- properties of every one of them ------------------------------------------------------------

NEW = [_MODE, _HEATING, *_FRICTION, _RIPPLE, _LOOSE]
NEW += [fx.Delay(time=0.0051), fx.Lag(time=0.006), fx.SensorCubic("alpha", 6.0), fx.Rectifier("alpha", 0.15)]


@pytest.mark.parametrize("effect", NEW, ids=lambda e: e.name)
def test_off_it_is_absent_and_other_values_need_no_new_program(effect):
    joint, u = paper() + effect, voltage()
    bare, on = simulate(paper(), u, Ts), simulate(joint, u, Ts)
    programs = _free_outputs.programs_made
    moved = {n: v * 1.07 + 1e-4 for n, v in zip(joint.parameter_names, joint.values, strict=True)}
    other = simulate(joint.with_values(moved), 0.5 * u, 1.3 * Ts, x0=np.array([0.1, 0.01, 0.0, 0.0]))
    assert np.abs(on - bare).max() > 1e-4 and np.isfinite(other).all()
    numbers = (rest_state(joint.structure, u.dtype), u, np.asarray(Ts, u.dtype))
    gates = np.ones((2, len(joint.effects)))
    gates[:, -1] = 0.0, 0.5
    with double_precision():
        run = functools.partial(_free_outputs, joint.structure, Exponential(), joint.values)
        off, half = (np.asarray(run(each, *numbers)) for each in gates)
    assert _free_outputs.programs_made == programs
    np.testing.assert_allclose(off, bare, rtol=0, atol=1e-13)
    assert np.abs(half - bare).max() > 1e-5


def test_single_precision_stays_single():
    joint, u = functools.reduce(lambda m, e: m + e, NEW, paper()), voltage()
    single, double = (simulate(joint, u.astype(kind), Ts) for kind in (np.float32, np.float64))
    assert (single.dtype, double.dtype) == (np.float32, np.float64)
    np.testing.assert_allclose(single, double, atol=1e-4)


def joined_shapes(jaxpr):
    """Shapes of concatenated and stacked arrays, also in inner programs."""
    for e in jaxpr.eqns:
        if "jaxpr" in e.params:
            yield from joined_shapes(e.params["jaxpr"].jaxpr)
        if e.primitive.name in ("concatenate", "stack"):
            yield e.outvars[0].aval.shape


@pytest.mark.parametrize("effects", [(fx.LuGre("hub"),), (fx.BoucWen("joint"), fx.Dahl("hub"))])
def test_the_step_has_one_form_for_all_states(effects):
    """A concatenation is a branch in the compiled loop over states and directions: four times slower."""
    mechanism, solver, D = functools.reduce(lambda m, e: m + e, effects, paper()), Exponential(), 8
    structure, n = mechanism.structure, len(rest_state(mechanism.structure, float))
    c = solver.prepare(
        structure, *map(jnp.asarray, (mechanism.values, np.ones(len(mechanism.effects)), 0.002))
    )
    traced = jax.make_jaxpr(lambda x: solver.advance(structure, x, jnp.ones(D), c))(jnp.ones((n, D)))
    joined = list(joined_shapes(traced.jaxpr))
    assert joined and (n, D) not in joined
