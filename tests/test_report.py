"""The report: complete, self-contained, readable, and safe with any name that users give to files."""

import base64
import dataclasses
import html.parser
import json
import math
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import matplotlib
import numpy as np
import pytest
from matplotlib import image
from rich.console import Console
from test_discover_localise import recording as turning, reversals, white

from rotflex_jax.cli import terminal
from rotflex_jax.discover import locate
from rotflex_jax.discover.discovery import Discovery
from rotflex_jax.discover.explanation import Explanation, LatentTorqueComparison, remaining_failures
from rotflex_jax.discover.learned_torque import LearnedTorqueResult
from rotflex_jax.discover.probabilities import Probabilities, SetProbability
from rotflex_jax.discover.result import FinalFit, HorizonGain, Ranked, Round, RunErrors, Stage, Where
from rotflex_jax.discover.spline_map import Formula, Term
from rotflex_jax.discover.tables import (
    error_lists,
    final_fit_sentence,
    next_steps,
    parameter_rows,
    status_sentence,
)
from rotflex_jax.discover.verdict import Verdict
from rotflex_jax.effects import CATALOG, Coulomb, CubicSpring, LearnedTorque
from rotflex_jax.effects.labels import effect_phrase
from rotflex_jax.errors import InputError
from rotflex_jax.fit.plausibility import Remark
from rotflex_jax.fit.result import Fit, FitOptions
from rotflex_jax.joints import paper, single_inertia
from rotflex_jax.latent import LatentTorque
from rotflex_jax.mechanism.quantity import Units
from rotflex_jax.models.model import Model
from rotflex_jax.models.residual_tests import FrequencyResponse, residual_tests
from rotflex_jax.parameters import Estimate
from rotflex_jax.recording import Recording
from rotflex_jax.report import parameter_table, summary_table, write_report
from rotflex_jax.report.figures import pictures
from rotflex_jax.report.figures.evidence import parameters, staircase
from rotflex_jax.report.figures.failure import _maps, profiles, worst_channel
from rotflex_jax.report.figures.residuals import residual_figure, response_figure
from rotflex_jax.report.page import render
from rotflex_jax.text.plotting import blank, data_address

NASTY = "bench <script>alert(1)</script> & 'co'.csv"
NOISE = 5e-4
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")


def moved(N: int = 2000, Ts: float = 0.005, source: str = NASTY, **named) -> Recording:
    rng = np.random.default_rng(0)
    t = Ts * np.arange(N)
    theta = 0.4 * np.sin(2 * np.pi * 0.7 * t) + 0.1 * np.sin(2 * np.pi * 1.9 * t + 1)
    alpha = 0.08 * np.sin(2 * np.pi * 3.1 * t) + 0.02 * np.sin(2 * np.pi * 0.5 * t)
    y = np.column_stack([theta, alpha]) + NOISE * rng.standard_normal((N, 2))
    return Recording(u=np.sin(5 * t) + 0.2 * t, y=y, Ts=Ts, source=source, **named)


def stage(mechanism, test: Recording, error: np.ndarray, free: dict[str, float]) -> Stage:
    nan = float("nan")
    values = mechanism.named_values
    specs = dict(zip(mechanism.parameter_names, mechanism.parameter_specifications, strict=True))
    estimates = tuple(
        Estimate(n, v, free[n], (v - 1.96 * free[n], v + 1.96 * free[n]), specs[n].unit)
        if n in free
        else Estimate(n, float(v), nan, (nan, nan), specs[n].unit, free=False)
        for n, v in values.items()
    )
    model = Model(mechanism)
    channels = mechanism.channels
    rms = dict(zip(channels, np.sqrt(np.mean(error**2, axis=0)).tolist(), strict=True))
    y_hat = model.measured(test) - error
    return Stage(
        model=model,
        estimates=estimates,
        held_out_rmse={c: 1.5 * v for c, v in rms.items()},
        held_out_rmse_windows=rms,
        simulated=(y_hat,),
        windowed=(y_hat,),
        window_seconds=2.0,
        process_noise={"hub": 1e-6},
        process_noise_nats=10.0,
        log_likelihood=-100.0,
    )


def two_rounds() -> Discovery:
    """A constructed result of a search that found friction and a hardening spring."""
    train, test = moved(), moved(1500)
    rng = np.random.default_rng(1)
    noise = NOISE * rng.standard_normal((test.N, 2))
    swing = np.sin(2 * np.pi * 0.3 * test.t)[:, None]
    joint = paper()
    with_friction = joint + Coulomb(at="hub", level=0.03)
    full = with_friction + CubicSpring(at="joint", stiffness=40.0)
    free = {"hub.inertia.inertia": 2e-5, "joint.spring.stiffness": 0.004}
    free_friction = free | {"hub.coulomb.level": 1e-4}
    stages = (
        stage(joint, test, noise + swing * [0.05, 0.01], free),
        stage(with_friction, test, noise + swing * [0.004, 0.006], free_friction),
        stage(full, test, noise, free_friction | {"joint.cubic_spring.stiffness": 0.3}),
    )
    rounds = (
        Round(
            effect="coulomb",
            port="hub",
            equivalent=(("stribeck", "hub"),),
            parameters={"level": stages[1].estimates[-1]},
            stage=stages[1],
            score=18432.0,
            held_out_gain_nats=5120.0,
            sentence="the hub meets a constant friction torque of 0.03 N m",
            equation="tau = -level * sign(speed), holds while |tau| <= level",
        ),
        Round(
            effect="cubic_spring",
            port="joint",
            equivalent=(),
            parameters={"stiffness": stages[2].estimates[-1]},
            stage=stages[2],
            score=9210.0,
            held_out_gain_nats=7100.0,
            sentence="the spring hardens <b>fast</b>",
            equation="tau = -stiffness * position^3",
        ),
    )
    where = Where(
        "78 % of the theta error lies within 80 ms after the hub reverses, "
        "where the machine spends 21 % of the time.",
        0.78,
        0.001,
        "reversal",
        "theta",
        np.array([0.0, 0.02, 0.04, 0.08, 0.5]),
        np.array([0.4, 0.2, 0.18, 0.22]),
        np.array([0.05, 0.06, 0.1, 0.79]),
        "s",
    )
    return Discovery(
        verdict=Verdict.AMBIGUOUS,
        sentence="coulomb at hub and cubic_spring at joint explain the recording",
        train=(train,),
        validation=(test,),
        baseline=stages[0],
        rounds=rounds,
        ranking=(
            Ranked("coulomb", "hub", 18432.0, True, 0.4, 0.1),
            Ranked("stribeck", "hub", 18400.0, True, 0.4, 0.1),
            Ranked("cubic_spring", "joint", 3.2, True, 0.3, 0.2),
            Ranked("gravity", "arm", -6.0, False, 0.001, float("inf")),
            Ranked("<i>own</i>", "hub", -9.0, True, 0.5, 1.0),
        ),
        where=(where,),
        noise_floor={"theta": NOISE, "alpha": NOISE},
        elapsed_s=12.3,
        notes=("The <u>offset</u> of the voltage is significant.",),
        probabilities=Probabilities(
            (
                SetProbability(frozenset({"coulomb@hub", "cubic_spring@joint"}), 0.72),
                SetProbability(frozenset({"stribeck@hub", "cubic_spring@joint"}), 0.2),
                SetProbability(frozenset(), 0.001),
            ),
            {"cubic_spring@joint": 0.92, "coulomb@hub": 0.72, "stribeck@hub": 0.2},
            0.079,
            ("Only sets that the search has <b>fitted</b> are listed.",),
        ),
    )


