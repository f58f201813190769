"""Results of B10 as markdown."""

from __future__ import annotations

import statistics
from typing import Any

from rotflex_jax.parameters import HALF_WIDTH_95


def mean(row: dict[str, Any], part: str, kind: str) -> float:
    """Error averaged over the training or the test recordings [deg]."""
    return statistics.mean(e[kind] for e in row[part].values())


def summary(splits: dict[str, Any]) -> dict[str, dict[str, float]]:
    """Mean errors of each model on recordings that were left out [deg], median free runs and times [s].

    A mean over all motions, all gains or both is given only if the model has results for each of them.
    """
    out: dict[str, dict[str, float]] = {}
    for name in dict.fromkeys(name for case in splits.values() for name in case):
        rows = {left_out: case[name] for left_out, case in splits.items() if name in case}
        ways = {"": "", "motion ": "motion", "gain ": "gain"}
        for label, way in ways.items():
            wanted = [left_out for left_out in splits if left_out.startswith(way)]
            if wanted and all(left_out in rows for left_out in wanted):
                listed = [rows[left_out] for left_out in wanted]
                for kind in ("mean", "rms"):
                    value = statistics.mean(mean(r, "test", kind) for r in listed)
                    out.setdefault(name, {})[label + kind] = value
        if name in out:
            for key in ("rollouts", "seconds"):
                out[name][key] = statistics.median(r[key] for r in rows.values())
    return out


def _label(name: str) -> str:
    """Name of a model on the page."""
    return "what the search finds" if name == "search" else name


