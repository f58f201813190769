"""The simulator against values of the paper's joint, closed forms, symmetries and an exact integration.

`paper_numbers.json` holds reference values of the joint with the paper's parameters to 16 digits;
two independent integrators agree on them. `sticking.py` is the exact integration.
"""

import functools
import itertools
import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiler_options import ROUGH
from scipy.integrate import solve_ivp
from scipy.linalg import expm
from sticking import ARM, HUB, JOINT, Joint, asymmetric, coulomb, stribeck

import rotflex_jax.effects as fx
from rotflex_jax.errors import InputError
from rotflex_jax.joints import paper
from rotflex_jax.mechanism import Exponential, SmoothRK4, free_run, linearise, simulate, simulate_states
from rotflex_jax.mechanism.assembly import rest_state
from rotflex_jax.models.model import Model
from rotflex_jax.runtime.xla import double_precision

NUMBERS = json.loads((Path(__file__).parent / "paper_numbers.json").read_text(encoding="utf-8"))
J_HUB, J_ARM, K = 0.0021, 0.0059, 1.61
DRIVE = 0.00767 * 70 / 2.6  # torque per volt
LOCKED = np.sqrt(K / J_ARM)  # 16.519 rad/s, the arm on a hub that does not move


def noise(N: int, seed: int = 1, hold: int = 5, size: float = 1.0) -> np.ndarray:
    """A random piecewise constant voltage [V]."""
    rng = np.random.default_rng(seed)
    return size * np.repeat(rng.normal(size=N // hold + 1), hold)[:N]


def with_all(joint, *effects):
    for effect in effects:
        joint = joint + effect
    return joint


# -- the linear joint ---------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("key", "given"),
    [
        ("eig4", {}),
        ("eig5_with_Lm", {"inductance": 0.18e-3}),
        ("eig4_eta0.621", {"efficiency": 0.621}),
        ("eig4_eta0.621_Beq0.004", {"efficiency": 0.621, "hub_damping": 0.004}),
        ("eig4_eta0.621_Beq0.015", {"efficiency": 0.621, "hub_damping": 0.015}),
    ],
)
def test_eigenvalues(key, given):
    order = lambda z: sorted(z, key=lambda c: (c.real, c.imag))  # noqa: E731
    expected = order([complex(*pair) for pair in NUMBERS[key]])
    found = order(np.linalg.eigvals(linearise(paper(**given)).A))
    np.testing.assert_allclose(found, expected, rtol=1e-10, atol=1e-10)


def test_equations_of_motion():
    space = linearise(paper())
    np.testing.assert_allclose(space.A, NUMBERS["A4"], rtol=1e-13, atol=1e-12)
    np.testing.assert_allclose(space.B, NUMBERS["B4"], rtol=1e-13, atol=1e-12)
    np.testing.assert_array_equal(space.C, [[1, 0, 0, 0], [0, 1, 0, 0]])


@pytest.mark.parametrize("Ts", [0.001, 0.01, 0.02, 0.05, 0.1])
def test_zero_order_hold(Ts):
    """Matrices of the discrete-time system, from the simulator column by column, equal tabulated ones."""
    step = functools.partial(simulate_states, paper(), Ts=Ts)
    Ad = np.stack([step(np.zeros(2), x0=column)[1] for column in np.eye(4)], axis=1)
    Bd = step(np.ones(2))[1]
    np.testing.assert_allclose(Ad, NUMBERS[f"zoh_Ad_{Ts}"], rtol=0, atol=1e-10)
    np.testing.assert_allclose(Bd, NUMBERS[f"zoh_Bd_{Ts}"], rtol=0, atol=1e-10)
    for mine, table in zip(linearise(paper()).discretise(Ts), (Ad, Bd), strict=True):
        np.testing.assert_allclose(mine, table, rtol=0, atol=1e-12)
    impulse = simulate(paper(), np.eye(12)[0], Ts)[:, 1]
    np.testing.assert_allclose(impulse, NUMBERS[f"impulse_alpha_{Ts}"], rtol=0, atol=1e-10)


@pytest.mark.parametrize("Ts", [0.05, 0.1])
def test_step_samples(Ts):
    expected = np.array(NUMBERS[f"step1V_theta_alpha_{Ts}"])
    y = simulate(paper(), np.ones(len(expected)), Ts)
    np.testing.assert_allclose(y, expected, rtol=0, atol=1e-9)
    assert y[1, 0] > 0 > y[1, 1]  # the hub leads, the arm lags


def test_motor_current_is_exact_at_any_step():
    """With an electrical pole at -14391 1/s, steps of 10 ms are exact; reference: a matrix exponential."""
    joint = paper(inductance=0.18e-3)
    u, Ts = noise(100), 0.01
    space = linearise(joint)
    big = np.zeros((6, 6))
    big[:5, :5], big[:5, 5] = space.A, space.B
    big = expm(big * Ts)
    x, expected = np.zeros(5), []
    for v in u:
        expected.append(x)
        x = big[:5, :5] @ x + big[:5, 5] * v
    np.testing.assert_allclose(simulate_states(joint, u, Ts), expected, rtol=0, atol=1e-10)


def test_constant_voltage_runs_at_the_speed_of_the_back_emf():
    states = simulate_states(paper(), np.full(300, 2.0), 0.01)
    np.testing.assert_allclose(states[-1, 2], 2 / (0.00767 * 70), rtol=1e-11)
    np.testing.assert_allclose(states[-1, [1, 3]], 0, atol=1e-10)


def test_single_precision_stays_single_and_close():
    u = noise(300)
    single = simulate(paper() + fx.Coulomb("hub", 0.03), u.astype(np.float32), 0.004)
    double = simulate(paper() + fx.Coulomb("hub", 0.03), u, 0.004)
    assert (single.dtype, double.dtype) == (np.float32, np.float64)
    np.testing.assert_allclose(single, double, atol=1e-4)


def test_a_delay_within_the_sample_is_that_of_the_switched_linear_system():
    """The voltage switches within each sample; reference: matrix exponentials of both parts of it."""
    joint, Ts, late, N = paper(hub_damping=0.01), 0.004, 0.0013, 200
    space, u = linearise(joint), np.sign(np.random.default_rng(2).standard_normal(N))
    A = np.pad(np.column_stack([space.A, space.B]), ((0, 1), (0, 0)))
    before, after = expm(A * late), expm(A * (Ts - late))
    x, exact = np.zeros(5), []
    for k in range(N):
        exact.append(space.C @ x[:4])
        x[4] = u[max(k - 1, 0)]
        x = before @ x
        x[4] = u[k]
        x = after @ x
    error = {}
    for solver in (Exponential(), Exponential(between="switched")):
        y = simulate(joint + fx.Delay(time=late), u, Ts, solver=solver)
        error[solver.between] = np.max(np.abs(y - np.array(exact)))
    assert error["held"] > 1e-4 and error["switched"] < 0.05 * error["held"]
    # Where the voltage is constant over each sample, nothing changes.
    for solver in (Exponential(), Exponential(between="switched")):
        moved = simulate(joint + fx.Delay(time=2 * Ts), u, Ts, solver=solver)
        plain = simulate(joint, np.concatenate([[u[0]] * 2, u[:-2]]), Ts)
        np.testing.assert_allclose(moved, plain, rtol=0, atol=1e-12)
    with pytest.raises(InputError, match="substeps"):
        Exponential(between="switched", substeps=2)


def test_a_switched_voltage_is_refused_beside_what_sticks():
    """It is refused only if the gates of both effects are on."""
    solver, late = Exponential(between="switched"), paper() + fx.Delay(time=1e-3)
    both = late + fx.Coulomb("hub")
    with pytest.raises(InputError, match="input delay and Coulomb friction"):
        Model(both, solver)
    assert Model(both, solver, (*[1.0] * (len(both.effects) - 1), 0.0)).gates
    assert Model(paper() + fx.Coulomb("hub"), solver)


# -- symmetries ---------------------------------------------------------------------------------


def test_odd_symmetry_is_exact():
    """With symmetric friction, dead zone and springs, the input -u gives exactly the output -y."""
    joint = with_all(
        paper(),
        fx.Coulomb("hub", 0.03),
        fx.Stribeck("joint", 0.003, 0.002, 0.3),
        fx.QuadraticDrag("arm", 0.01),
        fx.CubicSpring("joint", 20.0),
        fx.Dahl("arm", 0.01, 0.01),
        fx.DeadZone(positive=0.1, negative=0.1),
        fx.Saturation(limit=1.5),
    )
    u = noise(500)
    assert np.abs(simulate(joint, u, 0.004) + simulate(joint, -u, 0.004)).max() == 0.0
    uneven = joint + fx.QuadraticSpring("joint", 1.0)
    assert np.abs(simulate(uneven, u, 0.004) + simulate(uneven, -u, 0.004)).max() > 1e-4


def test_asymmetric_hub_friction_is_a_voltage_offset():
    u, shift = noise(500), (0.045 - 0.015) / 2
    uneven = simulate(paper() + fx.CoulombAsymmetric("hub", 0.045, 0.015), u, 0.004)
    even = simulate(paper() + fx.Coulomb("hub", 0.03), u - shift / DRIVE, 0.004)
    np.testing.assert_allclose(uneven, even, rtol=0, atol=1e-14)
    offset = fx.VoltageOffset(offset=-shift / DRIVE)
    offered = simulate(paper() + fx.Coulomb("hub", 0.03) + offset, u, 0.004)
    np.testing.assert_allclose(uneven, offered, rtol=0, atol=1e-14)


def test_asymmetric_joint_friction_is_a_shift_of_the_deflection():
    u, shift = noise(500), (0.005 - 0.001) / 2
    moved = np.array([0.0, -shift / K])
    uneven = simulate(
        paper() + fx.CoulombAsymmetric("joint", 0.005, 0.001), u, 0.004, x0=np.array([*moved, 0, 0])
    )
    even = simulate(paper() + fx.Coulomb("joint", 0.003), u, 0.004)
    np.testing.assert_allclose(uneven, even + moved, rtol=0, atol=1e-14)


def test_asymmetric_arm_friction_is_both():
    u, shift = noise(500), (0.005 - 0.001) / 2
    moved = np.array([0.0, -shift / K])
    uneven = simulate(
        paper() + fx.CoulombAsymmetric("arm", 0.005, 0.001), u, 0.004, x0=np.array([*moved, 0, 0])
    )
    even = simulate(paper() + fx.Coulomb("arm", 0.003), u - shift / DRIVE, 0.004)
    np.testing.assert_allclose(uneven, even + moved, rtol=0, atol=1e-14)


# -- sticking -----------------------------------------------------------------------------------


def locked_ringing(t: np.ndarray, start: float, level: float) -> np.ndarray:
    """Deflection of an arm with Coulomb friction at the joint, released at rest while the hub sticks."""
    stuck, half = level / K, np.pi / LOCKED
    amplitudes = start - 2 * stuck * np.arange(100)
    last = int(np.argmax(amplitudes <= stuck))
    k = np.minimum((t / half).astype(int), last)
    swing = (amplitudes[k] - stuck) * np.cos(LOCKED * (t - k * half)) + stuck
    return (-1.0) ** k * np.where(k < last, swing, amplitudes[last])


@pytest.mark.parametrize(("Ts", "close"), [(0.01, 5e-5), (0.0025, 3e-6), (0.001, 5e-7)])
def test_locked_ringing(Ts, close):
    """While the hub sticks, the arm oscillates at 16.519 rad/s and loses 2 level / K per half cycle."""
    joint = paper() + fx.Coulomb("hub", 0.03) + fx.Coulomb("joint", 0.003)
    t = np.arange(0, 1.3, Ts)
    states = simulate_states(joint, np.zeros_like(t), Ts, x0=np.array([0, 0.0175, 0, 0]))
    assert np.abs(states[:, 0]).max() < 1e-12  # |K alpha| < 0.03 N m never moves the hub
    np.testing.assert_allclose(states[:, 1], locked_ringing(t, 0.0175, 0.003), rtol=0, atol=close)
    assert abs(states[-1, 1]) < 0.003 / K
    turns = np.abs(states[np.flatnonzero(np.diff(np.sign(states[:, 3]))), 1])
    assert len(turns) >= 4
    if Ts == 0.001:
        np.testing.assert_allclose(-np.diff(turns[turns > 2e-3]), 2 * 0.003 / K, atol=2e-5)


@pytest.mark.parametrize("also", [[], [fx.Coulomb("joint", 0.003)], [fx.QuadraticDrag("hub", 0.01)]])
def test_breakaway_voltage(also):
    """Dead zone and friction add up: 0.1 + 0.03 / 0.2065 = 0.245278 V."""
    zone = fx.DeadZone(positive=0.1, negative=0.1)
    joint = with_all(paper(), fx.Coulomb("hub", 0.03), zone, *also)
    threshold = 0.1 + 0.03 / DRIVE
    assert threshold == pytest.approx(0.245278, abs=5e-7)
    held = simulate(joint, np.full(500, threshold - 1e-9), 0.01)
    gone = simulate(joint, np.full(500, threshold + 1e-9), 0.01)
    assert np.abs(held).max() < 1e-12
    assert 5e-9 < gone[-1, 0] < 2e-8  # 1.86 rad/s per volt of excess, for five seconds


@pytest.mark.parametrize(
    "friction",
    [
        [fx.Coulomb("hub", 0.03), fx.Coulomb("joint", 0.003)],
        [fx.Coulomb("hub", 0.03), fx.Coulomb("joint", 0.003), fx.Coulomb("arm", 0.001)],
        [fx.Stribeck("hub", 0.02, 0.01, 0.1), fx.Stribeck("joint", 0.002, 0.001, 0.1)],
        [
            fx.Coulomb("hub", 0.03),
            fx.Coulomb("joint", 0.003),
            fx.CubicSpring("joint", 20.0),
            fx.Gravity("hub", 0.01, 0.01),
        ],
    ],
    ids=["two", "three", "stribeck", "with smooth torques"],
)
def test_stuck_does_not_creep(friction):
    """Under a load within the levels of friction nothing moves in ten seconds."""
    joint = with_all(paper(), *friction)
    start = np.array([0.3, 0.0012, 0.0, 0.0])
    states = simulate_states(joint, np.full(2500, 0.04), 0.004, x0=start)
    assert np.abs(states[:, :2] - start[:2]).max() < 1e-14
    assert np.abs(states[:, 2:]).max() < 1e-10


def test_pulse_ends_in_the_stuck_band():
    """After 2 V for 1 s everything comes to rest and stays, the arm within level / K."""
    joint = paper() + fx.Coulomb("hub", 0.03) + fx.Coulomb("joint", 0.003)
    u = np.where(np.arange(2000) < 500, 2.0, 0.0)
    states = simulate_states(joint, u, 0.002)
    assert np.abs(states[-500:] - states[-1]).max() < 1e-14
    assert abs(states[-1, 1]) <= 0.003 / K


def test_pulse_values():
    """Against a first-order time stepping at 5 us, whose own error is a few 1e-6 rad."""
    zone = fx.DeadZone(positive=0.1, negative=0.1)
    joint = with_all(paper(), fx.Coulomb("hub", 0.03), fx.Coulomb("joint", 0.003), zone)
    table = NUMBERS["pulse_S1_h5e-6"]
    u = np.where(np.arange(2001) < 1000, 2.0, 0.0)
    states = simulate_states(joint, u, 0.001, solver=Exponential(substeps=2))
    for time, expected in table.items():
        error = np.abs(states[round(float(time) * 1000)] - expected)
        assert error[:2].max() < 1e-5 and error[2:].max() < 2e-4, time


# -- convergence --------------------------------------------------------------------------------

FRICTION = {
    "hub": ([fx.Coulomb("hub", 0.03)], [coulomb(HUB, 0.03)]),
    "arm": ([fx.Coulomb("arm", 0.02)], [coulomb(ARM, 0.02)]),
    "hub and joint": (
        [fx.Coulomb("hub", 0.03), fx.Coulomb("joint", 0.003)],
        [coulomb(HUB, 0.03), coulomb(JOINT, 0.003)],
    ),
    "asymmetric": (
        [fx.CoulombAsymmetric("hub", 0.045, 0.015), fx.CoulombAsymmetric("joint", 0.002, 0.008)],
        [asymmetric(HUB, 0.045, 0.015), asymmetric(JOINT, 0.002, 0.008)],
    ),
    "stribeck": (
        [fx.Stribeck("hub", 0.02, 0.02, 0.3), fx.Coulomb("joint", 0.003)],
        [stribeck(HUB, 0.02, 0.02, 0.3), coulomb(JOINT, 0.003)],
    ),
    "all three": (
        [fx.Coulomb("hub", 0.03), fx.Coulomb("joint", 0.006), fx.Coulomb("arm", 0.01)],
        [coulomb(HUB, 0.03), coulomb(JOINT, 0.006), coulomb(ARM, 0.01)],
    ),
}


@pytest.mark.parametrize("case", FRICTION)
def test_step_converges_to_true_sticking(case):
    mine, exact = FRICTION[case]
    u, Ts = noise(250), 0.004
    expected = Joint(tuple(exact)).run(u, Ts)
    assert (expected[:, 2] == 0).any() or case == "arm"  # it sticks
    joint = with_all(paper(), *mine)
    errors = [
        np.abs(simulate(joint, u, Ts, solver=Exponential(substeps=n)) - expected[:, :2]).max()
        for n in (1, 16)
    ]
    assert errors[0] < 6e-4  # less than half an encoder count, with one step per sample
    assert errors[1] < 3e-6
    assert errors[1] < errors[0] / 50  # a first-order method would gain a factor of 16


@pytest.mark.parametrize("case", ["hub", "hub and joint"])
def test_motion_is_continuous_in_the_friction_level(case):
    """The motion does not jump where sticking or a reversal moves to another sample; fits rely on this."""
    joint = with_all(paper(), *FRICTION[case][0])
    at = joint.parameter_names.index("hub.coulomb.level")
    u, N = noise(300, seed=0), 1000
    with double_precision():
        start, values = jnp.zeros(4), jnp.asarray(joint.values)
        gates = jnp.ones(len(joint.effects))

        def theta(level):
            v = values.at[at].set(level)
            run = (joint.structure, Exponential(), v, gates, start, jnp.asarray(u))
            return free_run(*run, jnp.asarray(0.004))[1][:, 0]

        levels = jnp.linspace(0.03, 0.0306, N)
        moved = np.diff(np.asarray(jax.jit(jax.vmap(theta))(levels)), axis=0)
    assert np.abs(moved).max() < 1e-5  # for one of N - 1 equal steps of the level
    assert np.abs(np.diff(moved, axis=0)).max() < 2e-7


def test_smoothed_runge_kutta_converges_to_true_sticking():
    mine, exact = FRICTION["hub and joint"]
    u, Ts = noise(250), 0.004
    expected = Joint(tuple(exact)).run(u, Ts)[:, :2]
    joint = with_all(paper(), *mine)
    errors = [
        np.abs(simulate(joint, u, Ts, solver=SmoothRK4(width, n)) - expected).max()
        for width, n in ((0.08, 20), (0.02, 80), (0.005, 320))
    ]
    assert errors[2] < errors[1] / 2 < errors[0] / 4
    assert errors[2] < 1e-3


SMOOTH = [
    fx.QuadraticDrag("hub", 0.01),
    fx.Gravity("arm", 0.02, 0.01),
    fx.CubicSpring("joint", 20.0),
    fx.QuadraticSpring("joint", 1.0),
]


def smooth_torques(q, w):
    weight = 0.02 * np.sin(q[0] + q[1]) + 0.01 * np.cos(q[0] + q[1])
    spring = 20 * q[1] ** 3 + q[1] ** 2
    return np.array([-0.01 * w[0] * abs(w[0]) - weight, -spring - weight])


@pytest.mark.parametrize(("order", "close"), [(2, 2e-4), (4, 5e-6)])
def test_smooth_torques_converge_at_their_order(order, close):
    # A constant voltage: the drag has a kink at speed zero, at which high-order methods lose accuracy.
    u, Ts, start = np.full(100, 1.0), 0.008, np.array([0.1, 0.08, 1.0, 0.5])
    expected = Joint(extra=smooth_torques).run(u, Ts, start)[:, :2]
    joint = with_all(paper(), *SMOOTH)
    errors = [
        np.abs(simulate(joint, u, Ts, start, Exponential(order, n)) - expected).max() for n in (1, 2, 4)
    ]
    assert errors[0] < close * 4
    for coarse, fine in itertools.pairwise(errors):
        assert coarse / fine > 0.75 * 2**order


def test_runge_kutta_has_order_four_on_the_linear_joint():
    u, Ts = noise(100), 0.01
    exact = simulate(paper(), u, Ts)
    errors = [
        np.abs(simulate(paper(), u, Ts, solver=SmoothRK4(substeps=n)) - exact).max() for n in (1, 2, 4, 100)
    ]
    assert errors[0] / errors[1] > 14 and errors[1] / errors[2] > 14
    assert errors[3] < 1e-11


def test_both_steppers_agree_on_smooth_torques():
    u, Ts = noise(250), 0.004
    joint = with_all(paper(), *SMOOTH)
    exponential = simulate(joint, u, Ts, solver=Exponential(4, 16))
    classical = simulate(joint, u, Ts, solver=SmoothRK4(substeps=20))
    np.testing.assert_allclose(exponential, classical, rtol=0, atol=2e-8)


@pytest.mark.parametrize("presliding", [0.001, 0.01])
def test_dahl_converges(presliding):
    level, u, Ts, joint = 0.03, noise(60), 0.004, Joint()
    inverse, x, expected = np.linalg.inv(joint.mass), np.zeros(5), []

    def flow(_, s, v):
        torque = joint.torque(s[:2], s[2:4], v) - level * s[4] * np.array([1.0, 0.0])
        rate = s[2] / presliding * (1 - s[4] * np.sign(s[2]))
        return np.concatenate([s[2:4], inverse @ torque, [rate]])

    for v in u:
        expected.append(x[:2])
        run = solve_ivp(flow, (0, Ts), x, "DOP853", rtol=1e-9, atol=1e-11, max_step=Ts / 3, args=(v,))
        x = run.y[:, -1]
    mine = paper() + fx.Dahl("hub", level, presliding)
    solvers = (Exponential(), Exponential(substeps=16), SmoothRK4(substeps=60))
    errors = [np.abs(simulate(mine, u, Ts, solver=s) - expected).max() for s in solvers]
    assert errors[0] < 6e-4  # the memory is stiff: up to 5 presliding lengths a step
    assert errors[1] < errors[0] / 50
    assert errors[2] < 1e-6


# -- energy -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "law",
    [
        functools.partial(fx.Viscous, coefficient=0.002),
        functools.partial(fx.Coulomb, level=0.005),
        functools.partial(fx.CoulombAsymmetric, forward=0.008, backward=0.002),
        functools.partial(fx.Stribeck, level=0.003, excess=0.003, speed=0.3),
        functools.partial(fx.QuadraticDrag, coefficient=0.01),
        functools.partial(fx.Dahl, level=0.01, presliding=0.005),
        functools.partial(fx.LuGre, level=0.01, rise=0.5, slow=0.3, presliding=0.005, damping=0.002),
        functools.partial(fx.BoucWen, level=0.01, width=0.005, beta=0.5),
    ],
    ids=lambda p: p.func.name,
)
def test_without_input_no_passive_effect_adds_energy(law):
    joint = paper(back_emf=0.0).without("viscous", "hub").without("viscous", "joint")
    joint = with_all(joint, *(law(at=port) for port in ("hub", "joint", "arm")))
    start = np.array([0.0, 0.08, 1.5, -2.0])
    s = simulate_states(joint, np.zeros(1000), 0.001, x0=start)
    E = J_HUB / 2 * s[:, 2] ** 2 + J_ARM / 2 * (s[:, 2] + s[:, 3]) ** 2 + K / 2 * s[:, 1] ** 2
    if law.func in (fx.Dahl, fx.LuGre, fx.BoucWen):  # the bristles store energy
        E = E + 0.01 * 0.005 / 2 * np.sum(s[:, 4:] ** 2, axis=1)
    assert E[-1] < 0.9 * E[0]
    assert np.diff(E).max() < 1e-7 * E[0]