def nothing() -> Discovery:
    full = two_rounds()
    base = full.final
    even = locate(
        full.validation[0], full.validation[0].y - base.windowed[0], ("theta", "alpha"), full.noise_floor
    )
    return dataclasses.replace(
        full,
        verdict=Verdict.NOTHING_MISSING,
        sentence="Nothing is missing.",
        baseline=base,
        rounds=(),
        where=even,
        notes=(),
    )


def one_channel() -> Discovery:
    """Result for a single inertia: angle in revolutions, no ranking, unknown sensor noise."""
    both = moved()
    test = Recording(u=both.u, y=both.y[:, 0], Ts=both.Ts, units=("rev",), source="")
    error = 0.01 * np.sin(test.t)[:, None] + NOISE
    base = stage(single_inertia(), test, error, {"hub.inertia.inertia": 1e-5})
    where = locate(test, error, ("theta",), [0.0])
    return Discovery(Verdict.UNEXPLAINED, "Something remains", (test,), (test,), base, (), (), where, {}, 1.0)


def photographed() -> LatentTorque:
    """A constructed latent torque: dry friction at the hub less a linear part, almost none at the joint."""
    t = 0.005 * np.arange(1500)
    speed = np.stack([np.sin(t), np.cos(3 * t)], axis=1)
    return LatentTorque(
        ports=("hub", "joint"),
        torque=(0.01 * speed - 0.02 * np.sign(speed)) * [1.0, 1e-6],
        std=np.full_like(speed, 0.002),
        time=t,
        position=0.1 * speed,
        speed=speed,
        voltage=speed[:, 0],
        recording=np.zeros(len(t), int),
        Ts=(0.005,),
        intensity={"hub": 1e-3, "joint": 1e-12},
        gain_nats={"hub": 1e4, "joint": 0.0},
        scale=0.2,
        linear={"hub.viscous": -0.01 * speed[:, 0]},
    )


def map_of_friction(discovery: Discovery, kept: bool) -> LearnedTorqueResult:
    """A constructed learned torque: a step over the speed, less its constant and linear parts."""
    rng = np.random.default_rng(3)
    speed, position = rng.normal(size=4000), rng.uniform(-1, 1, 4000)
    effect = LearnedTorque(at="hub", position=(-1.0, 1.0), speed=(-3.0, 3.0), count=(1, 12))
    design = effect.design(position, speed)
    own = np.stack([np.ones(4000), speed], axis=1)
    torque = -0.03 * np.sign(speed)
    torque -= own @ np.linalg.lstsq(own, torque, rcond=None)[0]
    weights = np.linalg.lstsq(design, torque, rcond=None)[0]
    return LearnedTorqueResult(
        at="hub",
        kept=kept,
        effect=effect.replace(weights=tuple(weights.tolist())),
        before=discovery.baseline,
        after=discovery.final,
        held_out_gain_nats=2755.0,
        formula=Formula((Term("sign(w)", 0.0, -0.03, 3e-4, 0.98),) * kept),
        physics=("1", "w"),
        covariance=1e-8 * np.eye(12),
        position=position,
        speed=speed,
        noise_floor={"theta": NOISE, "alpha": NOISE},
    )


@pytest.fixture(scope="module")
def discovery() -> Discovery:
    return two_rounds()


@pytest.fixture
def undrawn(monkeypatch) -> None:
    """Without figures, latent torques and identifiability, which take most of the time of a page."""
    monkeypatch.setattr("rotflex_jax.report.page.pictures", lambda *given: {})
    torques = LatentTorqueComparison(photographed(), None)
    monkeypatch.setattr(Discovery, "latent_torque", lambda self, progress: torques)
    monkeypatch.setattr(Discovery, "identifiability", lambda self: None)


@pytest.fixture(scope="module")
def page(discovery) -> str:
    return render(discovery)


class Reader(html.parser.HTMLParser):
    """Strict parser of a page: every element must be closed, in order."""

    VOID = ("meta", "img", "br", "link", "input", "hr")

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.addresses: list[str] = []
        self.words: list[str] = []
        self.tags: list[str] = []
        self.alternatives: list[str] = []

    def handle_starttag(self, tag, attrs) -> None:
        self.tags.append(tag)
        if tag not in self.VOID:
            self.open.append(tag)
        self.addresses += [v for k, v in attrs if k in ("src", "href", "srcset", "data")]
        self.alternatives += [v for k, v in attrs if k == "alt"]

    def handle_endtag(self, tag) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data) -> None:
        if self.open and self.open[-1] not in ("style", "script"):
            self.words.append(data)

    @property
    def text(self) -> str:
        return " ".join(" ".join(self.words).split())


def read(page: str) -> Reader:
    reader = Reader()
    reader.feed(page)
    reader.close()
    assert reader.open == []
    return reader


