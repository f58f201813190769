"""The arena's feedback loop against solve_ivp, and its recordings of wrong worlds."""

import dataclasses
import json

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import expm
from scipy.signal import lfilter

import rotflex_jax as rf
from arena.wrong_seeds import REPORT, TUNING
from arena.wrong_table import publish_worlds, summary
from arena.wrong_trial import marks, told
from rotflex_jax.arena.simulator.closed_loop import COUNT, Sensors, recorded
from rotflex_jax.arena.simulator.control import KINDS, LIMIT, Controller, designed, square, textbook
from rotflex_jax.arena.simulator.laws import laws
from rotflex_jax.arena.simulator.plant import Plant, simulate
from rotflex_jax.arena.simulator.records import make_record
from rotflex_jax.arena.simulator.seen import distinctness
from rotflex_jax.arena.simulator.voltage import Path, supply
from rotflex_jax.arena.wrong_worlds import HIDDEN, VISIBLE, _hides, _modes, world

Ts = 0.002
PD = Controller("pd_theta", (8.0, 0.0, 0.4, 0.0), 40.0)


def test_textbook_matrices_are_the_plant_without_laws():
    plant, u = Plant(), 3.0
    A, b = textbook(plant)
    x = simulate(plant, laws({}), np.full(300, u), Ts)
    M = np.zeros((5, 5))
    M[:4, :4], M[:4, 4] = A, b * u
    for k in (1, 30, 299):
        np.testing.assert_allclose(x[k], expm(M * k * Ts)[:4, 4], rtol=2e-6, atol=1e-9)


@pytest.mark.parametrize("kind", KINDS)
def test_designed_loops_settle_on_the_textbook_model(kind):
    rng = np.random.default_rng(3)
    for _ in range(5):
        controller = designed(kind, Plant(), rng)
        loop = recorded(Plant(), laws({}), Sensors(), controller, np.full(3000, 0.3), Ts, rng)
        assert abs(loop.y[-500:, 0] - 0.3).max() < 0.02 and abs(loop.y[-500:, 1]).max() < 0.02


def test_motion_under_feedback_is_that_of_solve_ivp():
    """With two more modes, a torque around one position and one over time, under the recorded voltage."""
    plant = Plant(B_joint=0.001)
    hub = {"inertia": 4e-4, "frequency": 15.0, "damping": 0.02}
    arm = {"inertia": 3e-4, "frequency": 30.0, "damping": 0.01}
    push = {"amplitude": 0.02, "centre": 0.2, "width": 0.15}
    places = {("second_mode", "hub"): hub, ("second_mode", "arm"): arm, ("push", "hub"): push}
    N = 600
    torque = 0.01 * np.sin(np.arange(N) / 60)
    rng = np.random.default_rng(0)
    loop = recorded(plant, laws(places), Sensors(), PD, square(N, Ts, rng), Ts, rng, torque)
    assert loop.y[:, 0].max() > 0.2 and np.abs(loop.u).max() > 2.0

    gain, emf = plant.torque_per_volt, plant.torque_per_volt * plant.k_m * plant.K_g
    k1, d1 = (2 * np.pi * hub["frequency"]) ** 2, 4 * np.pi * hub["damping"] * hub["frequency"]
    k2, d2 = (2 * np.pi * arm["frequency"]) ** 2, 4 * np.pi * arm["damping"] * arm["frequency"]

    def flow(_, x, drive):
        theta, beta, r1, r2, w, v, s1, s2 = x  # beta, r1, r2: absolute angles of arm and oscillators
        a1, a2 = k1 * (theta - r1) + d1 * (w - s1), k2 * (beta - r2) + d2 * (v - s2)
        joint = plant.K * (beta - theta) + plant.B_joint * (v - w)
        pushed = push["amplitude"] * np.exp(-(((theta - push["centre"]) / push["width"]) ** 2))
        dw = drive - (plant.B_hub + emf) * w + joint + pushed - hub["inertia"] * a1
        dv = -joint - arm["inertia"] * a2
        return [w, v, s1, s2, dw / plant.J_hub, dv / plant.J_arm, a1, a2]

    x, expected = np.zeros(8), []
    for u, d in zip(loop.u, torque, strict=True):
        expected.append([x[0], x[1] - x[0], x[2], x[3]])
        x = solve_ivp(flow, (0, Ts), x, args=(gain * u + d,), rtol=1e-10, atol=1e-12).y[:, -1]
    course = loop.course
    found = np.column_stack([course.motion[:, :2], course.modes[:, 0], course.modes[:, 2]])
    np.testing.assert_allclose(found, expected, atol=2e-6)