@pytest.mark.parametrize(("order", "close"), [(2, 1e-4), (4, 1e-8)])
def test_springs_keep_energy(order, close):
    joint = paper(back_emf=0.0) + fx.CubicSpring("joint", 20.0) + fx.Spring("hub", 0.5)
    start = np.array([0.2, 0.08, 1.5, -2.0])
    s = simulate_states(joint, np.zeros(1000), 0.001, x0=start, solver=Exponential(order))
    E = J_HUB / 2 * s[:, 2] ** 2 + J_ARM / 2 * (s[:, 2] + s[:, 3]) ** 2
    E = E + 0.25 * s[:, 0] ** 2 + K / 2 * s[:, 1] ** 2 + 5 * s[:, 1] ** 4
    assert np.abs(E / E[0] - 1).max() < close


def test_a_damped_part_takes_energy_and_an_undamped_one_keeps_it():
    for damping, left in ((0.0, 1.0), (0.05, 0.99)):
        joint = paper(back_emf=0.0) + fx.SecondMode("arm", 8e-4, 14.0, damping)
        s = simulate_states(joint, np.zeros(1000), 0.001, x0=np.array([0.2, 0.08, 1.5, -2.0, 0.01, 3.0]))
        E = J_HUB / 2 * s[:, 2] ** 2 + J_ARM / 2 * (s[:, 2] + s[:, 3]) ** 2 + K / 2 * s[:, 1] ** 2
        E = E + 8e-4 / 2 * (s[:, 5] ** 2 + (28 * np.pi * s[:, 4]) ** 2)
        assert np.diff(E).max() < 1e-12 * E[0]
        assert (E[-1] > (1 - 1e-10) * E[0]) if left == 1 else (E[-1] < left * E[0])