def test_the_page_is_well_formed_and_needs_nothing_else(page) -> None:
    reader = read(page)
    assert reader.addresses
    assert all(a.startswith("data:image/svg+xml;charset=utf-8,") for a in reader.addresses)
    assert not {"link", "iframe", "object"} & set(reader.tags)
    # By this policy a browser refuses everything that a script or a style would load.
    assert re.search(r'<meta http-equiv="Content-Security-Policy" content="default-src \'none\';', page)
    assert "Copyright (c) 2022 Leon Sorokin" in page
    style = re.search(r"<style>(.*)</style>", page, re.DOTALL).group(1)
    assert "url(" not in style
    assert "@import" not in style
    assert all(len(a) > 20 for a in reader.alternatives)
    assert len(page) < 3e6


def test_what_a_reader_must_learn_is_there(page, discovery) -> None:
    text = read(page).text
    assert Verdict.AMBIGUOUS.shown.headline in text
    assert "Coulomb friction at hub and cubic spring at joint explain the recording." in text
    assert "The hub meets a constant friction torque of 0.03 N m." in text
    assert "τ = −stiffness · position³" in text
    law = "dry friction at the hub is certain, but not whether it is Coulomb friction or Stribeck friction"
    assert f"Provisional as a law: {law}." in text
    assert "0.03000 N m" in text
    assert "0.02980 … 0.03020" in text
    assert "40.00 N m/rad³" in text
    assert "theta [deg]" in text
    # 0.05 sin: 0.0354 rad rms is 2.03 deg, 71 times the noise of 5e-4.
    assert re.search(r"baseline 2\.0\d × 7[01]\.\d\d", text)
    assert "78 % of the theta error lies within 80 ms after the hub reverses" in text
    assert "Not excited means" in text
    assert "1 of 5 candidates" in text
    assert "Most probable of the 3 sets of effects that were fitted: Coulomb friction at hub + cubic" in text
    assert "spring at joint 72 %; " in text and "a set that was not fitted 8 %" in text
    assert "What to do next" in text
    assert "jax" in text


def test_what_a_user_wrote_is_escaped(page) -> None:
    text = read(page).text
    assert NASTY in text
    assert "The spring hardens <b>fast</b>." in text
    assert "<i>own</i> at hub" in text
    assert "The <u>offset</u>" in text and "has <b>fitted</b> are" in text
    assert "<script>alert" not in page
    for tag in ("b", "i", "u"):
        assert tag not in read(page).tags


@pytest.mark.parametrize("verdict", Verdict)
def test_every_verdict_has_a_headline_and_a_next_step(discovery, verdict, undrawn) -> None:
    other = dataclasses.replace(discovery, verdict=verdict)
    assert next_steps(other)
    text = read(render(other)).text
    assert verdict.shown.headline in text
    assert next_steps(other)[0][:30] in text


def test_an_effect_without_a_score_has_none_in_the_report(discovery, undrawn) -> None:
    said = "Log-likelihood of validation data + 5 120 nat, score 18 432 nat."
    assert said in read(render(discovery)).text
    first = dataclasses.replace(discovery.rounds[0], score=math.nan)
    unscored = dataclasses.replace(discovery, rounds=(first, *discovery.rounds[1:]))
    assert said.replace(", score 18 432 nat", "") in read(render(unscored)).text
    assert unscored.to_dict()["rounds"][0]["evidence"]["score"] is None


def test_a_report_without_rounds_says_so(undrawn) -> None:
    found = nothing()
    assert "evenly" in found.where[0].statement
    text = read(render(found)).text
    assert f"No effect was added: none of the {len(found.ranking)} candidates made the model better" in text
    untried = dataclasses.replace(found, ranking=())
    assert "No effect was added: no candidate was tried." in read(render(untried)).text
    assert "Where the error occurs" in text
    assert "staircase" not in pictures(found)


def test_one_channel_in_another_unit_and_nothing_ranked(undrawn) -> None:
    text = read(render(one_channel())).text
    assert "theta [rev]" in text
    assert "deg" not in text


def test_the_final_model_is_located_where_something_remains(discovery, undrawn) -> None:
    partly = dataclasses.replace(discovery, verdict=Verdict.UNEXPLAINED, rounds=discovery.rounds[:1])
    text = read(render(partly, Explanation(remaining=remaining_failures(partly)))).text
    assert "Where the final model still fails" in text
    assert not remaining_failures(discovery)
    assert "Where the final model still fails" not in read(render(discovery)).text


@pytest.mark.parametrize("made", [two_rounds, nothing, one_channel])
def test_every_axis_has_a_label_with_a_unit(made) -> None:
    drawn = pictures(made())
    assert {"overlay", "spectra", "map"} <= set(drawn)
    for name, picture in drawn.items():
        assert picture.caption.endswith(".")
        for ax in picture.figure.axes:
            for axis in (ax.xaxis, ax.yaxis):
                assert _has_unit(ax, axis), (name, ax.get_title(), axis.axis_name)


def _has_unit(ax, axis) -> bool:
    """Whether an axis, or one that it shares its scale with, has a label with a unit."""
    if ax.get_label() == "<colorbar>":  # its thin side has no scale
        axis = max((ax.xaxis, ax.yaxis), key=lambda side: len(side.get_label_text()))
    name = f"{axis.axis_name}axis"
    group = getattr(ax, f"get_shared_{axis.axis_name}_axes")()
    labels = [getattr(other, name).get_label_text() for other in group.get_siblings(ax)]
    return any(re.search(r"\[.+\]", label) for label in labels)


def test_the_most_probable_sets_and_effects_are_drawn(discovery) -> None:
    """The bar of the reported set has another colour; there is no figure if only one set was fitted."""
    sets, effects = pictures(discovery)["probabilities"].figure.axes
    assert [b.get_width() for b in sets.patches] == [0.72, 0.2]  # what is below 1 % is left out
    assert [b.get_width() for b in effects.patches] == [0.92, 0.72, 0.2]
    assert next(t.get_text() for t in effects.get_yticklabels()) == "cubic spring at joint"
    colours = [b.get_facecolor()[:3] for b in sets.patches]
    assert colours[0] != colours[1]
    alone = dataclasses.replace(
        discovery.probabilities, sets=discovery.probabilities.sets[:1], effects={"coulomb@hub": 0.9}
    )
    assert "probabilities" not in pictures(dataclasses.replace(discovery, probabilities=alone))


