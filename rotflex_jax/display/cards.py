"""Results as a notebook shows them: what a person asks first, in tables with units and a small drawing."""

import math
from typing import TYPE_CHECKING

import numpy as np

from rotflex_jax.display.drawing import AFTER, INK, Panel, bars, signals, staircase
from rotflex_jax.display.markup import card, folded, listed, paragraph, picture, table
from rotflex_jax.parameters import Estimate
from rotflex_jax.report.tables import channel_headings, error_rows, noise_row, stage_labels
from rotflex_jax.report.wording import (
    HEADLINES,
    effect_label,
    equation,
    plain_number,
    readable,
    sentence,
    standing,
    unit_text,
    units,
    value_and_interval,
)

if TYPE_CHECKING:
    from rotflex_jax.compare.table import Comparison
    from rotflex_jax.discover.result import Discovery
    from rotflex_jax.fit.fitted import Fit
    from rotflex_jax.latent.result import LatentTorque
    from rotflex_jax.mechanism import Mechanism
    from rotflex_jax.recording import Recording

_LISTED = 8


def recording_card(r: "Recording") -> str:
    """What was measured: extent, ranges, steps of the sensors, findings, and the signals over time."""
    rows, panels = [], []
    outputs = zip(r.channels, r.units, r.y.T, strict=True)
    columns = [(r.input_name, r.input_unit, r.u, None)]
    columns += [(name, unit, values, r.resolution.get(name)) for name, unit, values in outputs]
    for name, unit, values, step in columns:
        factor, read = readable(1.0, unit)
        low, high = factor * float(np.min(values)), factor * float(np.max(values))
        quantum = "" if step is None else plain_number(factor * step)
        spread = plain_number(factor * float(np.std(values)))
        rows.append((name, read, f"{plain_number(low)} … {plain_number(high)}", spread, quantum))
        panels.append(Panel(f"{name} [{read}]", [(factor * np.asarray(values, float), AFTER, "")]))
    head = f"{r.N} samples, {r.duration:g} s at {1 / r.Ts:g} Hz; models may see the first {r.n_init} samples"
    return card(
        f"Recording{f': {r.source}' if r.source else ''}",
        paragraph(head),
        picture(signals(r.t, panels, "time [s]"), "The input and the outputs over time."),
        table(("signal", "unit", "range", "deviation", "sensor step"), rows, words=2),
        listed(finding.message for finding in r.findings),
    )


def _estimates(estimates: tuple[Estimate, ...]) -> str:
    rows = []
    for e in sorted(estimates, key=lambda e: not e.free):
        value, interval = value_and_interval(e)
        rows.append((e.name, unit_text(e.unit), e.note if e.free else "held", value, interval))
    return table(("parameter", "unit", "", "value", "95 %"), rows, words=3)


def _relative(estimates: tuple[Estimate, ...]) -> str:
    """How well each number is known, as a drawing."""
    rows = []
    for e in estimates:
        share = 100 * 1.96 * e.std / abs(e.value) if e.free and e.value else math.nan
        rows.append((e.name, share, f"± {share:.2g} %"))
    return bars(rows, "half of the 95 % interval, share of the value [%]")


def fit_card(fit: "Fit") -> str:
    """How a fit ended, its residuals, and every parameter with unit and interval."""
    rows = []
    for channel, place in fit.model.mechanism.outputs:
        own = fit.model.mechanism.units.motion + ("/s" if place[1] == "speed" else "")
        value, unit = readable(fit.noise[channel], own)
        rows.append((channel, unit, plain_number(value)))
    return card(
        f"Fit: {fit.status} after {fit.steps} steps, cost {plain_number(fit.cost, 4)} nat",
        table(("channel", "unit", "rms residual"), rows, words=2),
        _estimates(fit.parameters),
        picture(_relative(fit.parameters), "Width of the interval of each free parameter."),
    )


def mechanism_card(m: "Mechanism") -> str:
    """Ports and effects with their laws, and every parameter with unit and value."""
    ports = ", ".join(
        f"{name} ({', '.join(f'{v:g}' for v in vector)})" for name, vector in m.port_vectors.items()
    )
    laws = [(effect_label(e.name, e.at), equation(e.equation)) for e in m.effects]
    numbers = zip(m.parameter_names, m.parameter_specifications, m.values, strict=True)
    rows = [
        (name, unit_text(spec.unit), spec.meaning, "held" if name in m.trusted else "", f"{value:.6g}")
        for name, spec, value in numbers
    ]
    return card(
        f"Mechanism of {', '.join(m.coordinates)}; outputs {', '.join(m.channels)}",
        paragraph(f"Ports, as shares of the coordinates: {ports}"),
        table(("effect", "law"), laws, words=2),
        table(("parameter", "unit", "meaning", "", "value"), rows, words=4),
    )


