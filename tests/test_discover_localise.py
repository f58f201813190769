"""Errors placed at some times, speeds or deflections are located there; evenly spread errors are not."""

import dataclasses

import numpy as np
import pytest
from scipy.signal import butter, lfilter, sosfilt

import rotflex_jax as rf
from rotflex_jax.discover import locate
from rotflex_jax.discover.localise import condition_sets, locate_in_windows, missing_acceleration
from rotflex_jax.errors import InputError
from rotflex_jax.joints import paper, xl330_pendulum
from rotflex_jax.recording import Recording

NOISE = {"theta": 1e-4, "alpha": 1e-4}


def smooth(rng: np.random.Generator, N: int, cutoff: float, Ts: float) -> np.ndarray:
    """Band-limited noise of unit standard deviation."""
    sos = butter(4, cutoff, fs=1 / Ts, output="sos")
    x = sosfilt(sos, rng.standard_normal(N + 2000))[2000:]
    return x / x.std()


def recording(seed: int = 0, N: int = 4000, Ts: float = 0.004, **named) -> Recording:
    """Random motion of a joint that is slow enough to reverse about once a second."""
    rng = np.random.default_rng(seed)
    theta, alpha = 0.5 * smooth(rng, N, 0.8, Ts), 0.1 * smooth(rng, N, 2.5, Ts)
    y = np.column_stack([theta, alpha]) + 1e-4 * rng.standard_normal((N, 2))
    return Recording(u=smooth(rng, N, 5.0, Ts), y=y, Ts=Ts, **named)


@pytest.fixture(scope="module")
def moving() -> Recording:
    return recording()


def white(rec: Recording, seed: int = 1, size: float = 1e-3) -> np.ndarray:
    return size * np.random.default_rng(seed).standard_normal((rec.N, 2))


def reversals(rec: Recording) -> np.ndarray:
    """Samples at which the hub reverses, by a moving average and not by the local polynomial of the code."""
    speed = np.gradient(np.convolve(rec.channel("theta"), np.ones(15) / 15, mode="same"))
    return np.flatnonzero(speed[1:] * speed[:-1] < 0) + 1


def test_reversals_are_named_with_their_time(moving) -> None:
    e = white(moving)
    near = np.zeros(moving.N, bool)
    for k in reversals(moving):
        near[k : k + 20] = True
    e[near, 0] *= 6.0
    first = locate(moving, e, moving.channels, NOISE)[0]
    assert (first.kind, first.channel) == ("reversal", "theta")
    assert "within 80 ms after the hub reverses" in first.statement
    truth = np.sum(e[near, 0] ** 2) / np.sum(e[:, 0] ** 2)
    assert first.share == pytest.approx(truth, abs=0.1)
    assert first.p_value < 0.01
    assert f"{100 * first.share:.0f} % of the theta error" in first.statement


@pytest.mark.parametrize(
    ("kind", "phrase", "where"),
    [
        ("deflection", "the deflection is beyond ±", lambda s, a: np.abs(a) > 0.15),
        ("deflection", "the deflection is above", lambda s, a: a > 0.12),
        ("speed", "the hub turns slower than", lambda s, a: np.abs(s) < 0.3),
        ("speed", "the hub turns backwards faster than", lambda s, a: s < -1.2),
    ],
)
def test_speed_and_deflection_are_named(moving, kind, phrase, where) -> None:
    speed = np.gradient(moving.channel("theta"), moving.Ts)
    speed = np.convolve(speed, np.ones(15) / 15, mode="same")
    e = white(moving)
    there = where(speed, moving.channel("alpha"))
    e[there, 1] *= 5.0
    found = [w for w in locate(moving, e, moving.channels, NOISE) if w.kind == kind]
    assert [w.channel for w in found] == ["alpha"]
    assert phrase in found[0].statement
    assert found[0].statement.endswith("of the time.")
    assert "deg" in found[0].statement


def test_a_carried_error_is_traced_to_where_it_arises(moving) -> None:
    # A torque error beyond 9 degrees is integrated twice: its effect is in all samples, but arises there.
    alpha = moving.channel("alpha")
    push = np.where(np.abs(alpha) > np.deg2rad(9), np.sign(alpha), 0.0)
    push = push - push.mean()
    drift = np.cumsum(np.cumsum(push)) * moving.Ts**2
    drift -= np.polynomial.polynomial.Polynomial.fit(moving.t, drift, 3)(moving.t)
    e = np.column_stack([drift, 0 * drift]) + 1e-5 * white(moving, size=1.0)
    found = [w for w in locate(moving, e, moving.channels, NOISE) if w.kind == "deflection"]
    assert found[0].channel == "theta"
    assert "of the theta error arises while the deflection is beyond ±" in found[0].statement
    assert found[0].share > 0.5