def test_errors_after_reversals_are_drawn_to_the_last(discovery) -> None:
    """Samples later than the last limit, or before the first reversal, share the last bar."""
    run = turning()
    error = white(run)
    for k in reversals(run):
        error[k : k + 20, 0] *= 6.0
    found = locate(run, error, run.channels, dict.fromkeys(run.channels, 1e-4))
    place = next(w for w in found if w.kind == "reversal")
    figure = profiles(dataclasses.replace(discovery, where=(place,)))
    assert figure is not None
    (ax,) = figure.axes
    assert len(ax.patches) >= len(place.profile) == len(place.edges) - 1
    assert sum(place.profile) == pytest.approx(1) and sum(place.expected) == pytest.approx(1)
    assert [label.get_text() for label in ax.get_xticklabels()][-1] == "later"


def test_shares_of_the_error_are_drawn_in_percent(discovery) -> None:
    figure = profiles(discovery)
    assert figure is not None
    bars = [b.get_height() for b in figure.axes[0].patches[:4]]
    assert bars == pytest.approx([40.0, 20.0, 18.0, 22.0]) and figure.axes[0].get_ylabel() == "share [%]"


def test_estimates_are_drawn_relative_to_the_last_with_their_intervals(discovery) -> None:
    """Intervals of the last model are 1.96 standard deviations; the spring of the first is softer by 5 %."""
    first = discovery.baseline
    softer = tuple(
        dataclasses.replace(e, value=0.95 * e.value) if e.name == "joint.spring.stiffness" else e
        for e in first.estimates
    )
    figure = parameters(dataclasses.replace(discovery, baseline=dataclasses.replace(first, estimates=softer)))
    assert figure is not None
    (ax,) = figure.axes
    rows = {text.get_text(): k for k, text in enumerate(ax.get_yticklabels())}
    drawn = [(c.lines[0].get_xydata()[0], c.lines[2][0].get_segments()[0]) for c in ax.containers]
    spring = [(x, ends[:, 0]) for (x, y), ends in drawn if round(y) == rows["joint.spring.stiffness"]]
    last = {e.name: e for e in discovery.final.estimates}["joint.spring.stiffness"]
    assert [x for x, _ in spring] == pytest.approx([-5.0, 0.0, 0.0])
    assert spring[-1][1] == pytest.approx(np.array([-196.0, 196.0]) * last.std / last.value, rel=1e-4)


def test_the_noise_of_a_sensor_is_drawn_in_the_unit_of_the_axis(discovery) -> None:
    figure = staircase(discovery)
    assert figure is not None
    (floor,) = (line for line in figure.axes[0].lines if line.get_label() == "sensor noise")
    assert floor.get_ydata()[0] == pytest.approx(np.rad2deg(NOISE))


def test_the_worst_channel_is_that_of_the_largest_error_over_its_noise(discovery) -> None:
    """Errors of 0.035 and 0.007 rad."""
    assert worst_channel(discovery) == "theta"
    coarse = dataclasses.replace(discovery, noise_floor={"theta": 1e-2, "alpha": 1e-4})
    assert worst_channel(coarse) == "alpha"


def test_maps_are_over_the_speed_and_have_the_acceleration_that_is_lacking(discovery) -> None:
    """The baseline lacks a sine of 0.3 Hz in the angle, the last model nothing but noise."""
    m, t = _maps(discovery), discovery.validation[0].t
    speed = 0.4 * 2 * np.pi * 0.7 * np.cos(2 * np.pi * 0.7 * t)
    speed += 0.1 * 2 * np.pi * 1.9 * np.cos(2 * np.pi * 1.9 * t + 1)
    inside = slice(50, -50)
    np.testing.assert_allclose(np.deg2rad(m.over[0])[inside], speed[inside], atol=0.15)
    assert m.labels == ["speed of theta [deg/s]", "alpha [deg]"]
    before, after = m.lacking.values()
    sine = -((2 * np.pi * 0.3) ** 2) * 0.05 * np.sin(2 * np.pi * 0.3 * t)
    known = np.isfinite(before) & np.isfinite(after)
    difference = np.deg2rad(before - after)[known]  # the noise of both is the same
    np.testing.assert_allclose(difference, sine[known], atol=0.1 * np.abs(sine).max())
    assert m.usual == pytest.approx(np.std(after[known]), rel=0.2)


def test_lags_are_drawn_in_milliseconds_and_phases_within_half_a_turn_of_the_measured_one() -> None:
    rng = np.random.default_rng(4)
    tests = residual_tests(rng.standard_normal((500, 1)), rng.standard_normal(500), 0.004, ["theta"])
    own, cross = residual_figure({"baseline": tests}).axes
    assert own.lines[0].get_xdata()[3] == pytest.approx(12.0)
    assert cross.lines[0].get_xdata()[[0, -1]] == pytest.approx([-100.0, 100.0])
    f, one = np.array([1.0, 2.0, 4.0]), np.ones((1, 3))
    measured, simulated = (
        FrequencyResponse(f, np.exp(1j * np.deg2rad([degrees])), one)
        for degrees in ([-20.0, -170.0, 170.0], [-30.0, 175.0, 160.0])
    )
    axes = response_figure(measured, {"model": simulated}, {"theta": "rad"}, "V").axes
    phases = [line.get_ydata() for line in axes[1].lines]
    np.testing.assert_allclose(phases, [[-20.0, -170.0, -190.0], [-30.0, -185.0, -200.0]])


def test_figures_leave_the_settings_of_matplotlib_alone(discovery) -> None:
    import sys

    before = dict(matplotlib.rcParams)
    pictures(discovery)
    assert dict(matplotlib.rcParams) == before
    assert "matplotlib.pyplot" not in sys.modules or not sys.modules["matplotlib.pyplot"].get_fignums()


def test_a_figure_of_a_page_is_arranged_and_stays_as_it_is() -> None:
    """Long labels make room for themselves, and the figure can still be shown in another size."""
    figure = blank(6.0, 2.0)
    for axes in figure.subplots(1, 2):
        axes.set_ylabel("deflection\nof the arm [deg]")
    layout = figure.get_layout_engine()
    data_address(figure)
    left, right = (axes.get_tightbbox() for axes in figure.axes)
    assert left is not None and right is not None and left.x0 > 0 and left.x1 < right.x0
    assert figure.get_layout_engine() is layout


def test_degrees_are_drawn_where_angles_are_read(discovery) -> None:
    axes = pictures(discovery)["staircase"].figure.axes
    assert axes[0].get_ylabel() == "held-out rms error [deg]"
    points = axes[0].lines[0].get_ydata()
    assert points[0] == pytest.approx(np.rad2deg(discovery.baseline.held_out_rmse_windows["theta"]))


