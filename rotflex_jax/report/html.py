"""The report as one HTML page that needs no other file and no network."""

import datetime
import json
import platform
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any

import jinja2

from rotflex_jax.discover.result import Discovery, Ranked
from rotflex_jax.errors import InputError
from rotflex_jax.recording import Recording
from rotflex_jax.report.figures import pictures
from rotflex_jax.report.style import data_address, stage_colours
from rotflex_jax.report.tables import (
    channel_headings,
    error_rows,
    noise_row,
    parameter_rows,
    stage_labels,
)
from rotflex_jax.report.wording import (
    AT_NOISE,
    HEADLINES,
    effect_label,
    effect_title,
    equation,
    next_steps,
    noise_ratios,
    plain_number,
    readable,
    sentence,
    unit_text,
    units,
    value_and_interval,
)

PACKAGES = ("rotflex_jax", "jax", "equinox", "optimistix", "numpy", "scipy", "matplotlib")


def write(discovery: Discovery, folder: Path) -> Path:
    """Write `report.html` and `result.json`; returns the path of the page."""
    page = render(discovery)
    text = json.dumps(discovery.to_dict(), indent=2, ensure_ascii=False) + "\n"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "result.json").write_text(text, encoding="utf-8")
        (folder / "report.html").write_text(page, encoding="utf-8")
    except (FileExistsError, NotADirectoryError) as error:
        raise InputError(
            f"{folder} cannot hold the report, since {error.filename or folder} is a file and no "
            "folder; name another folder."
        ) from error
    except OSError as error:
        raise InputError(
            f"{folder} cannot be written to ({error.strerror or error}), but the report needs a "
            "folder of its own; name another folder."
        ) from error
    return folder / "report.html"


def render(discovery: Discovery) -> str:
    """The page as text."""
    return _template().render(content(discovery))


@cache
def _template() -> jinja2.Template:
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("rotflex_jax.report"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template("report.html.j2")


def content(discovery: Discovery) -> dict[str, Any]:
    """What the template fills in; plain text that the template escapes."""
    labels, colours = stage_labels(discovery), stage_colours(len(discovery.stages))
    return {
        "discovery": discovery,
        "headline": HEADLINES.get(discovery.verdict, discovery.verdict.replace("_", " ")),
        "summary": sentence(discovery.sentence),
        "tiles": _tiles(discovery),
        "rounds": [_round(discovery, k) for k in range(len(discovery.rounds))],
        "steps": next_steps(discovery),
        "stages": list(zip(labels, colours, strict=True)),
        "errors": error_rows(discovery),
        "headings": channel_headings(discovery),
        "noise": noise_row(discovery),
        "at_noise": f"{AT_NOISE:g}",
        "pictures": {
            name: {"address": data_address(p.figure), "caption": p.caption, "alt": p.description}
            for name, p in pictures(discovery).items()
        },
        "places": [{"text": w.statement, "p": _p_value(w.p_value)} for w in discovery.where],
        "ranking": [_ranked(discovery, r) for r in discovery.ranking],
        "hidden": sum(not r.excited for r in discovery.ranking),
        "parameters": parameter_rows(discovery),
        "recordings": _recordings(discovery),
        "settings": _settings(discovery),
        "model": str(discovery.model.mechanism),
        "date": datetime.datetime.now().astimezone().strftime("%d %B %Y, %H:%M"),
        "source": next((r.source for r in discovery.test if r.source), ""),
    }


def _tiles(discovery: Discovery) -> list[dict[str, str]]:
    """The error of each channel before and after, large."""
    tiles, multiples = [], noise_ratios(discovery)
    for channel, unit in units(discovery).items():
        before, read = readable(discovery.baseline.held_out_rmse_windows[channel], unit)
        after, _ = readable(discovery.final.held_out_rmse_windows[channel], unit)
        times = multiples[channel]
        text = (
            f"{plain_number(times, 2)} × the sensor noise" if times == times else "held-out error"
        )
        tiles.append(
            {
                "channel": channel,
                "before": plain_number(before) if discovery.rounds else "",
                "after": f"{plain_number(after)} {read}",
                "note": text,
                "reached": "yes" if times < AT_NOISE else "",
            }
        )
    return tiles


def _round(discovery: Discovery, number: int) -> dict[str, Any]:
    turn, before = discovery.rounds[number], discovery.stages[number]
    falls = []
    for channel, unit in units(discovery).items():
        old, read = readable(before.held_out_rmse_windows[channel], unit)
        new, _ = readable(turn.stage.held_out_rmse_windows[channel], unit)
        falls.append(f"{channel} {plain_number(old)} → {plain_number(new)} {read}")
    return {
        "title": effect_title(turn.effect),
        "label": effect_label(turn.effect, turn.port),
        "sentence": sentence(turn.sentence),
        "equation": equation(turn.equation),
        "parameters": [
            (name, *value_and_interval(e), unit_text(e.unit), e.note)
            for name, e in turn.parameters.items()
        ],
        "equivalent": [effect_label(*pair) for pair in turn.equivalent],
        "gain": plain_number(turn.held_out_gain_nats),
        "score": plain_number(turn.score),
        "falls": ", ".join(falls),
    }


def _p_value(p: float) -> str:
    return "p < 0.001" if p < 0.001 else f"p = {p:.2g}"


def _ranked(discovery: Discovery, r: Ranked) -> dict[str, str]:
    pair = (r.effect, r.port)
    found = [(t.effect, t.port) for t in discovery.rounds]
    alike = [p for t in discovery.rounds for p in t.equivalent]
    state = (
        "found"
        if pair in found
        else "cannot be told from what was found"
        if pair in alike
        else "not added"
        if r.excited
        else "not excited"
    )
    return {
        "label": effect_label(*pair),
        "title": effect_title(r.effect),
        "score": plain_number(r.score),
        "own": f"{100 * r.unconfounded:.2g} %",
        "state": state,
    }


def _recordings(discovery: Discovery) -> list[dict[str, Any]]:
    parts = [("fitted", r) for r in discovery.train] + [("held out", r) for r in discovery.test]
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
    return f"{r.input_name} [{r.input_unit}] → {outputs}"


def _settings(discovery: Discovery) -> list[tuple[str, str]]:
    looked = sorted({r.n_init for r in discovery.test})
    rows = [
        ("Windows of the short held-out runs", f"{discovery.baseline.window_seconds:g} s"),
        (
            "Samples at the start of each window that the model may look at",
            ", ".join(map(str, looked)),
        ),
        ("Candidate effects", str(len(discovery.ranking))),
        ("Time taken", f"{discovery.elapsed_s:.1f} s"),
    ]
    for label, stage in zip(stage_labels(discovery), discovery.stages, strict=True):
        noise = ", ".join(f"{p} {plain_number(q)}" for p, q in stage.process_noise.items())
        rows.append((f"Process torque, {label} [(N m)² s]", noise or "none"))
    versions = ", ".join(f"{p} {_version(p)}" for p in PACKAGES)
    rows.append(("Versions", f"Python {platform.python_version()}, {versions}"))
    return rows


def _version(package: str) -> str:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return "(not installed)"
