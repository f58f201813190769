"""The arena's effects with a memory, its gear and its sensors against closed forms and scipy."""

from collections.abc import Callable

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import expm
from scipy.signal import lsim

from rotflex_jax.arena.marking import renamed, scored
from rotflex_jax.arena.simulator import plant as p
from rotflex_jax.arena.simulator.gear import ROTOR_SHARE
from rotflex_jax.arena.simulator.hidden import DEFAULTS, EQUIVALENT, OUTSIDE, SHAPES, parameters
from rotflex_jax.arena.simulator.laws import Place, laws
from rotflex_jax.arena.simulator.records import make_record
from rotflex_jax.arena.simulator.tables import Laws
from rotflex_jax.arena.simulator.torques import build_up
from rotflex_jax.effects import CATALOG

TS = 2e-3
NONE: Laws = laws({})
FREE = p.Plant(B_hub=0.0, B_joint=0.0, k_t=0.0)
OLD = {"coulomb", "coulomb_asymmetric", "stribeck", "viscous", "quadratic_drag", "quadratic_spring"}
OLD |= {"cubic_spring", "gravity", "dead_zone", "saturation", "voltage_offset", "sensor_bias"}


def noise(N: int, seed: int = 0, hold: int = 10) -> np.ndarray:
    return np.repeat(np.random.default_rng(seed).standard_normal(N // hold), hold)


def linear(plant: p.Plant) -> tuple[np.ndarray, np.ndarray]:
    """State matrices of the bare joint for ``theta, alpha, theta', alpha'``."""
    M = np.array([[plant.J_hub + plant.J_arm, plant.J_arm], [plant.J_arm, plant.J_arm]])
    damping = plant.B_hub + plant.torque_per_volt * plant.k_m * plant.K_g
    A, b = np.zeros((4, 4)), np.zeros((4, 1))
    A[:2, 2:] = np.eye(2)
    A[2:, 1] = np.linalg.solve(M, [0, -plant.K])
    A[2:, 2:] = -np.linalg.solve(M, np.diag([damping, plant.B_joint]))
    b[2:, 0] = np.linalg.solve(M, [plant.torque_per_volt, 0])
    return A, b


Torques = Callable[[float, np.ndarray, float], tuple[np.ndarray, np.ndarray]]


def integrated(plant: p.Plant, law: Torques, inner: np.ndarray, u: np.ndarray, hold: int) -> np.ndarray:
    """States at every change of the voltage, by scipy, of the joint with torques on hub, arm and joint."""
    A, b = linear(plant)
    M = np.array([[plant.J_hub + plant.J_arm, plant.J_arm], [plant.J_arm, plant.J_arm]])

    def f(t, x, v):
        torque, inner_rate = law(t, x, v)
        rate = A @ x[:4] + b[:, 0] * v
        rate[2:] += np.linalg.solve(M, [torque[0] + torque[1], torque[1] + torque[2]])
        return np.concatenate([rate, inner_rate])

    x, out = np.concatenate([np.zeros(4), inner]), []
    for k in range(0, u.size, hold):
        out.append(x)
        times = (k * TS, (k + hold) * TS)
        x = solve_ivp(f, times, x, "DOP853", args=(u[k],), rtol=1e-10, atol=1e-12).y[:, -1]
    return np.array(out)


# Voltage path.


def test_lag_is_one_more_state():
    plant, time, u = p.Plant(), 0.006, noise(1500)
    A, b = linear(plant)
    wide = np.block([[A, b], [np.zeros((1, 4)), -np.ones((1, 1)) / time]])
    system = (wide, np.eye(5)[:, 4:] / time, np.eye(5), np.zeros((5, 1)))
    _, x, _ = lsim(system, u, TS * np.arange(u.size), interp=False)
    y = p.simulate(plant, laws({("lag", "input"): {"time": time}}), u, TS)
    np.testing.assert_allclose(y, x[:, :4], atol=3e-6)
    assert np.abs(y - p.simulate(plant, NONE, u, TS)).max() > 0.05


def test_delay_by_whole_samples_shifts_the_input():
    given = {("delay", "input"): {"time": 3 * TS}, ("coulomb", "hub"): {"level": 0.03}}
    u = noise(1000)
    late = np.concatenate([np.zeros(3), u[:-3]])
    friction = laws({("coulomb", "hub"): {"level": 0.03}})
    once, again = p.simulate(p.Plant(), laws(given), u, TS), p.simulate(p.Plant(), friction, late, TS)
    np.testing.assert_array_equal(once, again)


@pytest.mark.parametrize("time", [0.0045, 1.234567e-3])
def test_delay_changes_the_voltage_between_samples(time):
    plant, u = p.Plant(), noise(1000)
    A, b = linear(plant)
    wide = np.block([[A, b], [np.zeros((1, 5))]])
    whole, part = int(time // TS), time % TS
    first, second = expm(wide * part)[:4], expm(wide * (TS - part))[:4]
    late, x, exact = np.concatenate([np.zeros(whole + 1), u]), np.zeros(4), []
    for k in range(u.size):
        exact.append(x)
        x = second @ [*(first @ [*x, late[k]]), late[k + 1]]
    y = p.simulate(plant, laws({("delay", "input"): {"time": time}}), u, TS)
    np.testing.assert_allclose(y, exact, atol=3e-6)


def test_the_voltage_is_bent_before_it_is_late():
    """Offset and dead zone act on the voltage before the delay."""
    path = {
        ("dead_zone", "input"): {"width": 0.2},
        ("voltage_offset", "input"): {"offset": 0.3},
        ("delay", "input"): {"time": 2 * TS},
    }
    u = noise(300)
    shifted = np.concatenate([np.zeros(2), u[:-2]]) + 0.3
    bent = np.sign(shifted) * np.maximum(np.abs(shifted) - 0.2, 0)
    both = p.simulate(p.Plant(), laws(path), u, TS), p.simulate(p.Plant(), NONE, bent, TS)
    np.testing.assert_allclose(*both, atol=1e-12)


# Torques without memory.


def test_cogging_is_a_potential():
    given = {
        ("cogging", "hub"): {"amplitude": 0.02, "phase": 0.6, "periods": 8.0},
        ("cogging", "arm"): {"amplitude": 0.03, "phase": -0.2, "periods": 5.0},
    }
    x = p.simulate(FREE, laws(given), np.zeros(1000), TS, start=(0.5, 0.1, 1.0, -2.0))
    theta, arm = x[:, 0], x[:, 0] + x[:, 1]
    kinetic = (FREE.J_hub * x[:, 2] ** 2 + FREE.J_arm * (x[:, 2] + x[:, 3]) ** 2) / 2
    cogs = -0.02 / 8 * np.cos(8 * theta + 0.6) - 0.03 / 5 * np.cos(5 * arm - 0.2)
    energy = kinetic + FREE.K * x[:, 1] ** 2 / 2 + cogs
    assert np.ptp(cogs) > 0.005
    np.testing.assert_allclose(energy, energy[0], atol=1e-8)


def test_play_in_the_joint_carries_no_torque():
    play, speed = 0.006, 0.4
    x = p.simulate(
        FREE, laws({("joint_play", "joint"): {"play": play}}), np.zeros(15000), 1e-4, (0, 0, 1, speed)
    )
    inside = np.flatnonzero(np.abs(x[:, 1]) > play)[0]
    assert (x[:inside, 2] == 1.0).all()
    np.testing.assert_allclose(x[:inside, 3], speed, rtol=1e-12)
    # Half a period is half an oscillation of the spring and a gap of twice the play at constant speed.
    rate = np.sqrt(FREE.K * (1 / FREE.J_hub + 1 / FREE.J_arm))
    ups = np.flatnonzero((x[:-1, 1] < 0) & (x[1:, 1] >= 0))
    period = np.diff(ups[-5:]).mean() * 1e-4
    assert period == pytest.approx(2 * np.pi / rate + 4 * play / speed, abs=1e-4)
    assert np.abs(x[:, 1]).max() == pytest.approx(play + speed / rate, rel=1e-4)


# Torques with memory.


def rise(values: dict[str, float], s: float) -> float:
    return 1 + values["rise"] * np.exp(-((s / values["speed"]) ** 2)) if "rise" in values else 1.0


def state_rate(effect: str, v: dict[str, float], x: float, s: float) -> float:
    if effect == "bouc_wen":
        return s / v["width"] * (1 - abs(x) * (v["beta"] * np.sign(s * x) + 1 - v["beta"]))
    if effect == "slack_cable":
        return (s - abs(s) * x) / v["width"] - x / v["time"]
    return (s - abs(s) * x / rise(v, s)) / v["presliding"]


HYSTERETIC = [
    (e, port) for e, port in (*DEFAULTS, *OUTSIDE) if e in {"dahl", "lugre", "bouc_wen", "slack_cable"}
]


@pytest.mark.parametrize("place", HYSTERETIC, ids="@".join)
def test_hysteretic_torques_agree_with_scipy(place):
    effect, port = place
    values, u = parameters(place), noise(300, hold=30)
    at = ["hub", "arm", "joint"].index(port)

    def law(_, x, __):
        s = x[3] if port == "joint" else x[2]
        rate = state_rate(effect, values, x[4], s)
        f = np.zeros(3)
        f[at] = -values["level"] * x[4]
        if effect == "lugre":
            bristles = values["damping"] * np.exp(-((s / values["speed"]) ** 2))
            f[at] -= bristles * values["presliding"] * rate
        return f, np.array([rate])

    exact = integrated(p.Plant(), law, np.zeros(1), u, 30)
    course = p.course(p.Plant(), laws({place: values}), u, TS)
    np.testing.assert_allclose(course.motion[::30], exact[:, :4], atol=2e-5)
    np.testing.assert_allclose(course.motion[::30, :2], exact[:, :2], atol=2e-6)
    np.testing.assert_allclose(course.memory[::30], exact[:, 4:], atol=2e-4)
    assert np.abs(course.memory).max() > 0.5


@pytest.mark.parametrize("beta", [1.0, 0.5, 0.2])
def test_hysteresis_loop_has_its_area(beta):
    # The work of one steady cycle of a sine; the reference is a quadrature along a solution by scipy.
    values = {"level": 0.02, "width": 0.02, "beta": beta}
    row = laws({("bouc_wen", "joint"): values}).hysteresis[0]
    h, N = 1e-4, 10000
    speed = 0.06 * 2 * np.pi * np.cos(2 * np.pi * h * (np.arange(3 * N) + 0.5))
    x, work = 0.0, np.zeros(3 * N)
    for k, s in enumerate(speed):
        x, torque = build_up(row, x, s, h)
        work[k] = -torque * s * h

    def f(t, y):
        s = 0.06 * 2 * np.pi * np.cos(2 * np.pi * t)
        return [state_rate("bouc_wen", values, y[0], s), values["level"] * y[0] * s]

    y = solve_ivp(f, (0, 3), [0, 0], t_eval=[2, 3], rtol=1e-10, atol=1e-12, max_step=0.01).y
    assert work[2 * N :].sum() == pytest.approx(np.diff(y[1])[0], rel=1e-5)
    assert np.diff(y[1])[0] > 0.4 * 4 * 0.02 * 0.06


@pytest.mark.parametrize(
    "place", [q for q in HYSTERETIC if q[1] == "hub" and q[0] != "slack_cable"], ids="@".join
)
@pytest.mark.parametrize("sign", [1, -1])
def test_steady_turning_meets_the_full_level(place, sign):
    plant, values = p.Plant(), parameters(place)
    x = p.simulate(plant, laws({place: values}), np.full(2000, 0.4 * sign), TS)[-1]
    motor = plant.torque_per_volt * (0.4 * sign - plant.k_m * plant.K_g * x[2]) - plant.B_hub * x[2]
    assert sign * motor == pytest.approx(values["level"] * rise(values, x[2]), abs=1e-7)


def test_presliding_is_a_spring_until_it_slides():
    # The motor torque is a quarter of the level: the hub settles where the friction torque equals it.
    plant, values = p.Plant(K=0.0, B_joint=0.0), {"level": 0.04, "presliding": 0.01}
    volts = 0.01 / plant.torque_per_volt
    x = p.course(plant, laws({("dahl", "hub"): values}), np.full(2000, volts), TS)
    assert x.memory[-1, 0] == pytest.approx(0.25, abs=1e-6)
    assert np.ptp(x.motion[-200:, 0]) < 1e-8


# The motor.


def test_warm_motor_agrees_with_scipy():
    plant, values, u = p.Plant(), {"rate": 20.0, "time": 0.7}, 3 * noise(600, hold=30)
    gain, emf = plant.torque_per_volt, plant.k_m * plant.K_g

    def law(_, x, v):
        cold = gain * (v - emf * x[2])
        warm = cold / (1 + x[4])
        return np.array([warm - cold, 0, 0]), np.array([values["rate"] * cold * warm - x[4] / values["time"]])

    exact = integrated(plant, law, np.zeros(1), u, 30)
    course = p.course(plant, laws({("heating", "hub"): values}), u, TS)
    np.testing.assert_allclose(course.motion[::30], exact[:, :4], atol=2e-5)
    np.testing.assert_allclose(course.heat[::30], exact[:, 4], atol=1e-5)
    assert exact[:, 4].max() > 0.3


def test_a_stalled_motor_reaches_its_temperature():
    values = {"rate": 5.0, "time": 0.2}
    given = laws({("heating", "hub"): values, ("coulomb", "hub"): {"level": 1.0}})
    course = p.course(p.Plant(), given, np.full(1000, 2.0), TS)
    produced = values["rate"] * values["time"] * (2 * p.Plant().torque_per_volt) ** 2
    assert course.heat[-1] == pytest.approx((np.sqrt(1 + 4 * produced) - 1) / 2, abs=1e-5)
    assert (course.motion == 0).all()


# Oscillators.


@pytest.mark.parametrize("port", ["hub", "arm"])
def test_second_mode_has_the_eigenvalues_of_three_masses(port):
    plant, v = p.Plant(), parameters(("second_mode", port))
    course = p.course(plant, laws({("second_mode", port): v}), noise(1000, hold=1), TS)
    k = 0 if port == "hub" else 2
    x = np.column_stack([course.motion, course.modes[:, k : k + 2]])
    table = np.linalg.lstsq(np.column_stack([x[:-1], noise(1000, hold=1)[:-1]]), x[1:], rcond=None)[0]

    # Absolute angles of hub, arm and mass.
    rate = 2 * np.pi * v["frequency"]
    M = np.diag([plant.J_hub, plant.J_arm, v["inertia"]])
    joint, mass = np.array([1, -1, 0]), np.array([1, 0, -1] if port == "hub" else [0, 1, -1])
    K = plant.K * np.outer(joint, joint) + v["inertia"] * rate**2 * np.outer(mass, mass)
    D = plant.B_joint * np.outer(joint, joint)
    D = D + 2 * v["damping"] * rate * v["inertia"] * np.outer(mass, mass)
    D[0, 0] += plant.B_hub + plant.torque_per_volt * plant.k_m * plant.K_g
    A = np.block([[np.zeros((3, 3)), np.eye(3)], [-np.linalg.solve(M, K), -np.linalg.solve(M, D)]])
    found, exact = (np.sort_complex(np.linalg.eigvals(m)) for m in (table[:6].T, expm(A * TS)))
    np.testing.assert_allclose(found, exact, atol=1e-6)


# The gear.

PLAY = 0.011


def geared(u: np.ndarray, Ts: float, plant: p.Plant, start=(0.0, 0.0, 0.0, 0.0), play=PLAY, step=p.STEP):
    return p.course(plant, laws({("backlash", "hub"): {"play": play}}), u, Ts, start, step)


def test_the_rotor_flies_free_in_the_gap():
    plant = p.Plant(k_m=0.0)
    course = geared(np.full(200, 0.5), 1e-4, plant)
    t = 1e-4 * np.arange(200)
    a = 0.5 * plant.torque_per_volt / (ROTOR_SHARE * plant.J_hub)
    flying = t < np.sqrt(PLAY / a)
    assert flying.sum() > 100 and not flying.all()
    np.testing.assert_allclose(course.rotor[flying, 0], a * t[flying] ** 2 / 2, atol=1e-12)
    np.testing.assert_allclose(course.rotor[flying, 1], a * t[flying], atol=1e-10)
    assert (course.motion[flying] == 0).all() and (course.motion[~flying, 2] > 0).all()


def test_impact_keeps_momentum_and_takes_energy():
    # Only rotor and hub: the rotor moves freely, hits the hub once, and both move on together.
    plant = p.Plant(B_hub=0.0, B_joint=0.0, K=0.0, k_m=0.0)
    u = np.zeros(3000)
    u[:300] = 1.0
    course = geared(u, p.STEP, plant)
    J_r, J_h = ROTOR_SHARE * plant.J_hub, (1 - ROTOR_SHARE) * plant.J_hub
    rotor, hub = course.rotor[:, 1], course.motion[:, 2]
    momentum = J_r * rotor + J_h * hub
    pushed = plant.torque_per_volt * p.STEP * np.minimum(np.arange(3000), 300)
    np.testing.assert_allclose(momentum, pushed, atol=1e-12)
    after = np.flatnonzero(hub)[0]
    assert after > 300 and (rotor[after:] == hub[after:]).all()
    assert hub[-1] == pytest.approx(rotor[300] * ROTOR_SHARE, rel=1e-9)


def test_the_gap_is_never_exceeded():
    given = laws({("backlash", "hub"): {"play": PLAY}, ("coulomb", "hub"): {"level": 0.02}})
    course = p.course(p.Plant(), given, noise(4000), 5e-4)
    gap = course.rotor[:, 0] - course.motion[:, 0]
    assert np.abs(gap).max() <= PLAY / 2 + 1e-12
    touching = np.abs(np.abs(gap) - PLAY / 2) < 1e-14
    assert 0.2 < touching.mean() < 0.99 and gap.min() < 0 < gap.max()
    np.testing.assert_allclose(course.rotor[touching, 1], course.motion[touching, 2], atol=1e-9)


def test_no_play_is_no_gear():
    """With a play of 1e-9 rad, the gear gives the motion of the joint without backlash."""
    u = noise(1000)
    almost, none = geared(u, TS, p.Plant(), play=1e-9).motion, p.simulate(p.Plant(), NONE, u, TS)
    np.testing.assert_allclose(almost[:, :2], none[:, :2], atol=1e-7)


def gear_by_events(plant: p.Plant, u: np.ndarray, hold: int, Ts: float) -> np.ndarray:
    """Hub, deflection, rotor and their speeds by scipy, with contact and release as events."""
    J_r, J_h, J_a = ROTOR_SHARE * plant.J_hub, (1 - ROTOR_SHARE) * plant.J_hub, plant.J_arm
    gain, emf, half = plant.torque_per_volt, plant.k_m * plant.K_g, PLAY / 2

    def carried(x, v, side):
        """Accelerations of hub, arm and rotor, and the torque in the contact."""
        joint = plant.K * x[1] + plant.B_joint * x[4]
        motor, load = gain * (v - emf * x[5]), joint - plant.B_hub * x[3]
        if side == 0:
            return load / J_h, -joint / J_a, motor / J_r, 0.0
        common = (motor + load) / (J_h + J_r)
        return common, -joint / J_a, common, motor - J_r * common

    def f(_, x, v, side):
        hub, arm, rotor, _ = carried(x, v, side)
        return [x[3], x[4], x[5], hub, arm - hub, rotor]

    x, side, out = np.zeros(6), 0, []
    for k in range(0, u.size, hold):
        out.append(x)
        t, end, v = 0.0, hold * Ts, u[k]
        while t < end:
            if side and side * carried(x, v, side)[3] < 0:
                side = 0
            if side:
                events = [lambda _, x, v, side: side * carried(x, v, side)[3]]
            else:
                events = [lambda _, x, *__, w=w: half - w * (x[2] - x[0]) for w in (1, -1)]
            for event in events:
                event.terminal, event.direction = True, -1
            s = solve_ivp(f, (t, end), x, "DOP853", events=events, args=(v, side), rtol=1e-11, atol=1e-13)
            t, x = s.t[-1], s.y[:, -1].copy()
            if s.status == 1 and side:
                side = 0
            elif s.status == 1:
                side = 1 if s.t_events[0].size else -1
                x[3] = ROTOR_SHARE * x[5] + (1 - ROTOR_SHARE) * x[3]
                x[4] = x[4] + (s.y[3, -1] - x[3])
                x[2], x[5] = x[0] + side * half, x[3]
    return np.array(out)


def test_the_gear_agrees_with_an_event_driven_solver():
    plant, u = p.Plant(), noise(300, seed=2, hold=20)
    exact = gear_by_events(plant, u, 20, TS)
    course = geared(u, TS, plant)
    found = np.column_stack([course.motion[:, :2], course.rotor[:, 0]])[::20]
    np.testing.assert_allclose(found, exact[:, :3], atol=1e-5)
    assert np.abs(p.simulate(plant, NONE, u, TS)[::20, :2] - exact[:, :2]).max() > 2e-3


# Sensors.


def test_sensors_bend_what_they_read():
    given = {
        ("sensor_gain", "alpha"): {"error": 0.05},
        ("sensor_cubic", "alpha"): {"cubic": 6.0},
        ("rectifier", "alpha"): {"loss": 0.15},
        ("sensor_bias", "alpha"): {"bias": 0.01},
        ("sensor_cubic", "theta"): {"cubic": 0.02},
    }
    r = make_record(given, seconds=2.0)
    theta, alpha = r["state"][:, 0], r["state"][:, 1]
    bent = 1.05 * alpha + 6 * alpha**3
    bent = np.where(bent > 0, bent, 0.85 * bent) + 0.01
    np.testing.assert_allclose(r["clean"], np.column_stack([theta + 0.02 * theta**3, bent]), atol=1e-15)


def test_only_the_ratio_of_two_gains_shows():
    u, plant = noise(500), p.Plant()
    stronger = p.Plant(k_t=plant.k_t * 1.05, k_m=plant.k_m / 1.05)
    one = p.simulate(plant, NONE, u, TS)[:, :2] * [1.05, 1.0]
    other = p.simulate(stronger, NONE, u, TS)[:, :2] * [1.0, 1 / 1.05]
    np.testing.assert_allclose(one, other, atol=1e-12)
    assert EQUIVALENT["sensor_gain", "theta"] == {("sensor_gain", "alpha")}


# Effects outside the catalogue of the package.


def test_outside_effects_agree_with_scipy():
    elsewhere = {"patchy_friction", "slack_cable"}  # tested separately
    v = {place[0]: parameters(place) for place in OUTSIDE if place[0] not in elsewhere}
    plant, u = p.Plant(), noise(300, hold=30)

    def law(t, x, volts):
        motor = plant.torque_per_volt * (volts - plant.k_m * plant.K_g * x[2])
        worm, shake = v["worm"], v["shaking"]
        lost = motor * worm["loss"] * abs(x[2]) / (abs(x[2]) + worm["speed"])
        shaking = shake["amplitude"] * np.sin(2 * np.pi * shake["frequency"] * t)
        return np.array([-lost, shaking, -plant.K * v["drifting_spring"]["drift"] * t * x[1]]), np.zeros(0)

    given = {place: parameters(place) for place in OUTSIDE if place[0] in v}
    exact = integrated(plant, law, np.zeros(0), u, 30)
    np.testing.assert_allclose(p.simulate(plant, laws(given), u, TS)[::30], exact, atol=2e-5)


def test_patchy_friction_depends_on_the_angle():
    # A hub that turns alone: the energy lost is the integral of the friction level over the angle.
    plant, v = p.Plant(B_hub=0.0, B_joint=0.0, K=0.0, k_t=0.0), {"level": 0.04, "share": 0.8}
    x = p.simulate(plant, laws({("patchy_friction", "hub"): v}), np.zeros(100), TS, (0.3, 0.0, 9.0, 0.0))
    theta, energy = x[:, 0], plant.J_hub * x[:, 2] ** 2 / 2
    taken = 0.04 * (theta - 0.3 - 0.8 / 3 * (np.cos(3 * theta) - np.cos(0.9)))
    assert x[-1, 2] > 0.5
    np.testing.assert_allclose(energy[0] - energy, taken, atol=1e-6)


# All effects.


@pytest.mark.parametrize("place", [q for q in (*DEFAULTS, *OUTSIDE) if q[0] not in OLD], ids="@".join)
def test_halving_the_step_changes_nothing_that_an_encoder_sees(place):
    given = laws({place: parameters(place)})
    coarse, fine = (p.simulate(p.Plant(), given, noise(1000), TS, step=s) for s in (2e-5, 1e-5))
    # The tolerance is a tenth of the jitter of the encoder, and a fiftieth of its count.
    np.testing.assert_allclose(coarse[:, :2], fine[:, :2], atol=3e-5)


@pytest.mark.parametrize("place", OUTSIDE, ids="@".join)
def test_outside_effects_show_and_grow(place):
    clean, small, full = (
        make_record([place] if size else [], size=size, seed=1, seconds=2.0)["clean"]
        for size in (0.0, 0.3, 1.0)
    )
    weak, strong = (np.abs(x - clean).max() for x in (small, full))
    assert strong > max(3e-3, weak) and weak > 0


@pytest.mark.parametrize("place", DEFAULTS, ids="@".join)
def test_the_package_takes_the_hidden_parameters(place: Place):
    CATALOG[place[0]](at=place[1], **renamed(place, parameters(place)))
    assert SHAPES.get(place[0], set()) <= set(parameters(place))


def test_outside_effects_are_outside():
    assert not {effect for effect, _ in OUTSIDE} & set(CATALOG)
    worm = ("worm", "hub")
    assert scored([worm], [("quadratic_drag", "hub")], [[]], "unexplained")["verdict_right"]
    assert not scored([worm], [("quadratic_drag", "hub")], [[]], "found")["verdict_right"]
