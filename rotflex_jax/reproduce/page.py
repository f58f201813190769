"""Output of `rotflex reproduce`: sentences with the results, an HTML page, figures, and JSON."""

import io
import math
from pathlib import Path
from typing import Any

import numpy as np

from rotflex_jax.reproduce.experiment import Reproduction
from rotflex_jax.reproduce.figures import FIGURES
from rotflex_jax.reproduce.records import PulseRun
from rotflex_jax.text.markup import as_json, fill_template, write_files
from rotflex_jax.text.numbers import digits, percent_left, readable
from rotflex_jax.text.plotting import Picture, by_section


def number(value: float, count: int = 3) -> str:
    """A number as text; a dash if it is not finite.

    >>> number(0.015234), number(7052.3, 4), number(float("nan"))
    ('0.0152', '7052', '–')
    """
    return digits(value, count, missing="–")


def headline(result: Reproduction) -> str:
    """Title of the page: the result for Figure 9."""
    a = result.adaptation
    if a.status != "ok":
        return f"LMS {a.status}"
    if a.settle is None:
        late = a.prediction.settle > a.times[-1]
        return "The run is too short for Figure 9" if late else "Figure 9 settles on nothing but noise"
    found, predicted = number(a.settle, 4), number(a.prediction.settle, 4)
    return f"Figure 9 settles after {found} iterations; {predicted} were predicted"


def summary(result: Reproduction) -> str:
    """Summary: the paper's model, the identified linear model, and the gain by a kernel of degree 2."""
    lms, linear, physical = (result.row(name).held_out for name in names(result))
    quadratic = result.row(f"M={result.settings.memory} quadratic").held_out
    paper = (
        f"the paper's model leaves {percent_left(lms)} of the variance unexplained"
        if math.isfinite(lms)
        else "the paper's model is worth nothing, since its filter ran away"
    )
    first = (
        f"On data it has not seen, {paper}; a linear model identified from the same data leaves "
        f"{percent_left(linear)}, the linearised joint {percent_left(physical)}."
    )
    gain = 1 - quadratic / linear
    worth = "nothing here" if gain < 0.005 else f"{gain:.0%} of the linear model's error"
    rest = "; what else is gained over the linearised joint comes from identification"
    return f"{first} The quadratic kernel is worth {worth}{rest if physical > linear else ''}."


def names(result: Reproduction) -> tuple[str, str, str]:
    """Names of the paper's model, of the identified linear model, and of the linearised joint."""
    M = f"M={result.settings.memory}"
    return f"{M} quadratic, LMS", f"{M} linear", "linearised joint"


def online(result: Reproduction) -> list[str]:
    """Sentences on the a-priori error, which is no error of a model."""
    a = result.adaptation
    if a.status != "ok":
        return [f"The filter {a.status}: its step sizes are too large for this input."]
    frozen, stability = result.row(names(result)[0]).held_out, a.prediction.stability
    texts = [
        f"While it learns, the filter's a-priori errors are {percent_left(a.online)} of the variance (last "
        f"half of the run); the weights it ends with leave {percent_left(frozen)} on data they have not "
        "seen. Only the second is an error of a model: online, the weights follow the record.",
        f"The step sizes are {_sizes(result)}. By theory they are {stability.sentence}, and cost "
        f"{percent_left(stability.misadjustment)} of the smallest error in the end.",
    ]
    if result.short_memory is not None:
        t = result.short_memory
        texts.append(
            f"How far the two can part: at a sampling interval of {1e3 * t.Ts:g} ms, where "
            f"{result.settings.memory} samples span next to nothing of the joint, the a-priori error falls "
            f"to {percent_left(t.online)}, while the frozen weights leave {percent_left(t.frozen)} and least "
            f"squares {percent_left(t.least_squares)}."
        )
    return texts


def _sizes(result: Reproduction) -> str:
    sizes = result.adaptation.prediction.step_sizes
    return f"{number(sizes[1])} for constant and linear kernel and {number(sizes[2])} for the quadratic one"


def lessons(result: Reproduction) -> list[str]:
    """Sentences on the results in the table."""
    M, found = f"M={result.settings.memory}", []
    linear, quadratic, cubic = (
        result.row(f"{M} {word}").held_out for word in ("linear", "quadratic", "cubic")
    )
    found.append(
        f"Degree 2 {_worth(linear, quadratic)} the error of the identified linear model; with degree 3 it "
        f"is {number(cubic)}. Friction and a dead zone that are the same both ways make a machine odd: "
        "voltage turned round, motion turned round. Even degrees cannot follow that at all, odd ones only "
        "in part, since friction holds and remembers."
    )
    if result.records.measured and max(quadratic, cubic) > linear:
        found.append(
            "Where more degrees do worse on held-out data, the recording does not determine them: thinned "
            f"out, it is {result.records.phases} records of the same {_seconds(result)} s."
        )
    grey = [row for row in result.rows if row.name == "grey box"]
    if grey:
        found.append(
            f"The joint's own equations with friction, {grey[0].size} parameters fitted to a part of the "
            f"data, leave {number(grey[0].held_out)}: what a series cannot follow is not noise."
        )
    found += [_one_sign(pulse.height) for pulse in _best_linearised(result)][:1]
    return found


def _best_linearised(result: Reproduction) -> list[PulseRun]:
    """Pulses on which no model is better than the linearised joint."""
    errors = zip(*(row.pulses for row in result.rows), strict=True)
    return [p for p, each in zip(result.records.pulses, errors, strict=True) if each[0] == min(each)]


