"""Displays in a notebook are complete, escape the names that users chose, and load no plotting library."""

import dataclasses
import io
import re
import subprocess
import sys
from html import unescape
from xml.etree import ElementTree

import numpy as np
import pytest
from matplotlib.image import imread
from test_report import NOISE, moved, photographed, two_rounds

import rotflex_jax as rf
from rotflex_jax.compare.table import Comparison, Row
from rotflex_jax.discover.checkpoint import milestone
from rotflex_jax.discover.verdict import Verdict
from rotflex_jax.fit.result import Fit
from rotflex_jax.notebook.live import Live, live
from rotflex_jax.text.svg import Panel, bars, signals, staircase


def read(html: str) -> str:
    """The visible text of a card, which must be well-formed."""
    return unescape(" ".join(ElementTree.fromstring(html.replace("\xa0", " ")).itertext()))


def numbers(svg: str, tag: str, attribute: str) -> list[str]:
    root = ElementTree.fromstring(svg)
    return [e.attrib[attribute] for e in root.iter() if e.tag.endswith(tag) and attribute in e.attrib]


@pytest.fixture(scope="module")
def fitted() -> Fit:
    found = two_rounds().final
    return Fit(
        found.model,
        12.5,
        "converged",
        found.estimates,
        {"theta": np.pi / 180, "alpha": 0.1},
        np.eye(2),
        (),
        7,
    )


def test_a_recording_says_what_was_measured() -> None:
    text = read(moved(source="<script>alert(1)</script>")._repr_html_())
    assert "2000 samples, 10 s at 200 Hz" in text and "<script>alert(1)" in text
    # Angles in radians are shown in degrees; the voltage keeps its unit.
    low, high = re.search(r"theta deg (\S+) … (\S+)", text).groups()
    assert float(high) == pytest.approx(np.rad2deg(moved().channel("theta").max()), rel=0.01)
    assert float(low.replace("−", "-")) < 0 and "voltage V" in text


def test_a_fit_shows_every_parameter_with_its_unit(fitted) -> None:
    text = read(fitted._repr_html_())
    assert "converged after 7 steps" in text and "theta deg 1.00" in text
    for estimate in fitted.parameters:
        assert estimate.name in text
    assert "N m s/rad" in text and "0.02980 … 0.03020" in text and "held" in text


def test_a_discovery_shows_verdict_rounds_errors_and_doubts() -> None:
    found = two_rounds()
    text = read(found._repr_html_())
    for expected in (
        "Found, but not distinguished from others",
        "Coulomb friction at hub",
        "dry friction at the hub is certain, but not whether it is Coulomb friction or Stribeck friction",
        "τ = −stiffness · position³",
        "78 % of the theta error",
        "sensor noise",
        "<u>offset</u>",
        "<i>own</i>",
    ):
        assert expected in text
    theta = np.rad2deg(found.baseline.held_out_rmse_windows["theta"])
    assert f"{theta:.3g}" in text


def test_a_discovery_without_a_round_is_shown_too() -> None:
    found = dataclasses.replace(two_rounds(), rounds=(), verdict=Verdict.NOTHING_MISSING)
    assert "Nothing is missing" in read(found._repr_html_())


def test_a_mechanism_shows_its_laws_and_what_is_held() -> None:
    joint = rf.joints.paper() + rf.effects.Coulomb(at="hub", level=0.0123)
    text = read(joint._repr_html_())
    assert "joint (0, 1)" in text and "τ = −level · sign(speed)" in text
    assert re.search(r"hub\.coulomb\.level N m .*0\.0123", text)
    assert re.search(r"arm\.inertia\.inertia kg m² moment of inertia held", text)


def test_a_comparison_and_a_latent_torque_are_shown() -> None:
    recording = moved(source="")
    errors = {"theta": 0.01, "alpha": 0.002}
    shares = {"theta": 90.0, "alpha": 80.0}
    row = Row(
        "<b>mine</b>", "own", rmse=errors, rmse_windows=errors, worst=errors, fit_percent=shares, parameters=3
    )
    bad = Row("poor", "own", status="failed", reason="a < b")
    text = read(Comparison((row, bad), (recording,), (recording,), errors, 2.0, 1.0)._repr_html_())
    assert "best: <b>mine</b>" in text and "0.573" in text and "poor: failed: a < b" in text
    assert "hub" in read(photographed()._repr_html_())


def test_a_staircase_falls_where_the_error_falls() -> None:
    svg = staircase(["as it is", "+ a & b"], {"theta [deg]": [1.0, 0.1]}, {"theta [deg]": 0.03})
    levels = [
        float(p[1:].split(",")[1].split("H")[0])
        for p in numbers(svg, "path", "d")
        if "H" in p and "V" not in p
    ]
    axis, noise, first, last = levels
    assert first < last < noise < axis  # downwards on the screen
    # The scale is logarithmic.
    assert (noise - last) / (last - first) == pytest.approx(np.log10(0.1 / 0.03), rel=0.01)


def test_drawings_bear_what_data_hold() -> None:
    assert bars([("nothing", float("nan"), "")], "x") == ""
    assert staircase([], {}, {}) == ""
    gap = np.array([0.0, np.nan, 1.0])
    ElementTree.fromstring(signals(np.arange(3.0), [Panel("flat", [(np.ones(3), "red", "")])], "t"))
    ElementTree.fromstring(signals(np.arange(3.0), [Panel("gap", [(gap, "red", "2 2")])], "t"))
    # A long signal is thinned, and its extremes are kept.
    spike = np.zeros(100_000)
    spike[54_321] = 1.0
    points = numbers(signals(np.arange(1e5), [Panel("s", [(spike, "red", "")])], "t"), "polyline", "points")[
        0
    ]
    assert len(points.split()) < 700 and len({p.split(",")[1] for p in points.split()}) == 2


class Handle:
    def __init__(self) -> None:
        self.shown: list[str] = []

    def update(self, what: Live) -> None:
        self.shown.append(what._repr_html_())


def test_the_staircase_grows_while_a_search_runs() -> None:
    follow, handle = Live("<search>"), Handle()
    follow._handle = handle
    units = {"theta": "rad", "alpha": "rad"}
    floor = np.array([NOISE, NOISE])
    for label, errors in (("as it is", [0.02, 0.01]), ("+ dead_zone at input", [0.002, 0.001])):
        follow(milestone(label, ["theta", "alpha"], units, np.array(errors), floor))
        follow("refitting")  # too soon after a milestone to be drawn
    assert len(handle.shown) == 2 and "<search>" in read(handle.shown[-1])
    assert follow.labels == ["as it is", "+ input dead zone"]
    np.testing.assert_allclose(follow.errors["theta [deg]"], np.rad2deg([0.02, 0.002]))


def test_nothing_happens_outside_a_notebook(capsys) -> None:
    follow = live()
    follow("a line")
    assert follow._handle is None and capsys.readouterr() == ("", "")


def test_importing_the_package_loads_nothing_that_draws() -> None:
    script = (
        "import sys, rotflex_jax as rf; rf.joints.paper()._repr_html_(); rf.live();"
        "print(sorted({'matplotlib', 'IPython', 'ipywidgets'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_a_figure_shows_itself_without_a_magic_line() -> None:
    pixels = imread(io.BytesIO(photographed().plot()._repr_png_()))
    assert pixels.shape[1] >= 600 and pixels.std() > 0.01