@pytest.mark.parametrize(("order", "close"), [(2, 1e-4), (4, 1e-7)])
def test_cogging_keeps_energy(order, close):
    joint = paper(back_emf=0.0) + fx.Cogging("hub", sine=0.03, cosine=0.02, periods=8.0)
    start = np.array([0.2, 0.03, 1.0, -1.0])
    s = simulate_states(joint, np.zeros(1000), 0.001, x0=start, solver=Exponential(order))
    E = J_HUB / 2 * s[:, 2] ** 2 + J_ARM / 2 * (s[:, 2] + s[:, 3]) ** 2 + K / 2 * s[:, 1] ** 2
    E = E + (0.02 * np.sin(8 * s[:, 0]) - 0.03 * np.cos(8 * s[:, 0])) / 8
    assert np.abs(E / E[0] - 1).max() < close


def test_a_loose_joint_coasts_within_its_play_and_swings_beyond():
    """Closed form: half an oscillation at each edge, two free flights; period 2 pi / w + 4 play / speed."""
    play, speed = 0.006, 0.4
    joint = paper(back_emf=0.0, torque_constant=0.0) + fx.JointPlay("joint", play, K)
    still = simulate_states(joint, np.zeros(200), 0.004, x0=np.array([0.0, 0.9 * play, 0.0, 0.0]))
    assert np.abs(still - still[0]).max() < 1e-13
    # The momenta of hub and arm are opposite, so the joint oscillates with the reduced inertia.
    reduced = J_HUB * J_ARM / (J_HUB + J_ARM)
    hub = -speed * J_ARM / (J_HUB + J_ARM)
    t = np.arange(400) * 0.001
    s = simulate_states(
        joint, 0 * t, 0.001, x0=np.array([0.0, 0.0, hub, speed]), solver=Exponential(substeps=8)
    )
    w = np.sqrt(K / reduced)
    flight, half = play / speed, np.pi / w
    period = 2 * half + 4 * flight
    phase = t % period
    side = np.where(phase < period / 2, 1.0, -1.0)
    phase = phase % (period / 2)
    beyond = play + speed / w * np.sin(w * (phase - flight))
    there = np.where(phase < flight, speed * phase, beyond)
    back = play - speed * (phase - flight - half)
    expected = side * np.where(phase > flight + half, back, there)
    np.testing.assert_allclose(s[:, 1], expected, rtol=0, atol=2e-5)