def _one_sign(height: float) -> str:
    return (
        f"On the pulse of {height:+g} V the linearised joint comes closest: an offset that makes up for "
        "friction one way adds to it the other way. One pulse of one sign proves nothing."
    ).replace("-", "−")


def _worth(before: float, after: float) -> str:
    gain = 1 - after / before
    if abs(gain) < 0.005:
        return "changes nothing in"
    return f"takes {gain:.0%} off" if gain > 0 else f"gives {after / before:.2g} times"


def _seconds(result: Reproduction) -> str:
    whole = result.records.train[:: result.records.phases]
    return number(sum(r.duration for r in whole))


def plateau(result: Reproduction) -> str:
    """Sentence on the steady output of the model within a pulse, computed from its kernels."""
    series = result.row(names(result)[0]).series
    if series is None or not result.records.pulses:
        return ""
    kernels, height = series.kernels(), result.settings.pulse
    heights = [h * np.sum(kernels[1]) + h * h * np.sum(kernels[2]) for h in (height, -height)]
    scale, unit = readable(1.0, result.records.unit)
    up, down = (number(scale * float(value), 2).replace("-", "−") for value in heights)
    return (
        f"Within a pulse of height A, once {result.settings.memory} samples have passed, the model rests "
        f"at h0 + A Σh1 + A² Σh2. Without h0 that is {up} {unit} for +{height:g} V and {down} {unit} for "
        f"−{height:g} V: the part of A² has the same sign both ways, friction has not."
    )


# Resolution of the figures [dots per inch].
DPI = 150


def write(result: Reproduction, folder: Path) -> Path:
    """Writes `reproduce.html`, a PNG for every figure and `result.json`; returns the path of the page.

    Args:
        result: Result of `reproduce`.
        folder: Folder for the files, created if needed; files with these names are replaced.

    Raises:
        InputError: The folder is a file, or cannot be written to.
    """
    drawn = FIGURES.pictures(result)
    page = fill_template("rotflex_jax.reproduce", "reproduce.html.j2", content(result, drawn))
    images = {f"{name}.png": _png(picture) for name, picture in drawn.items()}
    write_files(folder, {**images, "result.json": as_json(result.to_dict()), "reproduce.html": page})
    return folder / "reproduce.html"


def _png(picture: Picture) -> bytes:
    file = io.BytesIO()
    picture.figure.savefig(file, dpi=DPI, format="png")
    return file.getvalue()


def content(result: Reproduction, drawn: dict[str, Picture]) -> dict[str, Any]:
    """Content of the template, as plain text that the template escapes."""
    s, records = result.settings, result.records
    sources = dict.fromkeys(r.source for r in (*records.train, *records.test) if r.source)
    return {
        "headline": headline(result),
        "summary": summary(result),
        "tiles": _tiles(result),
        "online": online(result),
        "lessons": lessons(result),
        "plateau": plateau(result),
        "headings": headings(result),
        "rows": _rows(result),
        "pulsed": bool(records.pulses),
        "measured": records.measured,
        "kernels": "" if result.kernels is None else str(result.kernels),
        "settings": [_setting(row) for row in result.setting_rows()],
        "pictures": by_section(drawn.values()),
        "source": ", ".join(sources) if records.measured else f"simulated, {s.scenario}",
        "elapsed": number(result.elapsed_s, 2),
    }


def headings(result: Reproduction) -> list[str]:
    """Headings of the columns with errors."""
    return ["held out", *(f"pulse {p.height:+g} V".replace("-", "−") for p in result.records.pulses)]


def table(result: Reproduction) -> list[list[str]]:
    """Name and errors of every model, for a terminal."""
    return [
        [row.name, str(row.size), *(number(e) for e in (row.held_out, *row.pulses))] for row in result.rows
    ]


def _tiles(result: Reproduction) -> list[dict[str, str]]:
    a, (lms, linear, physical) = result.adaptation, names(result)
    errors = {name: result.row(name).held_out for name in (lms, linear, physical)}
    return [
        {
            "name": "iterations until the coefficient rests",
            "was": number(a.prediction.settle, 4),
            "value": "–" if a.settle is None else number(a.settle, 4),
            "note": "predicted → measured",
        },
        {
            "name": "held-out error (NMSE)",
            "was": f"{number(errors[physical])} → {number(errors[linear])}",
            "value": number(errors[lms]),
            "note": "linearised → identified linear → the paper's",
        },
        {
            "name": "online error of the same run",
            "was": "",
            "value": number(a.online),
            "note": "follows the data: not an error of a model",
        },
    ]


def _rows(result: Reproduction) -> list[dict[str, Any]]:
    columns = list(zip(*[(row.held_out, *row.pulses) for row in result.rows], strict=True))
    least = [min((e for e in column if math.isfinite(e)), default=math.nan) for column in columns]
    paper = names(result)[0]
    return [
        {
            "name": row.name,
            "about": row.about,
            "size": row.size,
            "paper": row.name == paper,
            "errors": [
                {"value": number(e), "best": e == best}
                for e, best in zip((row.held_out, *row.pulses), least, strict=True)
            ],
        }
        for row in result.rows
    ]


def _setting(row: dict[str, Any]) -> dict[str, Any]:
    show = lambda value: f"{_plain(value)} {row['unit']}".strip()  # noqa: E731
    return row | {"value": show(row["value"]), "default": show(row["default"])}


def _plain(value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, tuple):
        pairs = (f"{v[0]}={v[1]:g}" if isinstance(v, tuple) else str(v) for v in value)
        return ", ".join(pairs) or "none"
    return f"{value:.6g}" if isinstance(value, float) else str(value)
