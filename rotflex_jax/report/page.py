"""The report of a search as one HTML page."""

import math
import platform
from collections.abc import Sequence
from importlib import metadata
from pathlib import Path
from typing import Any

from rotflex_jax.discover.explanation import Explanation
from rotflex_jax.discover.learned_torque import LearnedTorqueResult
from rotflex_jax.discover.result import Ranked, Round, SearchResult, Where
from rotflex_jax.discover.tables import (
    FITTED_TO_ALL,
    Outcome,
    channel_headings,
    channel_units,
    description_in_use,
    error_tables,
    estimates_in_use,
    final_fit_sentence,
    has_moved,
    next_steps,
    noise_row,
    notes_in_words,
    outcomes,
    parameter_rows,
    stage_labels,
    status_sentence,
    where_sentence,
)
from rotflex_jax.discover.verdict import FAR_FLOOR, NEAR_FLOOR, Grade, grade
from rotflex_jax.effects import CATALOG
from rotflex_jax.effects.labels import effect_label, effect_title, sentence
from rotflex_jax.parameters import HALF_WIDTH_95, Estimate
from rotflex_jax.recording import Recording
from rotflex_jax.report.figures import pictures
from rotflex_jax.text.colours import INK, stage_colours
from rotflex_jax.text.markup import as_json, fill_template, write_files
from rotflex_jax.text.numbers import (
    equation,
    multiple,
    percent_explained,
    percent_own,
    plain_number,
    ratio,
    readable,
    together,
    unit_text,
    value_and_interval,
)
from rotflex_jax.text.plotting import by_section

REPORTED_PACKAGES = ("rotflex_jax", "jax", "equinox", "optimistix", "numpy", "scipy", "matplotlib")


def content(discovery: SearchResult, explanation: Explanation) -> dict[str, Any]:
    """Content of the template, as plain text that the template escapes."""
    labels, colours = stage_labels(discovery), stage_colours(len(discovery.stages))
    models = list(zip(labels, colours, strict=True))
    if discovery.final_fit:
        models.append((FITTED_TO_ALL, INK))
    longest = discovery.validation[discovery.longest_validation]
    latent, learned, remaining = explanation.latent, explanation.learned, explanation.remaining
    return {
        "tone": tone(discovery),
        "criterion": discovery.assessment.criterion,
        "headline": discovery.verdict.shown.headline,
        "summary": sentence(discovery.sentence),
        "seconds": f"{discovery.baseline.window_seconds:g}",
        "tiles": _tiles(discovery),
        "rounds": [_round(discovery, k) for k in range(len(discovery.rounds))],
        "probable": discovery.probabilities,
        "notes": notes_in_words(discovery),
        "steps": next_steps(discovery),
        "stages": models,
        "final_fit": final_fit_sentence(discovery),
        "error_tables": error_tables(discovery),
        "headings": channel_headings(discovery),
        "noise": noise_row(discovery),
        "at_noise": f"{NEAR_FLOOR:g}",
        "far": f"{FAR_FLOOR:g}",
        "tests": _test_lines(explanation),
        "pictures": by_section(pictures(discovery, explanation).values()),
        "places": _places(discovery.where),
        "place": together(where_sentence(discovery)),
        "place_left": together(where_sentence(discovery, longest)),
        "torques": [together(line) for line in latent.sentences] if latent else [],
        "learned": _learned_torque(discovery, learned) if learned else None,
        "remaining": _places(remaining),
        "arises": any("arises" in w.statement for w in (*discovery.where, *remaining)),
        "ranking": [_ranked(r, outcome) for r, outcome in outcomes(discovery)],
        "has_line": any(CATALOG[r.effect].line for r in discovery.ranking if r.effect in CATALOG),
        "hidden": sum(not r.excited for r in discovery.ranking),
        "parameters": parameter_rows(discovery),
        "known": [together(s) for s in explanation.known.sentences] if explanation.known else [],
        "recordings": _recordings(discovery),
        "settings": _settings(discovery),
        "model": str(discovery.model.mechanism),
        "source": next((r.source for r in discovery.validation if r.source), ""),
    }