# -- derivatives --------------------------------------------------------------------------------

# Together they contain the effects of the catalogue, except those whose derivatives are tested elsewhere.
LADEN = {
    "smooth": [
        *SMOOTH,
        fx.Viscous("arm", 1e-4),
        fx.Spring("hub", 0.3),
        fx.DeadZone(positive=0.15, negative=0.1),
        fx.Saturation(limit=1.2),
        fx.VoltageOffset(offset=0.03),
        fx.SensorBias("alpha", bias=0.01),
        fx.SensorGain("alpha", error=0.05),
    ],
    "smooth and more": [
        fx.Cogging("hub", sine=0.02, cosine=-0.01, periods=8.0),
        fx.JointPlay("joint", play=0.004, stiffness=1.2),
        fx.SecondMode("arm", inertia=5e-4, frequency=15.0, damping=0.05),
        fx.Delay(time=0.0051),
        fx.Lag(time=0.006),
        fx.SensorCubic("alpha", cubic=6.0),
        fx.Rectifier("alpha", loss=0.15),
        fx.VoltageDrift(rate=0.2),
        fx.PeriodicDisturbance(sine=0.2, cosine=-0.1, frequency=7.0),
        fx.ViscousAsymmetric("hub", 0.002),
    ],
    "sensors and load": [
        fx.AmplifierSaturation(limit=2.5),
        fx.EccentricEncoder("theta", cosine=0.004, sine=-0.01),
        fx.CrossTalk("alpha", share=0.02),
        fx.ChannelDelay("theta", time=0.003),
        fx.ChannelDelay("alpha", time=0.005),
        fx.LoadFriction("hub", level=0.02, driving=0.2, driven=0.5),
        fx.PositionServo("hub", gain=60.0, limit=0.2),
    ],
    "dry": [
        fx.CoulombAsymmetric("hub", 0.03, 0.02),
        fx.Stribeck("joint", 0.003, 0.002, 0.3),
        fx.Coulomb("arm", 0.004),
    ],
    "memory": [
        fx.Dahl("hub", 0.02, 0.004),
        fx.Dahl("arm", 0.005, 0.01),
        fx.Coulomb("joint", 0.003),
    ],
    "memory and more": [
        fx.LuGre("hub", level=0.02, rise=0.5, slow=0.3, presliding=0.004, damping=0.01),
        fx.BoucWen("joint", level=0.02, width=0.02, beta=0.4),
        fx.Heating("hub", rate=50.0, time=0.3),
    ],
    "loaded motor": [fx.GearFriction("hub", 0.01, 0.2), fx.TorqueSaturation("hub", 0.5)],
}
# Cases with derivatives in reverse mode too, which is slow to compile; `memory` has dry friction.
BACKWARD = {"smooth", "memory"}


