"""The arena's simulator against closed forms, an event-driven solver, and other runs of itself."""

import itertools
import json

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from arena.demo_record import EFFECTS, FOLDER, HEADER, demo
from rotflex_jax.arena.simulator import plant as p
from rotflex_jax.arena.simulator.hidden import ABSORBED, DEFAULTS, EQUIVALENT, UNSEEN, parameters
from rotflex_jax.arena.simulator.laws import laws
from rotflex_jax.arena.simulator.records import COUNT, INPUTS, JITTER, make_record

BARE = p.Plant(B_hub=0.0, B_joint=0.0)
HUB, JOINT = 0.03, 0.003
SYMMETRIC = {("coulomb", "hub"): {"level": HUB}, ("coulomb", "joint"): {"level": JOINT}}
FRICTION = {**SYMMETRIC, ("dead_zone", "input"): {"width": 0.1}}

# Sample (1 ms) -> theta, alpha and their speeds under a pulse of 2 V for 1 s with `FRICTION`, by an
# independent first-order time stepping with a step of 5 us. Its error is a few 1e-6 rad.
PULSE = {
    50: (0.09268544940821673, -0.08488455636388197, 2.2628588877652307, -1.7393254617966911),
    500: (1.3998933811858636, -0.001844745430944242, 3.2460163873521988, 0.0),
    1100: (3.1554979680312014, 0.12736089593561967, 1.5009164383703282, -0.42497185152336664),
    1800: (3.235146930574437, 0.0026688359658860825, 0.0, 0.2546784504642507),
    2000: (3.235146930574437, -0.003484674767953248, 0.0, -0.18375947132788545),
}