def test_recorded_voltage_is_what_the_controller_makes_of_the_recorded_angles():
    controller = Controller("lqr", (9.0, -7.0, 0.5, 0.3), 30.0)
    rng = np.random.default_rng(1)
    reference = square(1500, Ts, rng)
    loop = recorded(
        Plant(), laws({("coulomb", "hub"): {"level": 0.03}}), Sensors(), controller, reference, Ts, rng
    )
    keep = np.exp(-2 * np.pi * 30.0 * Ts)
    rates = lfilter([(1 - keep) / Ts, -(1 - keep) / Ts], [1, -keep], loop.y, axis=0)
    wanted = 9.0 * (reference - loop.y[:, 0]) + 7.0 * loop.y[:, 1] - rates @ [0.5, 0.3]
    np.testing.assert_allclose(loop.u, np.clip(wanted, -LIMIT, LIMIT), atol=1e-6)
    counts = loop.y / COUNT
    np.testing.assert_allclose(counts, np.round(counts), atol=1e-6)
    assert abs(loop.y - loop.clean).max() <= COUNT / 2 + 1e-12


def test_a_stuck_hub_rests_under_a_voltage_that_friction_holds():
    rng, level = np.random.default_rng(2), 0.08
    controller = Controller("pd_theta", (4.0, 0.0, 0.1, 0.0), 40.0)
    places = {("coulomb", "hub"): {"level": level}, ("coulomb", "joint"): {"level": 0.004}}
    loop = recorded(Plant(), laws(places), Sensors(), controller, np.full(2500, 0.4), Ts, rng)
    rest = loop.course.motion[-500:]
    held = Plant().torque_per_volt * abs(loop.u[-1])
    assert np.ptp(rest[:, 0]) == 0.0 and np.all(rest[:, 2] == 0.0)
    assert 0.01 < held < level + 0.004 + Plant().K * abs(rest[-1, 1])


def test_voltage_sample_by_sample_is_the_voltage_of_a_whole_record():
    tables = laws(
        {
            ("saturation", "input"): {"limit": 1.5},
            ("voltage_offset", "input"): {"offset": 0.1},
            ("dead_zone", "input"): {"width": 0.2},
            ("delay", "input"): {"time": 0.00331},
            ("lag", "input"): {"time": 0.004},
        }
    )
    u = np.random.default_rng(0).uniform(-3, 3, 40)
    for volts in (tables.volts, laws({("delay", "input"): {"time": 0.0005}}).volts, laws({}).volts):
        path = Path(volts, 100, 2e-5)
        np.testing.assert_allclose([path(v) for v in u], supply(u, volts, 100, 2e-5), atol=1e-14)


def test_what_is_between_angle_and_reading():
    """A reading contains shares of modes, cross-talk, a delay, and noise of known standard deviation."""
    places = {("second_mode", "hub"): {"inertia": 4e-4, "frequency": 15.0, "damping": 0.02}}
    rng = lambda: np.random.default_rng(0)  # noqa: E731
    run = lambda s: recorded(Plant(), laws(places), s, PD, np.full(200, 0.3), Ts, rng())  # noqa: E731
    sensors = Sensors(modes=(0.5, 0.0), crosstalk=0.01, late=1)
    loop = run(sensors)
    theta, alpha = loop.course.motion[:, :2].T
    strain = alpha + 0.5 * (loop.course.modes[:, 0] - theta)
    expected = strain + 0.01 * theta
    np.testing.assert_allclose(loop.clean[:, 0], theta, atol=1e-15)
    np.testing.assert_allclose(loop.clean[1:, 1], expected[:-1], atol=1e-15)
    assert abs(strain - alpha).max() > 1e-3
    noisy = dataclasses.replace(sensors, noise=(0.0, 0.01))
    error = (run(noisy).y - run(noisy).clean).std(axis=0)
    np.testing.assert_allclose(error, noisy.deviation(), rtol=0.2)


@pytest.mark.parametrize("link", [True, False])
def test_a_gauge_shows_no_oscillator_that_is_not_there(link):
    """An absent oscillator has the state 0: a gauge with a share of it would show the angle of the port."""
    drawn = [_modes(np.random.default_rng(seed), link).values for seed in range(40)]
    assert {tuple(d["modes"]) for d in drawn} == ({("hub",), ("hub", "arm")} if link else {("arm",)})
    for d in drawn:
        shown = dict(zip(("hub", "arm"), d["shown"], strict=True))
        assert {port for port, share in shown.items() if share} == (set(d["modes"]) if link else set())


def test_only_what_other_constants_cannot_imitate_is_visible():
    rng = np.random.default_rng(5)
    runs = {}
    for name, place, values in (
        ("damper", ("viscous", "hub"), {"coefficient": 0.004}),
        ("friction", ("coulomb", "hub"), {"level": 0.02}),
    ):
        true, bare = laws({place: values}), laws({})
        loop = recorded(Plant(), true, Sensors(), PD, square(2000, Ts, rng), Ts, rng).after(100)
        runs[name] = max(distinctness(Plant(), true, bare, Sensors(), loop, Ts))
        assert distinctness(Plant(), true, true, Sensors(), loop, Ts) == (0.0, 0.0)
    assert runs["damper"] < 2.0 < VISIBLE < runs["friction"]