class Laden:
    """A mechanism with its outputs as a function of (values, gates, u, x0), and the derivatives."""

    def __init__(self, case: str) -> None:
        self.case = case
        # The derivatives of three contacts that may all stick are slow to compile and to compute. Two passes
        # solve all cases except those in which several contacts stop or break away in one step.
        self.N, solver = (24, Exponential(passes=2)) if case == "dry" else (120, Exponential())
        given = {"inductance": 0.18e-3} if case == "smooth" else {}
        self.added = LADEN[case]
        self.joint = with_all(paper(hub_damping=0.01, joint_damping=1e-3, **given), *self.added)
        self.first = len(self.joint.effects) - len(self.added)
        structure, rest = self.joint.structure, rest_state(self.joint.structure, np.dtype(float))

        def run(values, gates, u, x0):
            start = jnp.asarray(rest).at[:4].set(x0)
            Ts = jnp.asarray(0.004)
            return free_run(structure, solver, values, gates, start, u, Ts)[1]

        def weighted(values, gates, u, x0, weights):
            return jnp.sum(weights * run(values, gates, u, x0))

        self.run = jax.jit(run, compiler_options=ROUGH)
        self.forward = jax.jit(jax.jacfwd(run, argnums=(0, 1)), compiler_options=ROUGH)
        self.backward = jax.jit(jax.grad(weighted, argnums=(0, 1)), compiler_options=ROUGH)