def discovery_card(d: "Discovery") -> str:
    """Verdict, staircase, what each round found, errors, and where the baseline failed."""
    by_channel = units(d)
    scale = {c: readable(1.0, unit) for c, unit in by_channel.items()}
    heading = {c: f"{c} [{read}]" for c, (_, read) in scale.items()}
    errors = {heading[c]: [f * s.held_out_rmse_windows[c] for s in d.stages] for c, (f, _) in scale.items()}
    floor = {heading[c]: f * d.noise_floor.get(c, 0.0) for c, (f, _) in scale.items()}
    rounds = []
    for k, turn in enumerate(d.rounds, 1):
        alike = (
            ""
            if not turn.equivalent
            else "not told from " + ", ".join(effect_label(*pair) for pair in turn.equivalent)
        )
        rounds.append((str(k), effect_label(turn.effect, turn.port), equation(turn.equation), alike))
    numbers = [
        (name, unit_text(e.unit), *value_and_interval(e))
        for turn in d.rounds
        for name, e in ((f"{turn.port}.{turn.effect}.{n}", e) for n, e in turn.parameters.items())
    ]
    seconds = f"{d.baseline.window_seconds:g} s"
    headings = channel_headings(d)
    rows = [(r.label, *(c.value for c in (*r.windows, *r.whole))) for r in error_rows(d)]
    rows.append(("sensor noise", *noise_row(d), *noise_row(d)))
    found = {(r.effect, r.port) for r in d.rounds}
    alike_pairs = {pair for r in d.rounds for pair in r.equivalent}
    ranked = [
        (effect_label(r.effect, r.port), standing(r, found, alike_pairs), plain_number(r.score))
        for r in d.ranking[:_LISTED]
    ]
    return card(
        HEADLINES[d.verdict],
        paragraph(sentence(d.sentence)),
        picture(
            staircase(stage_labels(d), errors, floor),
            f"Held-out error over {seconds} of each model, with the noise of the sensor.",
        ),
        table(("", "effect", "law", ""), rounds, words=4),
        table(("parameter", "unit", "value", "95 %"), numbers, words=2),
        table(
            (
                "held-out rms error",
                *(f"{h}, {seconds}" for h in headings),
                *(f"{h}, one run" for h in headings),
            ),
            rows,
        ),
        folded("Where the baseline failed", listed(sentence(w.statement) for w in d.where)),
        folded("Ranking before any was added", table(("candidate", "", "score [nat]"), ranked, words=2)),
        listed(d.notes),
    )


def comparison_card(c: "Comparison") -> str:
    """Every method on the same held-out data, best first."""
    head, *rows = c.cells()
    best = f", best: {c.best.method}" if c.best else ""
    return card(
        f"Comparison of {len(c.rows)} methods in free run on held-out data{best}",
        table(head, rows),
        folded("What there is to say about each", listed(c.remarks())),
    )


def latent_card(t: "LatentTorque") -> str:
    """Size and evidence of the torque at each port, and its mean over the speed of the port."""
    rows = [(p, plain_number(t.size(p)), plain_number(t.gain_nats[p])) for p in t.ports]
    drawn = []
    for port in t.ports:
        curve = t.curve(port)
        if len(curve.at) > 1:
            lines = [(np.asarray(curve.mean, float), AFTER, "")]
            lines += [(np.asarray(edge, float), INK, "3 3") for edge in (curve.low, curve.high)]
            label = f"{curve.against} [{curve.unit}]"
            svg = signals(
                np.asarray(curve.at, float), [Panel(f"{port} [{t.effort}]", lines)], label, height=90
            )
            drawn.append(picture(svg, f"Mean torque at the {port} over its speed, with its band."))
    return card(
        "Latent torque: what the model would have to be given to follow the measurement",
        table(("port", f"rms [{t.effort}]", "gain [nat]"), rows),
        *drawn,
    )