def test_a_row_of_worlds_hides_every_effect():
    assert not set(TUNING) & set(REPORT)
    for seeds in (TUNING, REPORT):
        hidden = [_hides(s) for s in seeds[:48]]
        assert {p for kind, p in hidden if kind == "joint"} - {None} == set(HIDDEN)
        assert {p for kind, p in hidden if kind == "link"} >= {("lugre", "hub"), ("coulomb", "hub"), None}
    for place in HIDDEN:
        make_record({place: dict.fromkeys(HIDDEN[place], 0.01)}, seconds=0.05)  # the plant accepts the names


@pytest.mark.parametrize("seed", [404, 405])
def test_a_world_is_three_runs_of_one_machine_and_always_the_same(seed):
    w, again = world(seed), world(seed)
    assert w.kind == ("link" if seed == 405 else "joint")
    runs = (w.train, w.validation, w.test)
    for a, b in zip(runs, (again.train, again.validation, again.test), strict=True):
        np.testing.assert_array_equal(a.u, b.u)
        np.testing.assert_array_equal(a.y, b.y)
        assert np.abs(a.u).max() <= LIMIT and a.Ts in (0.001, 0.002) and 4.9 < a.N * a.Ts < 10.1
    controllers = {r["controller"]["kind"] for r in w.truth["runs"].values()}
    offsets = next(b.values for b in w.besides if b.name == "voltage_offset")
    assert controllers == set(KINDS) and len(set(offsets.values())) == 3
    assert all(max(seen) >= VISIBLE for seen in w.visible.values()) and set(w.visible) == {
        "train",
        "validation",
    }
    assert len(w.besides) >= 3
    json.dumps(told(w))  # can be stored in a row of results
    assert w.model.free_names == rf.joints.paper().free_names
    assert w.truth["plant"]["R_m"] != Plant.R_m  # a trusted parameter of the model


def test_marks_of_a_world():
    hub, play = ("coulomb", "hub"), ("backlash", "hub")
    found = lambda e, p, status="established", same=(): {  # noqa: E731
        "effect": e,
        "port": p,
        "status": status,
        "equivalent": list(same),
    }
    names = [(("voltage_offset", "input"),), (play,), ()]
    offset = found("voltage_offset", "input")
    right = marks(hub, names, [offset, found(*hub)])
    assert right["named"] and right["first"] and right["named_established"] and not right["wrong_established"]
    listed = marks(hub, names, [found("stribeck", "hub", "provisional", [["coulomb", "hub"]])])
    assert listed["named"] and not listed["named_established"] and not listed["wrong_provisional"]
    late = marks(hub, names, [found("lag", "input"), found("delay", "input", "provisional"), found(*hub)])
    assert late["named"] and not late["first"]
    assert late["wrong_established"] == [["lag", "input"]]
    assert late["wrong_provisional"] == [["delay", "input"]]
    nothing = marks(None, names, [found(*play), found(*hub)])
    assert nothing["named"] is None and nothing["wrong_established"] == [["coulomb", "hub"]]


def test_page_of_worlds(tmp_path):
    error = {"theta": 0.02, "alpha": None}
    kinds = ("whole", "windows", "whole_calibrated", "windows_calibrated")
    stages = {stage: dict.fromkeys(kinds, error) for stage in ("baseline", "final")}
    stages["final"] |= {k: {"theta": 9.0, "alpha": 9.0} for k in kinds[:2]}  # not calibrated: not on the page
    rounds = [{"effect": "coulomb", "port": "hub", "equivalent": [], "status": "provisional"}]
    row = {
        "world": 300,
        "kind": "link",
        "hidden": ["coulomb", "hub"],
        "besides": [{"name": "gauge_gain"}],
        "rounds": rounds,
        "verdict": "found",
        "wall_s": 1.0,
        "cpu_s": 1.0,
        "errors": {"validation": stages, "test": stages},
        **marks(("coulomb", "hub"), [], rounds),
    }
    failed = {"world": 301, "error": "x", "lines": []}
    (page,) = publish_worlds([row, failed], tmp_path / "B0_wrong_worlds.json")
    text = page.read_text()
    assert "| link with gauge | 1 | 1/1 | 0/1 | 1/1 | 0 in 0/1 worlds |" in text and "world 301: x" in text
    assert "(coulomb@hub)" in text and text.count("1.15 / - -> 1.15 / -") == 3 and "515" not in text
    # Worlds whose results were read before a revision of the search are summed separately.
    (page,) = publish_worlds([row, {**row, "world": 3012}], tmp_path / "B0_wrong_worlds.json")
    first, second = page.read_text().split("Worlds 3000 to 3069, which were read before")
    for part in (first, second):
        assert part.count("| link with gauge | 1 | 1/1 | 0/1 | 1/1 | 0 in 0/1 worlds |") == 1
    assert "no revision of the search had seen when they were run" in first and "3000 to 3069" not in text
    assert "failed 1" in summary([row, failed])
    assert publish_worlds([failed], tmp_path / "no.json") == []