def test_restarted_runs_do_not_hide_where_an_error_arises(moving) -> None:
    e = white(moving)
    e[np.abs(moving.channel("alpha")) > 0.15, 0] *= 4.0
    starts = np.arange(0, moving.N, 500)
    for k in starts:  # every window starts with another error
        e[k : k + 500, 0] += 0.3 * (-1) ** (k // 500)
    told = locate(moving, e, moving.channels, NOISE, window_seconds=2.0)
    assert any("arises while the deflection is beyond" in w.statement for w in told)
    blind = locate(moving, e, moving.channels, NOISE)
    assert not any("arises while the deflection" in w.statement for w in blind)


def test_noise_at_standstill_is_no_reversal() -> None:
    N, Ts = 3000, 0.004
    t = Ts * np.arange(N)
    theta = np.where(t < 4.0, 0.3 * np.sin(np.pi * t), 0.0)  # turns at 0.5, 1.5, 2.5, 3.5 s, rests
    rng = np.random.default_rng(0)
    y = np.column_stack([theta, 0.1 * np.sin(9 * t)]) + 1e-3 * rng.standard_normal((N, 2))
    rec = Recording(u=np.sin(t), y=y, Ts=Ts)
    noise = {"theta": 1e-3, "alpha": 1e-3}
    view = next(v for v in condition_sets(rec, rec.channels, noise, None) if v.kind == "reversal")
    just_after = np.flatnonzero(np.diff(view.bins, prepend=view.bins[0]) < 0)
    # A fifth one is possible at the abrupt stop, where the smoothed speed overshoots.
    assert rec.t[just_after[:4]] == pytest.approx([0.5, 1.5, 2.5, 3.5], abs=0.03)
    assert len(just_after) <= 5


def test_time_is_named(moving) -> None:
    e = white(moving)
    e[3000:, 1] *= 3.0
    found = [w for w in locate(moving, e, moving.channels, NOISE) if w.kind == "time"]
    assert [w.channel for w in found] == ["alpha"]
    assert found[0].share == pytest.approx(0.75, abs=0.03)
    assert "after 12.0 s, which is 25 % of the recording" in found[0].statement
    assert found[0].profile.sum() == pytest.approx(1.0)
    assert found[0].edges[[0, -1]] == pytest.approx([0.0, moving.duration])


def test_a_band_and_an_offset_are_named(moving) -> None:
    e = white(moving)
    e[:, 0] += 3e-3 * np.sin(2 * np.pi * 7.0 * moving.t)
    e[:, 1] += np.deg2rad(0.25)
    told = {w.channel: w for w in locate(moving, e, moving.channels, NOISE) if w.kind == "frequency"}
    assert "lies between 5 and 10 Hz" in told["theta"].statement
    assert "is a constant offset of 0.25 deg" in told["alpha"].statement
    assert told["theta"].expected.sum() == pytest.approx(1.0)
    assert told["theta"].expected[told["theta"].edges[:-1] == 5.0] == pytest.approx(
        5.0 / (0.5 / moving.Ts), rel=0.02
    )


def test_physical_places_come_before_frequencies(moving) -> None:
    e = np.column_stack([smooth(np.random.default_rng(2), moving.N, 4.0, moving.Ts)] * 2)
    e[np.abs(moving.channel("alpha")) > 0.15] *= 5.0
    kinds = [w.kind for w in locate(moving, e, moving.channels, NOISE)]
    assert kinds[0] == "deflection"
    assert kinds == sorted(kinds, key=lambda kind: kind == "frequency")


@pytest.mark.parametrize("tau", [0.0, 0.05])
def test_an_error_that_is_nowhere_is_found_nowhere(tau) -> None:
    rng = np.random.default_rng(3)
    runs, false = 60, 0
    for seed in range(runs):
        rec = recording(seed, N=1500, Ts=0.01)
        a = np.exp(-rec.Ts / tau) if tau else 0.0
        e = lfilter([1.0], [1.0, -a], rng.standard_normal((rec.N + 500, 2)), axis=0)[500:]
        told = locate(rec, 1e-3 * e, rec.channels, NOISE)
        # Coloured noise has more power at low frequencies than white sensor noise, which is no false alarm.
        found = [w for w in told if len(w.edges) and w.kind != "frequency"]
        false += bool(found)
    assert false <= 6  # of 60; seven or more have a probability of 3 % at the nominal 5 %


def test_p_values_are_uniform_without_a_place(moving) -> None:
    from rotflex_jax.discover.localise import in_conditions, in_frequency, in_time

    rec = recording(5, N=1200, Ts=0.01)
    sorted_by = condition_sets(rec, rec.channels, NOISE, None)
    assert [v.kind for v in sorted_by] == ["speed", "deflection", "reversal"]
    rng = np.random.default_rng(4)
    p: dict[str, list[float]] = {}
    for _ in range(150):
        e = rng.standard_normal(rec.N)
        correlated = lfilter([1.0], [1.0, -0.9], rng.standard_normal(rec.N + 200))[200:]
        found = [in_time("theta", e, rec), in_frequency("theta", e, rec, "rad")]
        found += [in_conditions("theta", {"lies": correlated**2}, one) for one in sorted_by]
        for share in found:
            p.setdefault(share.where.kind, []).append(share.where.p_value)
    for kind, values in p.items():
        below = [np.mean(np.array(values) <= level) for level in (0.05, 0.2, 0.5)]
        # Three standard deviations of 150 draws.
        assert below[0] <= 0.05 + 0.054, kind
        assert below[1] <= 0.2 + 0.1, kind
        assert 0.5 - 0.125 <= below[2] <= 0.5 + 0.125, kind


def test_evenly_spread_is_said_in_one_statement(moving) -> None:
    told = locate(moving, white(moving, size=1e-4), moving.channels, NOISE)
    assert len(told) == 1
    assert "evenly" in told[0].statement
    assert "no larger than the noise" in told[0].statement
    assert told[0].p_value == 1.0
    larger = locate(moving, white(moving, size=1e-2), moving.channels, NOISE)
    assert "no larger" not in larger[0].statement


def test_names_and_ports_of_another_machine() -> None:
    rec = recording(channels=("motor", "load"))
    e = white(rec)
    e[np.abs(rec.channel("load")) > 0.15, 0] *= 5.0
    noise = {"motor": 1e-4, "load": 1e-4}
    told = locate(rec, e, rec.channels, noise)[0].statement
    assert "of the motor error" in told
    assert "while load is beyond ±" in told
    rec = recording()
    by_mechanism = [
        v.phrases for v in condition_sets(rec, ("theta", "alpha"), noise, paper()) if v.kind == "speed"
    ]
    assert "while the hub turns forwards" in by_mechanism[0]


def test_one_channel_and_noise_as_an_array() -> None:
    both = recording()
    rec = Recording(u=both.u, y=both.channel("theta"), Ts=both.Ts)
    e = white(rec)[:, 0]
    e[np.abs(rec.channel("theta")) > 0.8] *= 5.0
    told = locate(rec, e, ("theta",), np.array([1e-4]))
    assert told[0].kind == "deflection"
    assert "while theta is beyond ±" in told[0].statement


@pytest.mark.parametrize("named", [True, False], ids=["by the machine", "by its unit"])
@pytest.mark.parametrize("place", [0, 1])
def test_a_current_is_no_motion(place: int, named: bool) -> None:
    """Beside a current, which may be any channel, speed and deflection are those of the angle alone."""
    both = recording()
    rng = np.random.default_rng(5)
    current, theta = smooth(rng, both.N, 3.0, both.Ts), both.channel("theta")
    order = [theta, current] if place else [current, theta]
    names, units = ("theta", "current"), ("rad", "A")
    names, units = (names, units) if place else (names[::-1], units[::-1])
    rec = Recording(u=both.u, y=np.column_stack(order), Ts=both.Ts, channels=names, units=units)
    e = 1e-3 * rng.standard_normal((rec.N, 2))
    slow = np.abs(np.gradient(theta, rec.Ts)) < 0.5
    e[slow] *= 6.0
    machine = xl330_pendulum() + rf.effects.CurrentMeter("hub")
    outputs = {c: ("hub", "current") if c == "current" else "hub" for c in names}
    machine = dataclasses.replace(machine, outputs=outputs) if named else None
    told = locate(rec, e, names, dict.fromkeys(names, 1e-4), machine)
    conditions = [v for v in told if v.kind in ("speed", "deflection", "reversal")]
    assert {v.channel for v in conditions} == set(names)
    for v in conditions:
        assert " A" not in v.statement and "current moves" not in v.statement
        assert v.channel != "current" or "arises" not in v.statement  # its error is not integrated
    assert any("while the hub turns slower than" in v.statement for v in conditions)
    # A recording without a position or speed has no conditions.
    alone = Recording(u=both.u, y=current, Ts=both.Ts, channels="current", units="A")
    assert condition_sets(alone, ("current",), {"current": 1e-4}, None) == ()


def test_a_speed_beside_an_angle_does_not_deflect() -> None:
    rec = recording()
    theta, speed = rec.channel("theta"), np.gradient(rec.channel("theta"), rec.Ts)
    for names, units, y in (
        (("theta", "gyro"), ("rad", "rad/s"), [theta, speed]),
        (("gyro", "theta"), ("rad/s", "rad"), [speed, theta]),
    ):
        both = Recording(u=rec.u, y=np.column_stack(y), Ts=rec.Ts, channels=names, units=units)
        (found,) = [
            v for v in condition_sets(both, names, dict.fromkeys(names, 1e-4), None) if v.kind == "deflection"
        ]
        assert all("theta" in phrase and "/s" not in phrase for phrase in found.phrases)
    alone = Recording(u=rec.u, y=speed, Ts=rec.Ts, channels="gyro", units="rad/s")
    kinds = [v.kind for v in condition_sets(alone, ("gyro",), {"gyro": 1e-4}, None)]
    assert "deflection" not in kinds and "speed" in kinds


def test_the_error_of_a_speed_arises_with_its_first_derivative() -> None:
    """Steps of the error at reversals decay slowly, so the error is everywhere but arises at reversals."""
    both = recording()
    speed = smooth(np.random.default_rng(6), both.N, 0.8, both.Ts)
    rec = Recording(u=both.u, y=speed, Ts=both.Ts, channels="tacho", units="rad/s")
    kicks = np.zeros(rec.N)
    kicks[np.flatnonzero(speed[1:] * speed[:-1] < 0) + 5] = 1e-3 * np.random.default_rng(7).choice(
        [-1.0, 1.0]
    )
    error = lfilter([1.0], [1.0, -0.999], kicks)
    (told, *_) = locate(rec, error, ("tacho",), [1e-6])
    assert told.kind == "reversal" and "arises within" in told.statement
    energy, seen = missing_acceleration(error, rec, order=1)
    share = np.sum(energy[seen] ** 2 * (np.abs(speed[seen]) < 0.3)) / np.sum(energy[seen] ** 2)
    assert share > 0.9


@pytest.mark.parametrize("size", [0.0, 1e-3])
def test_a_recording_at_rest_gives_one_finite_statement(size) -> None:
    u = np.random.default_rng(0).standard_normal(300)
    rec = Recording(u=u, y=np.zeros((300, 2)), Ts=0.002, accept=("constant",))
    told = locate(rec, size * white(rec, size=1.0), rec.channels, NOISE)
    assert len(told) == 1
    assert np.isfinite([told[0].share, told[0].p_value]).all()


def test_a_very_short_recording_is_no_fault() -> None:
    rec = recording(N=60, Ts=0.02)
    assert locate(rec, white(rec), rec.channels, NOISE)


def test_what_does_not_fit_is_refused(moving) -> None:
    with pytest.raises(InputError, match=r"4000 samples and 2 channels.*\(10, 2\)"):
        locate(moving, np.zeros((10, 2)), moving.channels, NOISE)
    bad = white(moving)
    bad[7, 0] = np.nan
    with pytest.raises(InputError, match="1 of them not finite"):
        locate(moving, bad, moving.channels, NOISE)


def test_runs_that_diverge_are_said_to(moving) -> None:
    model = rf.Model(rf.joints.paper())
    runs = np.zeros((moving.N, 2))
    runs[50:, 1] = np.inf
    (told,) = locate_in_windows(model, moving, runs, np.full(2, 1e-3), 2.0)
    assert "diverge" in told.statement and told.p_value == 1.0
