"""Verdict and grade of a search: the same in sentence, tile, table and JSON; names of effects."""

import dataclasses
import re

import numpy as np
import pytest
from rich.console import Console
from test_report import NOISE, read, two_rounds

from rotflex_jax.cli import terminal
from rotflex_jax.discover.conclusion import end_state
from rotflex_jax.discover.verdict import (
    FAR_FLOOR,
    NEAR_FLOOR,
    TORQUE_NATS,
    Assessment,
    Grade,
    Verdict,
    assess,
    grade,
)
from rotflex_jax.effects import CATALOG
from rotflex_jax.effects.labels import effect_label, effect_phrase, sentence, with_titles
from rotflex_jax.fit.result import Fit
from rotflex_jax.parameters import Estimate, Specification
from rotflex_jax.report.page import render, tone
from rotflex_jax.text.numbers import multiple, percent_explained

NAN = float("nan")


def ended(times: float, nats: float = 0.0, verdict: Verdict = Verdict.UNEXPLAINED):
    """A search whose final error is `times` the noise, from a baseline at 1000 times the noise."""
    found = two_rounds()
    channels = found.baseline.held_out_rmse_windows

    def with_errors(stage, factor, nats):
        errors = dict.fromkeys(channels, factor * NOISE)
        return dataclasses.replace(
            stage, held_out_rmse=errors, held_out_rmse_windows=errors, process_noise_nats=nats
        )

    baseline = with_errors(found.baseline, 1000.0, 1e5)
    rounds = tuple(
        dataclasses.replace(r, equivalent=(), stage=with_errors(r.stage, times, nats)) for r in found.rounds
    )
    floor = dict.fromkeys(channels, NOISE)
    found = dataclasses.replace(found, baseline=baseline, rounds=rounds, noise_floor=floor)
    reached, text = end_state(baseline, rounds, found.final, floor, [])
    return dataclasses.replace(found, verdict=reached, sentence=text)


def test_explained_shares_are_of_the_squared_error() -> None:
    end = assess({"theta": 2.0, "alpha": 1.0}, {"theta": 0.2, "alpha": 2.0}, {"theta": 0.1}, 0.0)
    assert end.explained["theta"] == pytest.approx(99.0)
    assert end.explained["alpha"] == pytest.approx(-300.0)
    assert end.remaining["theta"] == pytest.approx(2.0)
    assert np.isnan(end.remaining["alpha"])
    assert end.explained_text == "theta 99.0 % of the baseline's squared error is explained"


@pytest.mark.parametrize(("times", "expected"), [(1.17, Grade.NOISE), (3.0, Grade.NEAR), (229.0, Grade.FAR)])
def test_a_little_and_much_above_the_noise_are_not_shown_alike(times, expected, monkeypatch) -> None:
    monkeypatch.setattr("rotflex_jax.report.page.pictures", lambda *given: {})
    assert grade(times) == expected
    shown = dict(zip(Grade, ("yes", "warn", "bad"), strict=True))
    page = render(ended(times, nats=1e5))
    tiles = re.findall(r'<div class="(\w+)">[^<]*× the sensor noise', page)
    assert set(tiles) == {shown[expected]}
    final = re.findall(rf'<td class="n (\w+)">[^<]*<small>× {re.escape(multiple(times))}</small>', page)
    assert final and set(final) == {expected.value}
    assert tone(ended(times, nats=1e5)) == ("bad" if expected is Grade.FAR else "warn")


@pytest.mark.parametrize("times", [1.168, 23.456, 228.6])
def test_sentence_tile_table_json_and_terminal_say_the_same_number(times, monkeypatch, capsys) -> None:
    monkeypatch.setattr("rotflex_jax.report.page.pictures", lambda *given: {})
    found, said = ended(times, nats=1e5), multiple(times)
    assert f"theta {said}, alpha {said} times the sensor noise" in found.sentence
    text = read(render(found)).text
    assert f"{said} × the sensor noise" in text
    assert f"× {said}" in text
    assert found.to_dict()["assessment"]["remaining_over_noise"]["theta"] == pytest.approx(times)
    monkeypatch.setattr(terminal, "output", lambda: Console(width=200, soft_wrap=True, highlight=False))
    terminal.print_discovery(found)
    assert f"theta {said}" in capsys.readouterr().out


