"""Each limit of the rule that ends a search, from both sides; the limits are written out here."""

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from rotflex_jax.discover import conclusion
from rotflex_jax.discover.conclusion import end_state, proposed, seen_limits, window_sizes
from rotflex_jax.discover.supermodel import EffectLocation
from rotflex_jax.discover.verdict import Assessment, Grade, Verdict, assess, grade
from rotflex_jax.recording import Recording

SAMPLES = 1000  # of each of the two channels
NEAR = 1.5  # times the noise of the sensor


def told(
    *,
    before: float = 100.0,
    ratio: float = 1.0,
    noise_nats: float = 0.0,
    rounds: tuple[tuple[str, ...], ...] = (),
    excited: int = 4,
    candidates: int = 4,
) -> tuple[Verdict, str]:
    """Verdict and sentence of a search that ended so near to the noise, with equivalents of each round."""
    floor = {"theta": 5e-4, "alpha": 2e-3}
    errors = {"theta": 5e-4, "alpha": 2e-3 * ratio}
    baseline: Any = SimpleNamespace(held_out_rmse_windows={c: before * e for c, e in errors.items()})
    final: Any = SimpleNamespace(
        held_out_rmse_windows=errors, process_noise_nats=noise_nats, window_seconds=2.0
    )
    found: Any = [SimpleNamespace(effect="coulomb", port="hub", equivalent=others) for others in rounds]
    ranking: Any = [SimpleNamespace(excited=k < excited) for k in range(candidates)]
    recordings: Any = [SimpleNamespace(N=SAMPLES // 2)] * 2
    return end_state(baseline, found, final, floor, ranking, recordings)


def ended(**given: Any) -> Verdict:
    """The verdict alone."""
    return told(**given)[0]


@pytest.mark.parametrize(("share", "explained"), [(0.999, True), (1.001, False)])
@pytest.mark.parametrize("rounds", [(), ((),)])
def test_explained_is_near_the_noise_of_every_sensor(share: float, explained: bool, rounds: Any) -> None:
    verdict = ended(ratio=NEAR * share, rounds=rounds)
    good = Verdict.FOUND if rounds else Verdict.NOTHING_MISSING
    assert verdict == (good if explained else Verdict.UNEXPLAINED)


@pytest.mark.parametrize(("share", "explained"), [(0.999, True), (1.001, False)])
def test_explained_leaves_little_to_process_noise(share: float, explained: bool) -> None:
    # 0.07 nat for each measured value, those of both channels.
    verdict = ended(noise_nats=0.07 * 2 * SAMPLES * share)
    assert verdict == (Verdict.NOTHING_MISSING if explained else Verdict.UNEXPLAINED)


def test_one_round_that_others_equal_makes_the_end_ambiguous() -> None:
    assert ended(rounds=((), ("stribeck",))) == Verdict.AMBIGUOUS
    assert ended(rounds=((), ())) == Verdict.FOUND


def test_more_than_half_of_the_candidates_must_have_shown() -> None:
    assert ended(excited=2, candidates=4) == Verdict.NOTHING_MISSING
    assert ended(excited=1, candidates=4) == Verdict.NOT_EXCITED
    assert ended(excited=2, candidates=5) == Verdict.NOT_EXCITED
    assert ended(excited=0, candidates=0) == Verdict.NOTHING_MISSING


@pytest.mark.parametrize(
    ("times", "expected"),
    [(1.499, Grade.NOISE), (1.5, Grade.NEAR), (4.99, Grade.NEAR), (5.0, Grade.FAR), (math.nan, None)],
)
def test_the_grade_of_an_error(times: float, expected: Grade | None) -> None:
    assert grade(times) is expected
    # That of the channel which is furthest, of those whose noise is known.
    assert Assessment({}, {"theta": times, "alpha": 0.5, "beta": math.nan}, 0.0).grade is (
        expected or Grade.NOISE
    )


def test_a_sensor_of_unknown_noise_leaves_the_verdict_open() -> None:
    unknown = Assessment({}, {"theta": math.nan, "alpha": 1.0}, 0.0)
    assert not unknown.is_explained and "noise of theta is not known" in unknown.criterion
    worse = Assessment({}, {"theta": math.nan, "alpha": 7.0, "beta": 6.0}, 0.0)
    assert "the error of alpha in short runs is above 1.5" in worse.criterion
    assert Assessment({}, {"theta": math.nan}, 0.0).grade is None
    assert "ask for no random torque" in Assessment({}, {"theta": 1.0}, 0.0).criterion


def test_shares_and_nats_of_nothing_are_no_numbers() -> None:
    end = assess({"theta": 0.0, "alpha": 2.0}, {"theta": 0.1, "alpha": 1.0}, {}, 5.0, 10)
    assert math.isnan(end.explained["theta"]) and end.explained["alpha"] == 75.0
    assert end.torque_nats == 0.5  # without a floor as for one channel
    assert end.explained_text == "alpha 75.0 % of the baseline's squared error is explained"
    assert math.isnan(assess({}, {}, {"theta": 0.1}, 5.0, 0).torque_nats)
    written = end.to_dict()
    assert written["explained_percent"] == {"theta": None, "alpha": 75.0}
    assert written["remaining_over_noise"] == {"theta": None, "alpha": None}
    assert assess({}, {}, {}, 5.0, 0).to_dict()["random_torque_nats_per_value"] is None


def test_candidates_that_could_not_have_shown_are_a_step() -> None:
    said = "2 of 9 candidates could not have shown here"
    for verdict in Verdict:
        steps = verdict.next_steps([("friction", "lag"), ("play", "delay")], 2, 9)
        assert any(said in s for s in steps) is (verdict is not Verdict.NOT_EXCITED)
        assert not any("candidates could not" in s for s in verdict.next_steps([], 0, 9))
        pairs = [s for s in steps if "friction from lag" in s or "play from delay" in s]
        assert len(pairs) == (2 if verdict is Verdict.AMBIGUOUS else 0)


def test_the_machine_has_borne_the_most_of_any_recording() -> None:
    """Of voltage, slew and deflection each for itself."""
    k = np.arange(60)
    slow, quick = (np.sin(k / 20), 0.5 * np.sin(k))
    y = np.column_stack([np.cos(k / 9), 0.1 * np.cos(k / 9)])
    both = tuple(
        Recording(u=u, y=y * scale, Ts=Ts) for u, scale, Ts in ((slow, 2.0, 0.01), (quick, 1.0, 0.02))
    )
    limits = seen_limits(both)
    assert limits.voltage == pytest.approx(np.max(np.abs(slow)))
    assert limits.slew == pytest.approx(np.max(np.abs(np.diff(quick))) / 0.02)
    assert limits.deflection == pytest.approx(0.2)
    assert limits.margin == 0.0
    alone = tuple(Recording(u=r.u, y=r.y[:, :1], Ts=r.Ts) for r in both)
    assert seen_limits(alone).deflection == np.inf


def test_sizes_in_windows_by_hand() -> None:
    """One Gauss-Newton step of the amplitudes in each window, beside what a window moves of its own."""
    rng = np.random.default_rng(0)
    R, N, C = 2, 60, 2
    names = ("hub.coulomb.level", "arm.inertia.inertia", "offset of a recording")
    J, e = rng.standard_normal((3, R, N, C)), rng.standard_normal((R, N, C))
    value, derivative = 0.03, 0.5
    J[0] *= 20.0
    problem: Any = SimpleNamespace(
        supermodel=SimpleNamespace(mechanism=SimpleNamespace(parameter_names=names)),
        seen=np.ones((R, N)),
        slopes=lambda hypotheses: (
            e[None],
            np.concatenate([J, J[:1]])[None],
        ),  # first states are beyond `moved`
        windows=SimpleNamespace(of=lambda r: [(0, slice(0, 25)), (1, slice(25, N))]),
    )
    h: Any = SimpleNamespace(
        whitener=lambda x, seen: x,
        moved=3,
        free=(1, 0),
        local=(2,),
        physical=lambda s: (
            np.tile([value, 1.0, 0.2], (R, 1)),
            np.tile([derivative, 1.0, 1.0], (R, 1)),
        ),
    )
    sizes = window_sizes(problem, h, [EffectLocation("coulomb", "hub"), EffectLocation("lugre", "arm")])
    wanted = acts = rest = 0.0
    for r in range(R):
        for samples in (slice(0, 25), slice(25, N)):
            # Columns follow the free parameters, then those of a recording: the level is the second.
            slope, other = J[1, r, samples].ravel() / derivative, J[2, r, samples].ravel()
            left = e[r, samples].ravel()
            slope, left = (x - other * (other @ x) / (other @ other) for x in (slope, left))
            step = (slope @ left) / (slope @ slope)
            wanted += np.sum((step * slope) ** 2)
            acts += np.sum((value * slope) ** 2)
            rest += left @ left
    assert list(sizes) == [EffectLocation("coulomb", "hub")]
    (found,) = sizes.values()
    assert found.scatter == pytest.approx(np.sqrt(wanted / acts))
    assert found.change == pytest.approx(np.sqrt(acts / rest))
    e *= 1e-6
    J *= 1e-6
    again = window_sizes(problem, h, [EffectLocation("coulomb", "hub")])[EffectLocation("coulomb", "hub")]
    assert again == pytest.approx(found)  # whatever the unit
    # Nothing is said of what is nowhere, or of runs without an error.
    e[:] = 0.0
    assert window_sizes(problem, h, [EffectLocation("coulomb", "hub")]) == {}
    e[:], J[1] = 1.0, 0.0
    assert window_sizes(problem, h, [EffectLocation("coulomb", "hub")]) == {}


HUB = "Coulomb friction at the hub"
REACHED = "the held-out error over 2 s is theta 1.00, alpha 1.00 times the sensor noise"
SHARE = "; theta > 99.99 %, alpha > 99.99 % of the baseline's squared error is explained"
REMAINS = "something remains that no candidate explains"
TORQUE = "predictions still ask for a random torque (0.1 nat per measured value, at most 0.07)"


@pytest.mark.parametrize(
    ("given", "sentence"),
    [
        ({}, f"Nothing is missing: {REACHED}."),
        ({"excited": 3}, f"Nothing is missing: {REACHED}; 1 of 4 candidates could not have shown."),
        ({"rounds": ((),)}, f"{HUB} explains the recording: {REACHED}{SHARE}."),
        ({"rounds": ((),), "before": 1.0}, f"{HUB} explains the recording: {REACHED}."),
        (
            {"rounds": (("lag",),)},
            f"{HUB} explains the recording, but it cannot distinguish this from others (listed with it): "
            f"{REACHED}{SHARE}.",
        ),
        (
            {"rounds": ((), ("lag",))},
            f"{HUB} and {HUB} explain the recording, but it cannot distinguish some of them from others "
            f"(listed with each): {REACHED}{SHARE}.",
        ),
        ({"ratio": 3.0}, f"S{REMAINS[1:]}: {REACHED.replace('alpha 1.', 'alpha 3.')}."),
        (
            {"noise_nats": 200.0, "rounds": ((),)},
            f"{HUB} found, but {REMAINS}: {REACHED}; short runs are at the noise, but {TORQUE}{SHARE}.",
        ),
        (
            {"excited": 1},
            "Nothing was found, but 3 of 4 candidates could not have shown in this recording: move the "
            "machine more, over more speeds and voltages.",
        ),
    ],
)
def test_the_sentence_gives_the_reason(given: dict[str, Any], sentence: str) -> None:
    given = {"before": 1e4} | given
    assert told(**given)[1] == sentence


def test_the_first_effect_with_an_equal_is_asked_about(monkeypatch: pytest.MonkeyPatch) -> None:
    """With the settings of the longest recording, whose first ten seconds the rival is fitted to."""
    monkeypatch.setattr(conclusion, "next_experiment", lambda *given, **settings: (given, settings))
    k = np.arange(3000)
    y = np.column_stack([np.cos(k / 9), 0.1 * np.cos(k / 9)])
    long, short = (Recording(u=np.sin(k[:n] / 20), y=y[:n], Ts=Ts) for n, Ts in ((3000, 0.01), (100, 0.02)))
    rounds = [
        SimpleNamespace(effect=effect, port="hub", equivalent=others)
        for effect, others in (
            ("cogging", ()),
            ("coulomb", (("stribeck", "hub"), ("lag", "input"))),
            ("dahl", (("lugre", "hub"),)),
        )
    ]
    found: Any = SimpleNamespace(
        rounds=rounds,
        train=(short,),
        validation=(long,),
        noise_floor={"theta": 1e-3},
        final=SimpleNamespace(process_noise={"hub": 0.0}),
        model="the model",
    )
    given, settings = proposed(found, Ts=0.5)  # pyright: ignore[reportGeneralTypeIssues]
    assert given == ("the model", ("coulomb", "hub"), ("stribeck", "hub"))
    assert settings["Ts"] == 0.5 and settings["limits"] == seen_limits((short, long))
    np.testing.assert_array_equal(settings["reference"], long.u[:1000])
    found.rounds = rounds[:1]
    assert proposed(found) is None