def page(found: dict[str, Any]) -> str:
    """The page."""
    splits = found["splits"]
    names = list(dict.fromkeys(name for case in splits.values() for name in case))
    lines = [
        "# B10: a hobby servo under its firmware",
        "",
        "Written by `python benchmarks/B10_servo.py`. Errors are those of free runs of the angle over whole "
        "recordings [deg], the goal and the first samples known; recordings of the motion or of the gain in "
        "the head of a column were left out of the fit. M1 to M6 are the models of arXiv 2410.08650, fitted "
        "by CMA-ES to the mean absolute error of the training recordings; the grey box is fitted by least "
        "squares.",
        "",
    ]
    for kind, title in (("mean", "Mean absolute error"), ("rms", "Root mean square error")):
        lines += [f"## {title} of what was left out", ""]
        lines += ["| model | " + " | ".join(splits) + " | all |", "|---|" + "---:|" * (len(splits) + 1)]
        for name in names:
            values = [mean(case[name], "test", kind) if name in case else None for case in splits.values()]
            known = [v for v in values if v is not None]
            cells = ["" if v is None else f"{v:.2f}" for v in values]
            cells.append(f"{statistics.mean(known):.2f}" if len(known) == len(values) else "")
            lines.append(f"| {_label(name)} | " + " | ".join(cells) + " |")
        lines.append("")
    lines += ["## What it takes", "", "| model | free runs of a recording | fit [s] | search [s] |"]
    lines += ["|---|---:|---:|---:|"]
    for name in names:
        rows = [case[name] for case in splits.values() if name in case]
        middle = lambda key, rows=rows: statistics.median(r.get(key, 0.0) for r in rows)  # noqa: E731
        search = f"{middle('search seconds'):.0f}" if "search seconds" in rows[0] else ""
        lines.append(f"| {_label(name)} | {middle('rollouts'):.0f} | {middle('seconds'):.1f} | {search} |")
    lines += [
        "",
        "Medians over what was left out, on a machine with other work. A free run of the grey box carries "
        "the derivatives along.",
        "",
    ]
    searched = {split: case["search"] for split, case in splits.items() if "search" in case}
    if searched:
        lines += ["## What the search found", ""]
    for split, row in searched.items():
        effects = ", ".join(row["effects"]) or "nothing"
        lines.append(f"- {split} left out: {effects} (`{row['verdict']}`)")
    if "direction" in found:
        d = found["direction"]
        fits = ", ".join(f"{n} = {v:.3g} ± {HALF_WIDTH_95 * s:.2g}" for n, (v, s) in d["fit"].items())
        lines += ["", "## Friction that depends on the direction of the load", ""]
        lines += [
            f"Fitted with a level for lifting and one for lowering: {fits}. As a candidate beside friction "
            f"in proportion to the weight: excited {str(d['excited']).lower()}, {d['unconfounded']:.1g} of "
            f"its derivative unconfounded, verdict `{d['verdict']}`. One mass does not distinguish a "
            "directional friction from another torque constant.",
        ]
    if "released" in found:
        lines += ["", "## The torque off", ""]
        lines += [
            "Errors of free runs of 4 s in which the arm swings without torque, by gain before [deg]:",
            "",
        ]
        for name, row in found["released"].items():
            fits = ", ".join(
                f"{n} = {v:.3g} ± {HALF_WIDTH_95 * s:.2g}" for n, (v, s) in row["parameters"].items()
            )
            lines.append(f"- {name}: {', '.join(f'{e:.2f}' for e in row['rms'])}; {fits}")
    if "supply" in found:
        motion, logged = (f"{v:.3g} ± {1.96 * s:.2g} ohm" for v, s in found["supply"].values())
        lines += ["", "## A supply that gives way", ""]
        lines += [
            f"By the motion its resistance is {motion}, by the voltage of the supply in the logs {logged}: "
            "what takes torque away at large duty and current is not the supply."
        ]
    if rows := found.get("so101", []):
        names = [n for n in rows[0] if all(n in r["takes"] for r in rows)]
        lines += ["", "## SO-101", "", "| model | " + " | ".join(r["joint"] for r in rows) + " |"]
        lines += ["|---|" + "---:|" * len(rows)]
        for name in ("range", "goal", *names):
            said = {"range": "range of the angle", "goal": "the goal itself"}.get(name, name)
            lines.append(f"| {said} | " + " | ".join(f"{r[name]:.2f}" for r in rows) + " |")
        lines += [
            "",
            "Root mean square errors [deg] of free runs over `step_response`, which no fit used. "
            "`Coulomb, slow` leaves out the last third of the chirp; that was decided when these errors were "
            "known, and the others were not fitted so: it is no held-out result. `parameters of M1` was "
            "chosen by errors over the training motions alone.",
            "",
        ]
        if all("others" in r for r in rows):
            lines += ["Over the other motions, used for no fit and no choice:", ""]
            lines += [
                "| model | " + " | ".join(f"{r['joint']}: {m}" for r in rows for m in r["others"]) + " |"
            ]
            lines += ["|---|" + "---:|" * sum(len(r["others"]) for r in rows)]
            for name in names:
                each = (e[name] for r in rows for e in r["others"].values())
                lines.append(f"| {name} | " + " | ".join(f"{v:.2f}" for v in each) + " |")
            lines.append("")
        for row in (r for r in rows if "search" in r):
            said = row["search"]
            effects = ", ".join(said["effects"]) or "nothing"
            errors = ", ".join(
                f"{motion} {said['before'][motion]:.2f} -> {error:.2f}"
                for motion, error in said["others"].items()
            )
            lines += [
                f"Search at {row['joint']} of the servo without friction: {effects} (`{said['verdict']}`). "
                f"Errors over the other motions before and after [deg]: {errors}. It took "
                f"{said['processor seconds']:.0f} s of processor time.",
                "",
            ]
        lines += ["| model | free runs of a recording | fit [s] |", "|---|---:|---:|"]
        for name in names:
            took = [r["takes"][name] for r in rows]
            runs, seconds = (statistics.median(t[k] for t in took) for k in ("rollouts", "seconds"))
            lines.append(f"| {name} | {runs:.0f} | {seconds:.1f} |")
    m = found["machine"]
    lines += [
        "",
        f"{m['processor']}, {m['cores']} cores, Python {m['python']}, jax {m['jax']}, {m['date']}, "
        f"{m['commit']}.",
    ]
    return "\n".join(lines) + "\n"