@pytest.fixture(scope="module", params=LADEN)
def laden(request) -> Laden:
    """A case; the tests of a case run one after another, so that a worker compiles it once."""
    with double_precision():
        return Laden(request.param)


def test_derivatives_of_a_trajectory_equal_central_differences(laden):
    with double_precision():
        u, x0 = jnp.asarray(noise(laden.N, seed=3)), jnp.asarray([0.2, 0.01, 0.5, -0.3])
        values, gates = jnp.asarray(laden.joint.values), jnp.ones(len(laden.joint.effects))
        forward = np.asarray(laden.forward(values, gates, u, x0)[0])
        weights = jnp.asarray(np.random.default_rng(0).normal(size=forward.shape[:2]))
        backward = laden.backward(values, gates, u, x0, weights)[0] if laden.case in BACKWARD else None
        for i, name in enumerate(laden.joint.parameter_names):
            # A step so small that no start of sticking and no reversal moves to another sample.
            h = 1e-6 * abs(float(values[i]))
            plus, minus = (np.asarray(laden.run(values.at[i].add(s * h), gates, u, x0)) for s in (1, -1))
            expected = (plus - minus) / (2 * h)
            size = np.abs(expected).max()
            assert size > 0, name
            np.testing.assert_allclose(forward[..., i], expected, rtol=0, atol=2e-5 * size, err_msg=name)
    if backward is not None:
        expected = np.einsum("nc,ncp->p", weights, forward)
        np.testing.assert_allclose(backward, expected, rtol=1e-8, atol=1e-10)