def test_the_verdict_says_which_criterion_decided() -> None:
    by_error = ended(229.0)
    assert by_error.verdict is Verdict.UNEXPLAINED
    assert "times the sensor noise (limit 1.5)" in by_error.assessment.criterion
    by_torque = ended(1.17, nats=2 * TORQUE_NATS)
    assert by_torque.verdict is Verdict.UNEXPLAINED
    assert "random torque (0.06 nat" in by_torque.sentence
    explained = ended(1.17, nats=0.5 * TORQUE_NATS)
    assert explained.verdict is Verdict.FOUND
    assert "> 99.99 % of the baseline's squared error is explained" in explained.sentence


def test_result_json_carries_all_final_parameters_and_units() -> None:
    found = ended(1.0)
    written = found.to_dict()
    assert list(written["parameters"]) == [e.name for e in found.final.estimates]
    for e in found.final.estimates:
        row = written["parameters"][e.name]
        assert (row["value"], row["unit"], row["free"]) == (e.value, e.unit, e.free)
    assert written["units"] == {"theta": "rad", "alpha": "rad"}


def test_names_of_effects_are_nouns_of_the_field(monkeypatch) -> None:
    assert effect_label("coulomb", "hub") == "Coulomb friction at hub"
    assert effect_label("viscous", "joint") == "viscous damping at joint"
    assert effect_label("backlash", "hub") == "backlash at hub"
    assert effect_label("sensor_cubic", "alpha") == "nonlinear sensor of alpha"
    assert effect_label("an_effect_of_ones_own", "hub") == "an effect of ones own at hub"
    assert with_titles("coulomb_asymmetric at the hub, lag at input") == (
        "asymmetric Coulomb friction at the hub, input lag"
    )
    # Titles are kept, and ordinary words are not replaced.
    for text in (
        "Cubic spring at the joint and Coulomb friction at the hub.",
        "The spring at the joint hardens.",
    ):
        assert sentence(text) == with_titles(text) == text
    for kind in CATALOG.values():
        label = effect_phrase(kind.name, kind.ports[0])
        assert with_titles(label) == label, label
    assert sentence("Coulomb friction at the hub explains it") == "Coulomb friction at the hub explains it."
    titles = [kind.title for kind in CATALOG.values()]
    assert len(set(titles)) == len(titles)
    for title in titles:  # a noun phrase, not a sentence
        assert not re.search(r"\b(that|which|is|with another)\b|[,()]", title), title
    # Text for readers does not contain the names that scripts use.
    monkeypatch.setattr("rotflex_jax.report.page.pictures", lambda *given: {})
    # The name for scripts stands beside the title of a card, as code.
    page = re.sub(r"<code.*?</code>", "", render(ended(3.0)))
    listed = read(page).text.partition("The final model")[0]
    assert not re.search(r"\b(cubic_spring|voltage_offset|sensor_bias|dead_zone) at\b", listed)


def test_steps_are_said_once_and_no_nan_reaches_a_reader() -> None:
    estimate = Estimate.of("hub.coulomb.level", 0.03, NAN, Specification("N m", 0.01))
    assert "nan" not in str(estimate)
    assert "not determined" in str(estimate)
    for status, said in (
        ("stopped after 60 steps", "stopped after 60 steps"),
        ("converged", "converged after 60 steps"),
    ):
        fit = Fit(
            two_rounds().model,
            1.0,
            status,
            (estimate,),
            {"theta": 1e-3, "alpha": 1e-3},
            np.zeros((0, 0)),
            (),
            60,
        )
        for text in (str(fit), read(f"<div>{fit._repr_html_()}</div>").text):
            assert said in text
            assert text.count("60 steps") == 1
            assert re.search(r"cost 1[.0]* nat", text)
            assert "nan" not in text
        assert "  residual theta: 0.0573 deg rms\n" in str(fit)


