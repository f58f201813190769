"""What a report says, as plain text that the template escapes."""

import datetime
import platform
from collections.abc import Sequence
from importlib import metadata
from typing import Any

from rotflex_jax.discover.learned_result import LearnedTorqueResult
from rotflex_jax.discover.locate import locate
from rotflex_jax.discover.photographs import Photographs
from rotflex_jax.discover.result import Discovery, Ranked, Where
from rotflex_jax.parameters import Estimate
from rotflex_jax.recording import Recording
from rotflex_jax.report.figures import pictures
from rotflex_jax.report.runs import shown
from rotflex_jax.report.style import on_page, stage_colours
from rotflex_jax.report.tables import (
    channel_headings,
    error_rows,
    noise_row,
    parameter_rows,
    stage_labels,
)
from rotflex_jax.report.torques import told_latent, told_learned
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
    standing,
    together,
    units,
    value_and_interval,
)

PACKAGES = ("rotflex_jax", "jax", "equinox", "optimistix", "numpy", "scipy", "matplotlib")


def content(
    discovery: Discovery, lacking: Photographs | None = None, learned: LearnedTorqueResult | None = None
) -> dict[str, Any]:
    """What the template fills in; plain text that the template escapes."""
    labels, colours = stage_labels(discovery), stage_colours(len(discovery.stages))
    remaining = _remaining(discovery)
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
            name: on_page(p.figure, p.caption, p.description)
            for name, p in pictures(discovery, lacking, learned).items()
        },
        "places": _places(discovery.where),
        "torques": told_latent(lacking) if lacking else [],
        "learned": told_learned(discovery, learned) if learned else None,
        "remaining": _places(remaining),
        "arises": any("arises" in w.statement for w in (*discovery.where, *remaining)),
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
        text = f"{plain_number(times, 2)} × the sensor noise" if times == times else "held-out error"
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
        "title": f"{effect_title(turn.effect)}, {turn.port}",
        "label": f"{turn.effect} at {turn.port}",
        "sentence": sentence(turn.sentence),
        "equation": equation(turn.equation),
        "parameters": [
            (name, *value_and_interval(e), together(e.unit), _later(discovery, e), e.note)
            for name, e in turn.parameters.items()
        ],
        "equivalent": " or ".join(effect_label(*pair) for pair in turn.equivalent),
        "gain": plain_number(turn.held_out_gain_nats),
        "score": plain_number(turn.score),
        "falls": ", ".join(falls),
    }


def _places(places: Sequence[Where]) -> list[dict[str, Any]]:
    return [
        {"text": together(w.statement), "p": _p_value(w.p_value), "none": len(w.edges) < 2} for w in places
    ]


def _remaining(discovery: Discovery) -> tuple[Where, ...]:
    """Where the final model fails, if effects were found and something is left."""
    s = shown(discovery)
    if discovery.verdict != "unexplained" or s.final is None:
        return ()
    mechanism, seconds = discovery.model.mechanism, discovery.final.window_seconds
    return locate(
        s.recording,
        s.measured - s.final,
        mechanism.channels,
        discovery.noise_floor,
        mechanism,
        window_seconds=seconds,
    )


def _later(discovery: Discovery, estimate: Estimate) -> str:
    """The estimate of the same parameter in the final model, where it is another one."""
    value = value_and_interval(estimate)[0]
    for last in discovery.final.estimates:
        if last.name == estimate.name and last.value != estimate.value:
            text = value_and_interval(last)[0]
            return text if text != value else ""
    return ""


def _p_value(p: float) -> str:
    return "p < 0.001" if p < 0.001 else f"p = {p:.2g}"


def _ranked(discovery: Discovery, r: Ranked) -> dict[str, str]:
    pair = (r.effect, r.port)
    found = [(t.effect, t.port) for t in discovery.rounds]
    alike = [p for t in discovery.rounds for p in t.equivalent]
    state = standing(r, found, alike)
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
        rows.append((f"White torque that the data ask for, {label} [(N\xa0m)² s]", noise or "none"))
    versions = ", ".join(f"{p} {_version(p)}" for p in PACKAGES)
    rows.append(("Versions", f"Python {platform.python_version()}, {versions}"))
    return rows


def _version(package: str) -> str:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return "(not installed)"