def test_every_effect_has_its_derivatives_checked():
    used = {e.name for effects in LADEN.values() for e in effects} | {"inertia", "motor", "current_drive"}
    # Play has no derivative at a gap of zero; its own tests check it elsewhere. Readings of the motor need
    # other outputs (`test_effects_servo_loop.py`), a signal needs a column (`test_effects_signals.py`).
    elsewhere = {"backlash", "elastic_backlash", "pid_servo", "current_meter", "duty_meter"}
    elsewhere |= {"measured_disturbance"}
    assert used | elsewhere == set(fx.CATALOG)


def test_no_derivative_is_nan_at_rest_or_where_effects_are_absent(laden):
    """With amplitudes and gates at zero and nothing in motion, and with voltages at kinks of the effects."""
    absent = [e.replace(**dict.fromkeys(e.amplitudes, 0.0)) for e in laden.joint.effects[laden.first :]]
    bare = with_all(paper(**({"inductance": 1e-4} if laden.case == "smooth" else {})), *absent)
    kinks = np.resize([0.0, 0.15, -0.1, 1.2, -1.2, 0.0, 0.0], laden.N)
    with double_precision():
        x0, weights = jnp.zeros(4), jnp.ones((laden.N, 2))
        for u in (jnp.zeros(laden.N), jnp.asarray(kinks)):
            for values in (jnp.asarray(laden.joint.values), jnp.asarray(bare.values)):
                for size in (0.0, 1.0):
                    gates = jnp.ones(len(laden.joint.effects)).at[laden.first :].set(size)
                    found = [laden.run(values, gates, u, x0), *laden.forward(values, gates, u, x0)]
                    if laden.case in BACKWARD:
                        found += laden.backward(values, gates, u, x0, weights)
                    assert all(np.isfinite(a).all() for a in found)


def test_the_first_trace_of_an_effect_shows_in_the_derivative(laden):
    """At gate zero the derivative equals the difference quotient of a small gate; score tests rely on it."""
    with double_precision():
        u, x0, h = jnp.asarray(noise(laden.N, seed=4)), jnp.zeros(4), 1e-5
        values = jnp.asarray(laden.joint.values)
        off = jnp.ones(len(laden.joint.effects)).at[laden.first :].set(0.0)
        slopes = np.asarray(laden.forward(values, off, u, x0)[1])
        zero = np.asarray(laden.run(values, off, u, x0))
        for i in range(laden.first, len(laden.joint.effects)):
            trace = (np.asarray(laden.run(values, off.at[i].set(h), u, x0)) - zero) / h
            size = np.abs(trace).max()
            assert size > 0
            np.testing.assert_allclose(
                slopes[..., i],
                trace,
                rtol=0,
                atol=2e-3 * size,
                err_msg=f"{laden.joint.effects[i].name} at {laden.joint.effects[i].at}",
            )