def _tiles(discovery: SearchResult) -> list[dict[str, str]]:
    """Tiles with the error of each channel before and after the search, on test data if there are any.

    The error after the search is the error of the final model, or of the final fit if it was tested.
    """
    tiles, data, fit = [], "test" if discovery.test else "validation", discovery.final_fit
    first, last = (
        s.test.windows if s.test else s.held_out_rmse_windows for s in (discovery.baseline, discovery.final)
    )
    if fit and fit.test:
        last = fit.test.windows
    for channel, unit in channel_units(discovery).items():
        before, read = readable(first[channel], unit)
        after, _ = readable(last[channel], unit)
        times = ratio(last[channel], discovery.noise_floor.get(channel))
        text = f"{multiple(times)} × the sensor noise" if math.isfinite(times) else f"error on {data} data"
        if discovery.rounds and 0 < first[channel] < math.inf:
            share = 100 * (1 - (last[channel] / first[channel]) ** 2)
            text += f" · {percent_explained(share)} of the squared error explained"
        tiles.append(
            {
                "channel": channel,
                "data": data,
                "before": plain_number(before) if discovery.rounds else "",
                "after": f"{plain_number(after)} {read}",
                "note": text,
                "tone": TONES[grade(times)],
            }
        )
    return tiles


TONES = {None: "muted", Grade.NOISE: "yes", Grade.NEAR: "warn", Grade.FAR: "bad"}
"""Grade of an error -> class of the style sheet."""


def tone(discovery: SearchResult) -> str:
    """Style class of the headline: an unexplained error is bad far above the noise, else a warning."""
    shown = discovery.verdict.shown.tone
    return "warn" if shown == "bad" and discovery.assessment.grade is not Grade.FAR else shown


def _round(discovery: SearchResult, k: int) -> dict[str, Any]:
    added, before = discovery.rounds[k], discovery.stages[k]
    falls, parameters = [], []
    for name, used in estimates_in_use(discovery, added).items():
        found = added.parameters[name]
        e = used or found
        shown = (name, *_shown(e), together(e.unit), _earlier(found, used))
        parameters.append((*shown, e.note, together(e.given_words)))
    for channel, unit in channel_units(discovery).items():
        old, read = readable(before.held_out_rmse_windows[channel], unit)
        new, _ = readable(added.stage.held_out_rmse_windows[channel], unit)
        falls.append(f"{channel} {plain_number(old)} → {plain_number(new)} {read}")
    return {
        "title": f"{effect_title(added.effect)}, {added.port}",
        "label": f"{added.effect} at {added.port}",
        "sentence": sentence(description_in_use(discovery, added)),
        "equation": equation(added.equation),
        "parameters": parameters,
        "evidence": _evidence(added),
        "status_sentence": status_sentence(added),
        "is_established": added.status == "established",
        "falls": ", ".join(falls),
    }


def _evidence(added: Round) -> str:
    """Gain and score of an effect in a sentence; what is not known is left out."""
    gain, score = added.held_out_gain_nats, added.score
    parts = [f"log-likelihood of validation data {_with_sign(gain)} nat"] if math.isfinite(gain) else []
    parts += [f"score {plain_number(score)} nat"] if math.isfinite(score) else []
    return sentence(", ".join(parts))


def _test_lines(explanation: Explanation) -> list[str]:
    """Results of the residual tests of the last model, in words."""
    tests = explanation.tests.residuals if explanation.tests else {}
    if not tests:
        return []
    name, last = list(tests.items())[-1]
    return [f"{name.capitalize()}, {line}" for line in last.sentences()]


def _shown(estimate: Estimate) -> tuple[str, str]:
    """Value and 95 % interval of an estimate, or the reason why it has no interval."""
    value, interval = value_and_interval(estimate)
    if interval:
        return value, f"95 %: {interval}"
    return value, "no interval" if estimate.free else "held"


def _places(places: Sequence[Where]) -> list[dict[str, Any]]:
    return [
        {"text": together(w.statement), "p": _p_value(w.p_value), "none": len(w.edges) < 2} for w in places
    ]


def _earlier(found: Estimate, used: Estimate | None) -> str:
    """Value of an estimate when its effect was added, in words, if it differs in the model to use."""
    if used is None:
        return "when it was added; the model to use is without it"
    if not has_moved(found, used):
        return ""
    return f"{value_and_interval(found)[0]} {together(found.unit)}".rstrip() + " when it was added"


def _with_sign(value: float) -> str:
    """A number with its sign.

    >>> _with_sign(416.2), _with_sign(-89.3)
    ('+ 416', '− 89.3')
    """
    return f"{'−' if value < 0 else '+'} {plain_number(abs(value))}"


def _p_value(p: float) -> str:
    return "p < 0.001" if p < 0.001 else f"p = {p:.2g}"