def test_a_parameter_without_an_interval_is_not_called_held(monkeypatch) -> None:
    monkeypatch.setattr("rotflex_jax.report.page.pictures", lambda *given: {})
    found = ended(3.0)
    lost = Estimate("hub.coulomb.level", 0.03, NAN, (NAN, NAN), "N m", note="not determined by these data")
    estimates = tuple(lost if e.name == lost.name else e for e in found.final.estimates)
    last = dataclasses.replace(found.rounds[-1], stage=dataclasses.replace(found.final, estimates=estimates))
    text = read(render(dataclasses.replace(found, rounds=(*found.rounds[:-1], last)))).text
    assert "0.03 N m no interval" in text
    assert "0.03 N m held" not in text


def test_verdicts_differ_without_colour_too() -> None:
    assert len({v.shown.marker for v in Verdict}) == len(Verdict)
    assert {v for v in Verdict if not v.shown.filled} == {Verdict.AMBIGUOUS}


def test_what_is_exactly_at_a_limit_of_the_end_is_beyond_it() -> None:
    near, far = 1.5, 5.0
    assert (near, far) == (NEAR_FLOOR, FAR_FLOOR)
    assert (grade(near), grade(far)) == (Grade.NEAR, Grade.FAR)
    end = Assessment({"theta": 0.5}, {"theta": near}, 0.0)
    assert not end.at_noise and end.criterion.endswith("theta 1.50 times the sensor noise (limit 1.5)")
    assert end.explained_text == "theta 0.5 % of the baseline's squared error is explained"
    below = dataclasses.replace(end, remaining={"theta": np.nextafter(near, 0)})
    assert below.at_noise and below.is_explained
    assert not dataclasses.replace(below, torque_nats=TORQUE_NATS).torque_free
    # A channel of unknown noise decides if the others are at their noise, not if one is at the limit.
    unknown = {"alpha": NAN}
    assert (
        "noise of alpha is not known"
        in dataclasses.replace(below, remaining=below.remaining | unknown).criterion
    )
    assert "theta 1.50" in dataclasses.replace(end, remaining=end.remaining | unknown).criterion
    assert [percent_explained(share) for share in (99.99, 99.0, 0.0)] == ["99.99 %", "99.0 %", "0 %"]
    # If the baseline has no error, the explained share is undefined.
    assert np.isnan(assess({"theta": 0.0}, {"theta": 1.0}, {"theta": 1.0}, 0.0).explained["theta"])


def test_the_misfit_is_what_is_left_over_what_the_verdict_allows() -> None:
    """The larger of squared error ratio and ratio of nats; at least 1, infinite if the noise is unknown."""

    def misfit(theta: float, nats: float) -> float:
        return Assessment({}, {"theta": theta * NEAR_FLOOR, "alpha": 0.5}, nats * TORQUE_NATS).misfit

    assert misfit(3.0, 2.0) == pytest.approx(9.0) and misfit(0.9, 2.0) == pytest.approx(2.0)
    assert misfit(0.9, 0.9) == 1.0 and misfit(NAN, 0.0) == np.inf


@pytest.mark.parametrize("verdict", Verdict)
def test_candidates_that_could_not_have_shown_are_said_where_the_verdict_does_not_say_it(verdict: Verdict):
    said = [step for step in verdict.next_steps([("a", "b")], 3, 7) if step.startswith("3 of 7 candidates")]
    assert len(said) == (verdict is not Verdict.NOT_EXCITED)
    assert not any("candidates could not" in step for step in verdict.next_steps([("a", "b")], 0, 7))