def test_the_missing_torque_is_shown_and_what_was_learned(discovery, page, monkeypatch) -> None:
    latent = LatentTorqueComparison(photographed(), photographed().given_back())
    grown = render(discovery, Explanation(latent, map_of_friction(discovery, True)))
    text = read(grown).text
    assert "At the hub the baseline lacks 0.014 N m rms" in text
    assert "At the joint the baseline lacks nothing that could be seen" in text
    assert "τ = −0.0300 sign(w)" in text or "τ = −0.03 sign(w)" in text
    assert "98 %" in text and "755 nat" in text
    assert "(98 % of what the map explains)" in str(map_of_friction(discovery, True))
    assert grown.count("<figure>") == page.count("<figure>") + 3
    monkeypatch.setattr("rotflex_jax.report.page.pictures", lambda *given: {})  # only text is checked below
    without = read(render(discovery, Explanation(latent, map_of_friction(discovery, False)))).text
    assert "does not make held-out data likelier" in without
    assert "The missing torque" not in read(page).text


def test_the_report_says_what_can_be_known(discovery, monkeypatch) -> None:
    """The report gives the identifiability of the final model; here one common factor is open."""
    monkeypatch.setattr("rotflex_jax.report.page.pictures", lambda *given: {})
    open_scale = paper().release("arm.inertia.inertia")
    last = dataclasses.replace(discovery.rounds[-1].stage, model=Model(open_scale))
    found = dataclasses.replace(
        discovery, rounds=(*discovery.rounds[:-1], dataclasses.replace(discovery.rounds[-1], stage=last))
    )
    known = found.identifiability()
    assert known is not None and not known.structural and known.badly_known is not None
    text = read(render(found, Explanation(known=known))).text
    assert "What can be known" in text
    assert "only their ratios are known, one common factor is open" in text
    assert "What can be known" not in read(render(found)).text


def test_a_map_is_learned_only_where_something_is_unexplained(
    discovery, undrawn, tmp_path, monkeypatch
) -> None:
    asked: list[str] = []

    def learned_torque(self, at: str, progress) -> LearnedTorqueResult:
        asked.append(at)
        return map_of_friction(self, True)

    monkeypatch.setattr(Discovery, "learned_torque", learned_torque)
    discovery.report(tmp_path / "a")
    assert not asked and not (tmp_path / "a" / "learned_torque.json").exists()
    dataclasses.replace(discovery, verdict=Verdict.UNEXPLAINED).report(tmp_path / "b")
    discovery.report(tmp_path / "c", learned=True)
    # At the port where most torque is missing.
    assert asked == ["hub", "hub"]
    for folder in ("b", "c"):
        taught = json.loads((tmp_path / folder / "learned_torque.json").read_text(encoding="utf-8"))
        assert taught["formula"] == "-0.03 sign(w) N m"


def test_the_folder_is_made_and_holds_page_and_json(discovery, undrawn, tmp_path) -> None:
    path = discovery.report(tmp_path / "new" / "folder")
    assert path == tmp_path / "new" / "folder" / "report.html"
    assert read(path.read_text(encoding="utf-8")).text
    text = (path.parent / "result.json").read_text(encoding="utf-8")
    assert json.loads(text) == discovery.to_dict()
    write_report(discovery, path.parent)  # again, over the existing files


def test_a_file_is_not_taken_for_a_folder(discovery, undrawn, tmp_path) -> None:
    file = tmp_path / "data.csv"
    file.write_text("t,theta\n")
    for place in (file, file / "below"):
        with pytest.raises(InputError, match=r"data\.csv.* is a file"):
            write_report(discovery, place)
    assert file.read_text() == "t,theta\n"


def test_a_folder_that_cannot_be_written_is_told(discovery, undrawn, tmp_path, monkeypatch) -> None:
    def refuse(file: Path, *args, **kwargs):
        if file.is_relative_to(tmp_path):  # of the file that is written beside the target
            raise PermissionError(13, "Permission denied")
        return opened(file, *args, **kwargs)

    opened = Path.open
    monkeypatch.setattr(Path, "open", refuse)
    with pytest.raises(InputError, match="Permission denied"):
        write_report(discovery, tmp_path)


def test_tables_for_a_terminal(discovery) -> None:
    console = Console(width=100, record=True, file=open("/dev/null", "w"))  # noqa: SIM115
    console.print(summary_table(discovery))
    console.print(parameter_table(discovery))
    console.file.close()
    text = console.export_text()
    assert "+ cubic spring at joint" in text
    assert "theta [deg]" in text
    assert "free runs over 2 s" in text
    assert "sensor noise" in text
    assert "hub.coulomb.level" in text
    assert "0.02980 … 0.03020" in text
    assert "held" in text