def _ranked(r: Ranked, outcome: Outcome) -> dict[str, str]:
    return {
        "label": effect_label(r.effect, r.port),
        "title": effect_title(r.effect),
        "score": plain_number(r.score),
        "own": percent_own(r.orthogonal_fraction),
        "state": outcome.value,
    }


def _recordings(discovery: SearchResult) -> list[dict[str, Any]]:
    alone = discovery.validation != discovery.train
    parts = [("fitted" if alone else "fitted, and validated by fits without it", r) for r in discovery.train]
    parts += [("validation", r) for r in discovery.validation] if alone else []
    parts += [("test", r) for r in discovery.test]
    return [
        {
            "use": use,
            "source": r.source or "unnamed",
            "span": f"{r.start:g} to {r.start + r.duration:g} s",
            "samples": f"{r.N} at {1 / r.Ts:g} Hz",
            "signals": _signals(r),
            "findings": [(f.severity, f.message) for f in r.findings],
        }
        for use, r in parts
    ]


def _signals(r: Recording) -> str:
    outputs = ", ".join(f"{c} [{u}]" for c, u in zip(r.channels, r.units, strict=True))
    inputs = ", ".join((f"{r.input_name} [{r.input_unit}]", *r.signals))
    return f"{inputs} → {outputs}"


def _settings(discovery: SearchResult) -> list[tuple[str, str]]:
    seen = sorted({r.n_init for r in discovery.validation})
    rows = [
        ("Length of the short free runs", f"{discovery.baseline.window_seconds:g} s"),
        (
            "Samples at the start of each window from which the first state is estimated",
            ", ".join(map(str, seen)),
        ),
        ("Candidate effects", str(len(discovery.ranking))),
        ("Time taken", f"{discovery.elapsed_s:.1f} s"),
    ]
    own = discovery.baseline.model.mechanism.units
    torque, unit = own.sentence("white torque"), unit_text(own.unit("(N m)^2 s"))
    for label, stage in zip(stage_labels(discovery), discovery.stages, strict=True):
        noise = ", ".join(f"{p} {plain_number(q)}" for p, q in stage.process_noise.items())
        rows.append((f"Fitted {torque}, {label} [{unit}]", noise or "none"))
    versions = ", ".join(f"{p} {_version(p)}" for p in REPORTED_PACKAGES)
    rows.append(("Versions", f"Python {platform.python_version()}, {versions}"))
    return rows


def _version(package: str) -> str:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return "(not installed)"


def _learned_torque(discovery: SearchResult, learned: LearnedTorqueResult) -> dict[str, Any]:
    """A learned torque in words: the change of the errors, and its formula."""
    falls, unit = [], learned.model.mechanism.units.unit
    for channel, read_in in channel_units(discovery).items():
        old, read = readable(learned.before.held_out_rmse_windows[channel], read_in)
        new, _ = readable(learned.after.held_out_rmse_windows[channel], read_in)
        falls.append(f"{channel} {plain_number(old)} → {plain_number(new)} {read}")
    return {
        "port": learned.at,
        "motion": learned.model.mechanism.units.motion,
        "kept": learned.kept,
        "falls": ", ".join(falls),
        "gain": _with_sign(learned.held_out_gain_nats) + "\xa0nat",
        "formula": together(equation(f"tau = {learned.reading}")) if learned.formula.terms else "",
        "terms": [
            (
                equation(t.name) if t.name != "1" else "constant",
                f"{plain_number(t.coefficient)} ± {plain_number(HALF_WIDTH_95 * t.std, 2)} "
                f"{together(unit(t.unit))}",
                f"{100 * t.share:.0f}\xa0%",
            )
            for t in learned.formula.terms
        ],
    }


def write(discovery: SearchResult, folder: Path, explanation: Explanation | None = None) -> Path:
    """Writes `report.html`, `result.json` and a learned torque if there is one; returns the page's path."""
    explanation = explanation or Explanation()
    files = {"result.json": as_json(discovery.to_dict())}
    if explanation.learned is not None:
        files["learned_torque.json"] = as_json(explanation.learned.to_dict())
    write_files(folder, files | {"report.html": render(discovery, explanation)})
    return folder / "report.html"


def render(discovery: SearchResult, explanation: Explanation | None = None) -> str:
    """The HTML page as text."""
    return fill_template(
        "rotflex_jax.report", "report.html.j2", content(discovery, explanation or Explanation())
    )