def noise(N: int, seed: int = 0) -> np.ndarray:
    return np.repeat(np.random.default_rng(seed).standard_normal(N // 10), 10)


def motor(plant: p.Plant, v: float, speed: float) -> float:
    return plant.torque_per_volt * (v - plant.k_m * plant.K_g * speed)


def event_driven(u: float, start: np.ndarray, end: float, t_eval: np.ndarray) -> np.ndarray:
    """Hub and joint friction as a hybrid automaton: events switch sliding and sticking."""
    v = np.sign(u) * max(abs(u) - 0.1, 0.0)
    limit = np.array([HUB, JOINT])

    def dynamics(x, mode):
        """Accelerations of hub and deflection, and friction torques, of a mode."""
        # Unknowns: hub acceleration, arm acceleration, hub friction, joint friction.
        lhs = np.zeros((4, 4))
        lhs[0] = [BARE.J_hub, 0, 1, -1]
        lhs[1] = [0, BARE.J_arm, 0, 1]
        rhs = np.array([motor(BARE, v, x[2]) + BARE.K * x[1], -BARE.K * x[1], 0.0, 0.0])
        for i, (m, speed) in enumerate(zip(mode, ([1, 0], [-1, 1]), strict=True)):
            if m == 0:
                lhs[2 + i, :2] = speed
            else:
                lhs[2 + i, 2 + i], rhs[2 + i] = 1, m * limit[i]
        hub, arm, *friction = np.linalg.solve(lhs, rhs)
        return np.array([hub, arm - hub]), np.array(friction)

    def consistent(x, forced):
        """The mode in which no sticking port exceeds its level and no starting port accelerates backwards."""
        choices = [
            [forced[i]] if i in forced else ([0, 1, -1] if x[2 + i] == 0 else [np.sign(x[2 + i])])
            for i in range(2)
        ]
        for mode in itertools.product(*choices):
            acceleration, friction = dynamics(x, mode)
            good = [
                abs(friction[i]) <= limit[i]
                if mode[i] == 0
                else x[2 + i] != 0 or i in forced or mode[i] * acceleration[i] > 0
                for i in range(2)
            ]
            if all(good):
                return mode
        raise AssertionError("no consistent mode")

    def watch(i, mode):
        def event(_, x):
            if mode[i] == 0:
                return limit[i] - abs(dynamics(x, mode)[1][i])
            return mode[i] * x[2 + i]

        event.terminal, event.direction = True, -1
        return event

    t, x, forced, out = 0.0, start.copy(), {}, np.empty((t_eval.size, 4))
    while t < end:
        mode = consistent(x, forced)
        solution = solve_ivp(
            lambda _, x, mode=mode: np.concatenate([x[2:], dynamics(x, mode)[0]]),
            (t, end),
            x,
            events=[watch(i, mode) for i in range(2)],
            dense_output=True,
            rtol=1e-10,
            atol=1e-12,
        )
        part = (t_eval >= t) & (t_eval <= solution.t[-1])
        out[part] = solution.sol(t_eval[part]).T
        t, x, forced = solution.t[-1], solution.y[:, -1].copy(), {}
        for i, times in enumerate(solution.t_events):
            if times.size and mode[i] == 0:
                forced[i] = np.sign(dynamics(x, mode)[1][i])
            elif times.size or mode[i] == 0:
                x[2 + i] = 0.0
    return out


@pytest.fixture(scope="module")
def pulse():
    u = np.zeros(2001)
    u[:1000] = 2.0
    return p.simulate(BARE, laws(FRICTION), u, 1e-3)


def test_pulse_agrees_with_an_event_driven_solver(pulse):
    t = np.arange(1001) * 1e-3
    rising = event_driven(2.0, np.zeros(4), 1.0, t)
    falling = event_driven(0.0, rising[-1], 1.0, t)
    exact = np.vstack([rising, falling[1:]])
    np.testing.assert_allclose(pulse[:, :2], exact[:, :2], atol=3e-6)
    np.testing.assert_allclose(pulse[:, 2:], exact[:, 2:], atol=1e-4)
    # Both ports stick at times, so the agreement includes sticking.
    assert (exact[:, 2] == 0).any() and (exact[1:, 3] == 0).any()


def test_pulse_agrees_with_reference_numbers(pulse):
    for k, state in PULSE.items():
        np.testing.assert_allclose(pulse[k, :2], state[:2], atol=1e-5)
        np.testing.assert_allclose(pulse[k, 2:], state[2:], atol=1e-4)


def test_a_stuck_port_does_not_creep(pulse):
    assert np.ptp(pulse[1800:, 0]) == 0
    assert np.ptp(pulse[500:1000, 1]) == 0
    at_rest = p.simulate(
        BARE,
        laws({(name, port): parameters((name, port)) for name, port in DEFAULTS if name == "coulomb"}),
        np.full(2000, 0.1),
        2e-3,
        start=(0.0, 0.002, 0.0, 0.0),
    )
    assert (at_rest == [0.0, 0.002, 0.0, 0.0]).all()


def test_locked_arm_rings_with_a_linear_envelope():
    x = p.simulate(BARE, laws(SYMMETRIC), np.zeros(12000), 1e-4, start=(0.0, 0.0178, 0.0, 0.0))
    assert (x[:, 0] == 0).all()
    turning = np.flatnonzero(np.diff(np.sign(x[:, 3])) != 0)[1:]
    amplitudes = np.abs(x[turning + 1, 1])[:4]
    drops = -np.diff(np.concatenate([[0.0178], amplitudes]))
    np.testing.assert_allclose(drops, 2 * JOINT / BARE.K, rtol=1e-3)
    rate = np.sqrt(BARE.K / BARE.J_arm)
    assert rate == pytest.approx(16.519, abs=1e-3)
    np.testing.assert_allclose(np.diff(turning[:4]) * 1e-4, np.pi / rate, atol=3e-4)


def test_linear_joint_is_the_matrix_exponential():
    plant, Ts, u = p.Plant(), 2e-3, noise(2000)
    damping = plant.B_hub + plant.torque_per_volt * plant.k_m * plant.K_g
    M = np.array([[plant.J_hub + plant.J_arm, plant.J_arm], [plant.J_arm, plant.J_arm]])
    A = np.zeros((5, 5))
    A[:2, 2:4] = np.eye(2)
    A[2:4, 1] = np.linalg.solve(M, [0, -plant.K])
    A[2:4, 2:4] = -np.linalg.solve(M, np.diag([damping, plant.B_joint]))
    A[2:4, 4] = np.linalg.solve(M, [plant.torque_per_volt, 0])
    step = expm(A * Ts)
    x = np.array([0.3, 0.05, -1.0, 2.0])
    y = p.simulate(plant, laws({}), u, Ts, start=tuple(x))
    for k in range(u.size):
        np.testing.assert_allclose(y[k], x, atol=2e-6)
        x = step[:4, :4] @ x + step[:4, 4] * u[k]


def test_friction_and_dead_zone_are_odd():
    u = noise(2000)
    forward, backward = (p.simulate(BARE, laws(FRICTION), s * u, 2e-3) for s in (1, -1))
    assert (forward == -backward).all()


def test_halving_the_step_changes_nothing_that_an_encoder_sees():
    everything = {place: parameters(place) for place in DEFAULTS}
    coarse, fine = (p.simulate(p.Plant(), laws(everything), noise(4000), 2e-3, step=s) for s in (2e-5, 1e-5))
    np.testing.assert_allclose(coarse[:, :2], fine[:, :2], atol=2e-5)


def test_springs_and_gravity_conserve_energy():
    plant = p.Plant(B_hub=0.0, B_joint=0.0, k_t=0.0)
    given = {
        ("cubic_spring", "joint"): {"coefficient": 40.0},
        ("quadratic_spring", "joint"): {"coefficient": 3.0},
        ("gravity", "hub"): {"moment": 0.03, "phase": 0.6},
        ("gravity", "arm"): {"moment": 0.05, "phase": -0.4},
    }
    x = p.simulate(plant, laws(given), np.zeros(1000), 2e-3, start=(0.5, 0.1, 1.0, -2.0))
    theta, alpha, hub, arm = x[:, 0], x[:, 1], x[:, 2], x[:, 2] + x[:, 3]
    kinetic = (plant.J_hub * hub**2 + plant.J_arm * arm**2) / 2
    spring = plant.K * alpha**2 / 2 + alpha**3 + 10 * alpha**4
    gravity = -0.03 * np.cos(theta + 0.6) - 0.05 * np.cos(theta + alpha - 0.4)
    assert np.ptp(spring) > 0.005 and np.ptp(gravity) > 0.005
    np.testing.assert_allclose(kinetic + spring + gravity, (kinetic + spring + gravity)[0], atol=1e-8)


@pytest.mark.parametrize("port", ["hub", "arm"])
@pytest.mark.parametrize("effect", ["coulomb", "coulomb_asymmetric", "stribeck", "viscous", "quadratic_drag"])
@pytest.mark.parametrize("sign", [1, -1])
def test_steady_turning_balances_the_torques(effect, port, sign):
    plant, given = p.Plant(), parameters((effect, port))
    x = p.simulate(plant, laws({(effect, port): given}), np.full(2000, 0.7 * sign), 2e-3)[-1]
    speed = abs(x[2])
    resisting = {
        "coulomb": lambda level: level,
        "coulomb_asymmetric": lambda level_plus, level_minus: level_plus if sign > 0 else level_minus,
        "stribeck": lambda level, excess, speed: level + excess * np.exp(-((x[2] / speed) ** 2)),
        "viscous": lambda coefficient: coefficient * speed,
        "quadratic_drag": lambda coefficient: coefficient * speed**2,
    }[effect](**given)
    driving = sign * motor(plant, 0.7 * sign, x[2]) - plant.B_hub * speed
    assert driving == pytest.approx(resisting, abs=1e-7)
    assert -sign * plant.K * x[1] == pytest.approx(resisting if port == "arm" else 0.0, abs=1e-7)


def test_joint_damping_laws_take_their_power():
    # The energy that the joint loses equals the work of both damping laws together.
    plant = p.Plant(B_hub=0.0, B_joint=0.0, k_t=0.0)
    given = {(name, "joint"): parameters((name, "joint")) for name in ("viscous", "quadratic_drag")}
    x = p.simulate(plant, laws(given), np.zeros(5000), 1e-4, start=(0.0, 0.1, 0.0, 0.0))
    hub, arm, s = x[:, 2], x[:, 2] + x[:, 3], x[:, 3]
    energy = (plant.J_hub * hub**2 + plant.J_arm * arm**2 + plant.K * x[:, 1] ** 2) / 2
    coefficients = [values["coefficient"] for values in given.values()]
    power = coefficients[0] * s**2 + coefficients[1] * np.abs(s) ** 3
    lost = np.concatenate([[0], np.cumsum((power[1:] + power[:-1]) / 2 * 1e-4)])
    np.testing.assert_allclose(energy[0] - energy, lost, atol=1e-7)


@pytest.mark.parametrize(
    ("u", "v"),
    [(3.0, 0.9), (-3.0, -0.7), (0.05, 0.0), (-0.25, 0.0), (-0.35, -0.05), (0.4, 0.3)],
)
def test_the_voltage_meets_limiter_offset_and_dead_zone(u, v):
    given = {
        ("saturation", "input"): {"limit": 1.0},
        ("voltage_offset", "input"): {"offset": 0.1},
        ("dead_zone", "input"): {"width": 0.2},
    }
    with_path = p.simulate(BARE, laws(given), np.full(100, u), 2e-3)
    without = p.simulate(BARE, laws({}), np.full(100, v), 2e-3)
    np.testing.assert_allclose(with_path, without, atol=1e-12)


def test_asymmetric_friction_is_symmetric_friction_and_a_constant_torque():
    u, plant, both = noise(2000), p.Plant(), {"level_plus": 0.045, "level_minus": 0.015}
    asymmetric = p.simulate(plant, laws({("coulomb_asymmetric", "hub"): both}), u, 2e-3)
    symmetric = laws(
        {
            ("coulomb", "hub"): {"level": 0.03},
            ("voltage_offset", "input"): {"offset": -0.015 / plant.torque_per_volt},
        }
    )
    np.testing.assert_allclose(asymmetric, p.simulate(plant, symmetric, u, 2e-3), atol=1e-10)

    both = {"level_plus": 0.009, "level_minus": 0.003}
    for port, torque_at_hub in (("joint", 0.0), ("arm", 0.003)):
        asymmetric = p.simulate(plant, laws({("coulomb_asymmetric", port): both}), u, 2e-3)
        symmetric = laws(
            {
                ("coulomb", port): {"level": 0.006},
                ("voltage_offset", "input"): {"offset": -torque_at_hub / plant.torque_per_volt},
            }
        )
        shift = 0.003 / plant.K
        moved = p.simulate(plant, symmetric, u, 2e-3, start=(0.0, shift, 0.0, 0.0))
        moved[:, 1] -= shift
        np.testing.assert_allclose(asymmetric, moved, atol=1e-10)


def test_what_cannot_be_seen_cannot_be_seen():
    """Effects that a damping of the plant or a gain of the input can replace give the same motion."""
    for effect, port in ABSORBED:
        value = parameters((effect, port))["coefficient"]
        damped = p.Plant(**{f"B_{port}": getattr(p.Plant(), f"B_{port}") + value})
        hidden = p.simulate(p.Plant(), laws({(effect, port): {"coefficient": value}}), noise(500), 2e-3)
        np.testing.assert_allclose(p.simulate(damped, laws({}), noise(500), 2e-3), hidden, atol=1e-12)
    for (place, kinds), gain in zip(UNSEEN.items(), (0.8, 1.0), strict=True):
        for kind in kinds:
            u = make_record(kind=kind, seconds=2.0)["u"]
            hidden = p.simulate(BARE, laws({place: parameters(place)}), u, 2e-3)
            np.testing.assert_allclose(p.simulate(BARE, laws({}), gain * u, 2e-3), hidden, atol=1e-12)


@pytest.mark.parametrize("kind", INPUTS)
def test_inputs_are_about_one_volt(kind):
    u = np.concatenate([make_record(kind=kind, seed=s)["u"] for s in range(3)])
    assert np.sqrt(np.mean(u**2)) == pytest.approx(1.0, abs=0.12)
    assert np.abs(u).max() < 5
    assert not np.array_equal(u[:10000], u[10000:20000])


def test_a_record_is_its_seed():
    """One seed gives one recording; input and plant do not depend on the hidden effects."""
    once, again, other = (make_record([("coulomb", "hub")], seed=s, seconds=1.0) for s in (3, 3, 4))
    assert np.array_equal(once["y"], again["y"]) and once["truth"] == again["truth"]
    assert not np.array_equal(once["u"], other["u"])
    bare = make_record(seed=3, seconds=1.0)
    assert np.array_equal(once["u"], bare["u"])
    assert once["truth"]["plant"] == bare["truth"]["plant"]


def test_plants_differ_only_in_what_is_unknown():
    nominal = vars(p.Plant())
    ratios = np.array(
        [
            [
                true / nominal[name]
                for name, true in make_record(seed=s, seconds=0.1)["truth"]["plant"].items()
            ]
            for s in range(40)
        ]
    )
    for name, column in zip(nominal, ratios.T, strict=True):
        if name not in {"J_hub", "K", "B_hub", "B_joint", "k_t"}:
            assert (column == 1).all()
        else:
            assert column.min() < 0.85 and column.max() > 1.15
            assert column.min() >= 0.8 and column.max() <= 1.2


def test_encoders_count():
    record = make_record(seed=5)
    counts = record["y"] / COUNT
    np.testing.assert_allclose(counts, np.round(counts), atol=1e-9)
    error = record["y"] - record["clean"]
    np.testing.assert_allclose(error.std(axis=0), np.hypot(JITTER, COUNT / np.sqrt(12)), rtol=0.05)


@pytest.mark.parametrize("place", DEFAULTS, ids="@".join)
def test_every_effect_shows_and_grows(place):
    clean, small, full = (
        make_record([place] if size else [], size=size, kind="steps", seed=1, seconds=4.0)["clean"]
        for size in (0.0, 0.3, 1.0)
    )
    # Saturation at 1.2 V / 0.3 lies above every step.
    weak, strong = (np.abs(x - clean).max() for x in (small, full))
    assert strong > max(3e-3, weak)
    assert weak > 0 or place == ("saturation", "input")


def test_look_alikes_are_known_effects():
    for truth, others in EQUIVALENT.items():
        assert {truth, *others} <= set(DEFAULTS) and truth not in others


def test_a_mistaken_request_is_explained():
    with pytest.raises(ValueError, match="no backlash at arm"):
        make_record([("backlash", "arm")])
    with pytest.raises(ValueError, match="its parameters are level"):
        make_record({("coulomb", "hub"): {"mu": 0.3}})
    with pytest.raises(ValueError, match="no input 'ramp'"):
        make_record(kind="ramp")


def test_the_shipped_demonstration_is_what_the_generator_makes():
    table, record = FOLDER / "demo.csv", demo()
    assert table.read_text().splitlines()[0] == HEADER
    t, u, theta, alpha = np.loadtxt(table, delimiter=",", skiprows=1, unpack=True)
    np.testing.assert_allclose(t, record["Ts"] * np.arange(u.size), atol=1e-9)
    np.testing.assert_array_equal(u, record["u"])
    counts = np.abs(np.column_stack([theta, alpha]) - record["y"]) / COUNT
    # Another processor may round a few samples to the neighbouring count, not more.
    assert counts.max() < 1.01 and np.mean(counts > 0.01) < 1e-3

    truth = json.loads((FOLDER / "demo_truth.json").read_text())
    assert [(e["effect"], e["port"]) for e in truth["effects"]] == list(EFFECTS)
    assert truth["plant"] == pytest.approx(record["truth"]["plant"])