def validated(discovery: Discovery, test: Recording) -> Discovery:
    """The same result with another validation recording, whose errors are noise with one peak."""
    rng = np.random.default_rng(2)
    error = 0.01 * rng.standard_normal(test.y.shape)
    error[test.N // 3, 0] = PEAK
    stages = [dataclasses.replace(s, simulated=(), windowed=(test.y - error,)) for s in discovery.stages]
    rounds = tuple(dataclasses.replace(r, stage=s) for r, s in zip(discovery.rounds, stages[1:], strict=True))
    return dataclasses.replace(discovery, validation=(test,), baseline=stages[0], rounds=rounds)


PEAK = 7.0


def zoomable(page: str) -> list[tuple[dict[str, Any], str]]:
    """The data of each figure that can be zoomed, and the address of its still picture."""
    found = re.findall(
        r'<figure class="zoomable">\s*<img [^>]*src="([^"]*)"[^>]*>\s*<script[^>]*>(.*?)</scr', page
    )
    return [(json.loads(data), address) for address, data in found]


def numbers(text: str) -> np.ndarray:
    return np.frombuffer(base64.b64decode(text), "<f4")


def test_figures_to_zoom_hold_every_sample_of_a_common_recording(discovery) -> None:
    """With 20 s at 500 Hz the page is below 3 MB and has every sample; each figure has a still picture."""
    found = validated(discovery, moved(10_000, 0.002))
    page = render(found)
    assert len(page) < 3e6
    (overlay, still), (maps, other) = zoomable(page)
    for address in (still, other):
        assert unquote(address.removeprefix("data:image/svg+xml;charset=utf-8,")).startswith("<?xml")
    theta, error, alpha, _ = overlay["panels"]
    y = np.rad2deg(found.validation[0].y)
    assert overlay["x"] == {"label": "time [s]", "start": 0.0, "step": 0.002, "count": 10_000}
    assert [line["label"] for line in theta["lines"]] == ["measured", "baseline", "final model"]
    assert np.allclose(numbers(theta["lines"][0]["values"]), y[:, 0], rtol=1e-6)
    assert np.allclose(numbers(alpha["lines"][0]["values"]), y[:, 1], rtol=1e-6)
    left = y[:, 0] - np.rad2deg(found.baseline.windowed[0][:, 0])
    assert np.allclose(numbers(error["lines"][0]["values"]), left, atol=1e-5)
    assert error["band"] == pytest.approx(2 * np.rad2deg(NOISE))
    assert np.allclose(numbers(maps["y"]["values"]), y[:, 1], rtol=1e-6)
    assert [m["squared"] for m in maps["panels"]] == [True, False, False]


def test_long_recordings_keep_the_page_small_and_show_every_peak(discovery) -> None:
    found = validated(discovery, moved(60_000, 0.002))
    page = render(found)
    assert len(page) < 3e6
    assert "30 s of it are shown" in page
    overlay = zoomable(page)[0][0]
    x, error = overlay["x"], numbers(overlay["panels"][1]["lines"][0]["values"])
    assert x["count"] == len(error) < 60_000
    assert error.max() == pytest.approx(np.rad2deg(PEAK))
    assert x["step"] * int(error.argmax()) == pytest.approx(40.0, abs=0.02)
    assert x["step"] * (len(error) - 1) == pytest.approx(120.0, abs=0.02)


# A script that zooms with keys, a button, mouse, wheel and touch; then it drags over a map.
EXERCISE = """
const ranges = [], [over, map] = document.querySelectorAll("figure.zoomable");
const note = (f) => ranges.push(f.zoom.visible.range);
const press = (key) => over.querySelector(".zoom").dispatchEvent(new KeyboardEvent("keydown", { key }));
const send = (to, type, x, y, more) => {
  const given = { clientX: x, clientY: y, movementX: 1, bubbles: true, cancelable: true, ...more };
  to.dispatchEvent(new ({ p: PointerEvent, w: WheelEvent }[type[0]] || MouseEvent)(type, given));
};
const drag = (f, from, to) => {
  const field = f.querySelector(".u-over"), box = field.getBoundingClientRect();
  const at = ([x, y]) => [box.left + x * box.width, box.top + y * box.height];
  for (const type of ["mouseenter", "mousemove", "mousedown"]) send(field, type, ...at(from));
  for (const place of [document, field]) send(place, "mousemove", ...at(to));
  send(document, "mouseup", ...at(to));
};
note(over);
press("+"); note(over);
press("ArrowRight"); note(over);
over.querySelector("button").click(); note(over);
drag(over, [0.25, 0.5], [0.5, 0.5]); note(over);
const field = over.querySelector(".u-over"), box = field.getBoundingClientRect();
send(field, "wheel", box.left, box.top, { deltaY: -50, ctrlKey: true });
note(over);
field.setPointerCapture = () => {};
const finger = { pointerId: 7, pointerType: "touch" };
send(field, "pointerdown", box.left + 200, box.top + 20, finger);
send(field, "pointermove", box.left + 100, box.top + 20, finger);
note(over);
note(map);
drag(map, [0.5, 0.25], [1, 0.75]); note(map);
console.info("ranges: " + JSON.stringify(ranges));
"""


@pytest.mark.skipif(CHROMIUM is None, reason="chromium is not installed")
def test_a_browser_shows_the_page_without_complaint(page, tmp_path) -> None:
    path = tmp_path / "report.html"
    path.write_text(page.replace("</body>", f"<script>{EXERCISE}</script></body>"), encoding="utf-8")
    shot = tmp_path / "shot.png"
    flags = [
        "--headless",
        "--no-sandbox",
        "--disable-gpu",
        "--disable-quic",
        "--no-first-run",
        "--disable-background-networking",
        "--disable-component-update",
        "--disable-sync",
        "--hide-scrollbars",
        "--enable-logging=stderr",
        f"--user-data-dir={tmp_path / 'profile'}",
        "--window-size=1000,2400",
        f"--screenshot={shot}",
    ]
    done = subprocess.run([str(CHROMIUM), *flags, path.as_uri()], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    (line,) = [line for line in done.stderr.splitlines() if "CONSOLE" in line]
    whole, larger, right, again, dragged, wheel, pulled, plane, part = json.loads(
        re.search(r"ranges: (\[.*\])\"", line).group(1)
    )
    (a, b), (a1, b1), (a2, b2) = whole[0], larger[0], right[0]
    assert (a, b) == (0.0, pytest.approx(7.495))
    assert b1 - a1 == pytest.approx((b - a) / 1.6) and a1 + b1 == pytest.approx(a + b)
    assert (a2, b2) == pytest.approx((a1 + 0.2 * (b1 - a1), b1 + 0.2 * (b1 - a1)))
    assert again == whole
    assert dragged[0] == pytest.approx([b / 4, b / 2], abs=0.02)
    assert wheel[0][1] - wheel[0][0] < dragged[0][1] - dragged[0][0]
    assert wheel[0][0] == pytest.approx(dragged[0][0], abs=0.02)  # the point under the pointer stays
    assert pulled[0][0] > wheel[0][0] and pulled[0][1] - pulled[0][0] == pytest.approx(
        wheel[0][1] - wheel[0][0]
    )
    for (low, high), found, shares in zip(plane, part, ((0.5, 1.0), (0.25, 0.75)), strict=True):
        assert found == pytest.approx([low + s * (high - low) for s in shares], abs=0.02 * (high - low))
    picture = image.imread(shot)
    assert picture.shape[:2] == (2400, 1000)
    # Both halves have many colours; the figures are in the lower half.
    for half in (picture[:1200], picture[1200:]):
        assert len(np.unique(half[..., :3].reshape(-1, 3).round(2), axis=0)) > 100


def printed(discovery: Discovery, monkeypatch, capsys) -> str:
    monkeypatch.setattr(terminal, "output", lambda: Console(width=200, soft_wrap=True, highlight=False))
    terminal.print_discovery(discovery)
    return capsys.readouterr().out


def test_parameters_are_those_of_the_model_to_use(discovery, undrawn, monkeypatch, capsys) -> None:
    """A value of the final model may lie outside the interval of the round that found the effect."""
    final = discovery.final
    moved = tuple(
        dataclasses.replace(e, value=0.0312, ci95=(0.0311, 0.0313)) if e.name == "hub.coulomb.level" else e
        for e in final.estimates
    )
    last = dataclasses.replace(
        discovery.rounds[-1], stage=dataclasses.replace(final, estimates=moved), parameters={}
    )
    later = dataclasses.replace(discovery, rounds=(discovery.rounds[0], last))
    told = printed(later, monkeypatch, capsys)
    assert "level = 0.03120 N m   95 %: 0.03110 .. 0.03130   (0.03000 N m when it was added)" in told
    assert "0.02980" not in told
    text = read(render(later)).text.replace("\xa0", " ")
    assert (
        "in the model to use level 0.03120 N m 95 %: 0.03110 … 0.03130 · 0.03000 N m when it was added"
        in text
    )
    assert "0.03110 … 0.03130" in later._repr_html_() and "0.02980" not in later._repr_html_()
    same = printed(discovery, monkeypatch, capsys)
    assert "level = 0.03000 N m   95 %: 0.02980 .. 0.03020\n" in same


def test_an_effect_that_the_model_to_use_lacks_is_said_to_be_left_out(
    discovery, undrawn, monkeypatch, capsys
) -> None:
    kept = tuple(e for e in discovery.final.estimates if e.name != "hub.coulomb.level")
    last = dataclasses.replace(
        discovery.rounds[-1], stage=dataclasses.replace(discovery.final, estimates=kept)
    )
    without = dataclasses.replace(discovery, rounds=(discovery.rounds[0], last))
    told = printed(without, monkeypatch, capsys)
    assert "0.02980 .. 0.03020   when it was added; the model to use is without it" in told
    assert "· when it was added; the model to use is without it" in read(render(without)).text
    assert "hub.coulomb.level (not in the model to use)" in without._repr_html_()


def test_a_final_fit_gives_the_descriptions_and_notes_name_the_search(
    discovery, undrawn, monkeypatch, capsys
) -> None:
    """The effect in words has the values of the model to use, as the estimates below it."""
    bound = Remark("hub.coulomb.level", "at a bound", "hub.coulomb.level = 0 N m is at its lower bound")
    joint = paper() + Coulomb(at="hub", level=0.0377)
    level = dataclasses.replace(discovery.final.estimates[-2], name="hub.coulomb.level", value=0.0377)
    errors = RunErrors(discovery.final.held_out_rmse, discovery.final.held_out_rmse_windows)
    options = FitOptions(window_seconds=2.0)
    fit = Fit(Model(joint), 1.0, "converged", (level,), {}, np.zeros((0, 0)), (), 9, options=options)
    last = FinalFit(fit, discovery.train, Model(joint), errors, errors)
    found = dataclasses.replace(
        discovery, final_fit=last, remarks=(bound,), notes=(f"{bound.sentence}.", "Another note.")
    )
    told, page = printed(found, monkeypatch, capsys), read(render(found)).text.replace("\xa0", " ")
    assert "Round 1: Coulomb friction of 0.0377 N m at the hub\n" in told
    assert "Coulomb friction of 0.0377 N m at the hub." in page
    assert f"Round 2: {discovery.rounds[1].sentence} (values of the last round; the model to use is" in told
    assert "  1. Coulomb friction of 0.0377 N m at the hub\n" in str(found)
    for text in (told, page, found._repr_html_().replace("\xa0", " ")):
        assert "at its lower bound (last model of the search, before the final fit)." in text
        assert "Another note." in text
    assert "before the final fit" not in printed(discovery, monkeypatch, capsys)


def test_the_sentence_on_a_final_fit_says_what_it_was_compared_on(discovery) -> None:
    """What was left out of the fit has another reason for an offset; runs may have validated each other."""
    errors = RunErrors(discovery.final.held_out_rmse, discovery.final.held_out_rmse_windows)
    options = FitOptions(window_seconds=2.0)
    fit = Fit(Model(paper()), 1.0, "converged", (), {}, np.zeros((0, 0)), (), 9, options=options)
    left_out = (("cubic_spring", "joint"), ("voltage_offset", "input"))
    last = FinalFit(fit, discovery.train, Model(paper()), errors, errors, left_out=left_out)
    found = dataclasses.replace(discovery, final_fit=last)
    told = final_fit_sentence(found)
    spring = effect_phrase("cubic_spring", "joint")
    assert f"It is without {spring}, which the search has found: such runs are not clearly worse. " in told
    assert (
        "It is without voltage offset, which the search has found: such runs are not clearly worse, " in told
    )
    assert told.count("and other runs may not have it.") == 1
    assert " Fitted in the same way without the validation data, its errors on these over 2 s are " in told
    each_other = final_fit_sentence(dataclasses.replace(found, validation=found.train))
    assert "validation" not in each_other
    assert (
        " Fitted in the same way to a part of the recordings, its errors on the others over 2 s" in each_other
    )


def test_the_sizes_of_an_established_effect_are_said_to_agree_only_if_they_were_compared(discovery) -> None:
    gain = HorizonGain(1000.0, 10.0, 0.1)
    first = dataclasses.replace(discovery.rounds[0], equivalent=(), prediction=gain, free_run=gain)
    assert status_sentence(first).endswith("free runs are better with it, and its size agrees in all data.")
    own = dataclasses.replace(first.stage, friction_of_runs={"hub.coulomb.level": (0.03, 0.1)})
    said = status_sentence(dataclasses.replace(first, stage=own))
    assert said.endswith("free runs are better with it, and its size differs between runs.")
    other = dataclasses.replace(first, effect="delay", port="input")  # it has no amplitude
    assert status_sentence(other).endswith("Established: predictions and free runs are better with it.")
    sine = next(name for name, kind in CATALOG.items() if kind.line)
    said = status_sentence(dataclasses.replace(first, effect=sine, port="input"))
    assert said.endswith("free runs are better with it, and its size belongs to each recording.")


def test_a_value_that_is_a_mean_of_recordings_is_printed_as_one(discovery, monkeypatch, capsys) -> None:
    mean = [
        dataclasses.replace(e, note="mean of 0.01, 0.05") if e.name == "hub.coulomb.level" else e
        for e in discovery.final.estimates
    ]
    stage_ = dataclasses.replace(discovery.final, estimates=tuple(mean))
    last = dataclasses.replace(discovery.rounds[-1], stage=stage_)
    found = dataclasses.replace(discovery, rounds=(discovery.rounds[0], last))
    assert "95 %: 0.02980 .. 0.03020   mean of 0.01, 0.05\n" in printed(found, monkeypatch, capsys)


def test_a_machine_that_does_not_rotate_has_its_own_units_on_the_page(discovery, undrawn) -> None:
    def on_rails(s: Stage) -> Stage:
        mechanism = dataclasses.replace(s.model.mechanism, units=Units("m", "N"))
        return dataclasses.replace(s, model=Model(mechanism))

    rounds = tuple(dataclasses.replace(r, stage=on_rails(r.stage)) for r in discovery.rounds)
    found = dataclasses.replace(discovery, baseline=on_rails(discovery.baseline), rounds=rounds)
    learned = map_of_friction(discovery, True)
    learned = dataclasses.replace(learned, after=on_rails(learned.after))
    latent = LatentTorqueComparison(photographed(), None)
    text = read(render(found, Explanation(latent, learned))).text
    assert "Fitted white force, baseline [N² s]" in text and "(N m)² s" not in text
    meanings = {row.name: row.meaning for row in parameter_rows(found)}
    assert (meanings["hub.inertia.inertia"], meanings["hub.viscous.coefficient"]) == (
        "mass",
        "force per speed",
    )
    assert "with position q [m] and speed w [m/s], it says" in text
    turning = read(render(discovery, Explanation(latent, map_of_friction(discovery, True)))).text
    assert "Fitted white torque, baseline [(N m)² s]" in turning
    assert "with position q [rad] and speed w [rad/s], it says" in turning


def test_places_name_the_recording_that_they_are_about(discovery, undrawn, monkeypatch, capsys) -> None:
    (first, last), (unnamed, _) = (moved(source=name).split(0.7) for name in ("run.csv", ""))
    for train, validation, words in (
        (first, last, "the longest fitted recording: run.csv, 0 s to 7 s."),
        (last, first, "the longest validation recording: run.csv, 0 s to 7 s."),
        (last, unnamed, "the longest validation recording: 0 s to 7 s."),
    ):
        found = dataclasses.replace(discovery, train=(train,), validation=(validation,))
        assert f"All of this is about {words}" in printed(found, monkeypatch, capsys)
        assert words in found._repr_html_()
        assert words in read(render(found)).text.replace("\xa0", " ")


def test_offsets_that_all_of_a_recording_gave_are_said_to_be(discovery) -> None:
    def titles(seconds: float, recordings: tuple[Recording, ...]) -> list[str]:
        errors = discovery.final.held_out_rmse
        stages = [
            dataclasses.replace(s, calibrate_seconds=seconds, calibrated=RunErrors(errors, errors))
            for s in discovery.stages
        ]
        rounds = tuple(
            dataclasses.replace(r, stage=s) for r, s in zip(discovery.rounds, stages[1:], strict=True)
        )
        found = dataclasses.replace(discovery, baseline=stages[0], rounds=rounds, validation=recordings)
        return [t.title for t in error_lists(found)]

    long, short = moved(1500), moved(600)
    assert titles(2.0, (long,))[1].endswith("each recording with the offsets of its own first 2 s")
    assert titles(100.0, (long,))[1].endswith("offsets fitted to all of it, which is no longer than 100 s")
    assert titles(3.0, (long, short))[1].endswith("its own first 3 s, which is all of it in 1 of 2")


def test_errors_of_which_most_was_used_for_the_offsets_say_so(discovery) -> None:
    def note(seconds: float) -> str:
        errors = RunErrors(discovery.final.held_out_rmse, discovery.final.held_out_rmse_windows)
        first = dataclasses.replace(discovery.baseline, calibrate_seconds=seconds, calibrated=errors)
        found = dataclasses.replace(discovery, baseline=first, rounds=(), validation=(moved(2000),))
        return error_lists(found)[1].note

    assert "used for the offsets" not in note(5.0)
    assert note(8.0).endswith(
        " 8.0 of 10.0 s of the validation data were used for the offsets: these errors are nearly errors of "
        "a fit. Record more, or pass calibrate_seconds=2 (on the command line --calibrate 2)."
    )


def test_recordings_of_one_window_say_that_both_errors_are_the_same(discovery) -> None:
    def note(*lengths: int) -> str:
        recordings = tuple(moved(n) for n in lengths)
        return error_lists(dataclasses.replace(discovery, rounds=(), validation=recordings))[0].note

    said = "Each recording is one window, so errors over 2 s are those of one run over all of it."
    assert discovery.baseline.window_seconds == 2.0
    assert note(400).endswith(said) and note(400, 300).endswith(said)  # at 200 Hz
    assert said not in note(600) and said not in note(400, 600)


def test_the_share_that_is_a_candidates_own_is_a_plain_number(discovery, undrawn) -> None:
    shares = (0.997, 0.00041)
    first = [
        dataclasses.replace(r, orthogonal_fraction=x) for r, x in zip(discovery.ranking, shares, strict=False)
    ]
    page = render(dataclasses.replace(discovery, ranking=(*first, *discovery.ranking[2:])))
    assert re.search(r">\s*100 %\s*<", page) and re.search(r">\s*0.041 %\s*<", page) and "e+02" not in page


def test_latent_torques_are_printed_in_words() -> None:
    told = str(LatentTorqueComparison(photographed(), photographed().given_back()))
    assert "over 7.5 s of one recording" in told
    assert (
        "At the hub the baseline lacks 0.014 N m rms, 7.1 % of the motor's torque, the final model 0.020"
        in told
    )
    assert "The largest torque that the baseline lacks is 0.02 N m at the hub," in told
    assert "array" not in told and len(told) < 800
    assert "of recording 1." in str(
        LatentTorqueComparison(
            dataclasses.replace(photographed(), recording=np.arange(1500) // 800, Ts=(0.005, 0.005)), None
        )
    )
