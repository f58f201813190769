"""Results of B9 as markdown."""

from __future__ import annotations

from typing import Any

from rotflex_jax.arena.measured import MACHINES

Row = dict[str, Any]
KINDS = ("whole", "windows", "whole_calibrated", "windows_calibrated")
KEYS = dict(
    zip(
        KINDS,
        ("test_rmse", "test_rmse_windows", "test_rmse_calibrated", "test_rmse_windows_calibrated"),
        strict=True,
    )
)
HEAD = """# B9: measured machines

Written by `python benchmarks/B9_measured.py`. Fitted to some recordings, decided on the ends of these,
evaluated on others, which were used for no fit and no choice. Root mean square errors of free runs over the
whole test and over windows of 2 s, of all channels; calibrated: with the voltage offset that is fitted to the
first 2 s of each test recording. Provisional rounds are in brackets, look-alikes after an equals sign.
"fitted to all, A for B": that fit has law A in the place of the law B that was found; "without C": it does
without an effect or offset that was found; "D separate for each run": each run has a value of its own of this
parameter.

"""
BANDS = """Bands of 90 % around free runs over each test recording, of models made from training and
validation data alone: how many samples they hold, their mean half width, and what gives most of their
variance."""


def evaluated(row: Row, stage: str) -> tuple[dict[str, Any], str]:
    """Errors of a stage on the test by kind, and their source.

    The errors that the search reports, if it reports any on test recordings; otherwise those that the
    benchmark computed with the public interface.
    """
    own = row["reported"][stage]
    if own.get(KEYS["whole"]):
        return {kind: _channels(own.get(key)) for kind, key in KEYS.items()}, "the search"
    return {kind: row["simulated"][stage][kind] for kind in KINDS}, "the benchmark"


def held_out(row: Row, stage: str) -> dict[str, Any]:
    """Errors that the search reports on the validation data, on which it chose the model."""
    own = row["reported"][stage]
    return {
        "whole": _channels(own.get("held_out_rmse")),
        "windows": _channels(own.get("held_out_rmse_windows")),
    }


def _channels(errors: dict[str, Any] | None) -> dict[str, Any] | None:
    """Errors by channel, without the length of the windows."""
    return None if errors is None else {k: v for k, v in errors.items() if k != "seconds"}


def told(errors: dict[str, Any] | None, factor: float) -> str:
    """Text with the errors of all channels, in the unit of the machine."""
    if not errors:
        return "-"
    return " / ".join("-" if v is None else _short(factor * v) for v in errors.values())


def _short(value: float) -> str:
    return f"{value:.3g}" if abs(value) < 1000 else f"{value:.0f}"


def said(row: Row) -> str:
    """Text with the effects that were found; provisional ones are in brackets."""
    parts = []
    for r in row["rounds"]:
        text = f"{r['effect']}@{r['port']}"
        text += " = " + ", ".join("@".join(p) for p in r["equivalent"]) if r["equivalent"] else ""
        parts.append(text if r["status"] == "established" else f"({text})")
    return ", ".join(parts) or "nothing"


def differences_from_found(row: Row) -> str:
    """Text with the differences between the structure of the final fit and the structure that was found."""
    pairs = (("@".join(x["used"]), "@".join(x["found"])) for x in row.get("laws", []))
    without = (f"{x['effect']}@{x['port']}" for x in row.get("left_out", []))
    parts = [f"{used} for {found}" for used, found in pairs] + [f"without {x}" for x in without]
    parts += [f"{name} separate for each run" for name in row.get("friction_of_runs", [])]
    return "".join(f", {part}" for part in parts)


def best(row: Row) -> tuple[str, dict[str, Any] | None, dict[str, Any] | None]:
    """Name of the best other method, and its errors of whole runs and of windows on the test."""
    rows = [r for r in (row["others"] or {"rows": []})["rows"] if r["status"] == "ok"]
    if not rows:
        return "-", None, None
    return rows[0]["method"], _channels(rows[0]["held_out_rmse"]), _channels(rows[0]["held_out_rmse_windows"])


def times(row: Row) -> list[str]:
    """Wall-clock and processor seconds of the search, with nothing compiled and with everything compiled."""
    cells = []
    for state in ("cold", "warm"):
        found = row.get(state)
        cells.append(f"{found['clock_s']:.0f} / {found['processor_s']:.0f}" if found else "-")
    return cells


def page(results: dict[str, Any]) -> str:
    """The page: errors, verdicts and times, bands, then failures and machines that were left out."""
    rows = [results["rows"][k] for k in sorted(results["rows"], key=_place)]
    good = [r for r in rows if "error" not in r]
    lines = [
        "| machine | direction | unit | stage | whole | windows | whole, calibrated | windows, calibrated | "
        "validation, windows | evaluated by |",
        "|---|---|---|---|---:|---:|---:|---:|---:|---|",
    ]
    for row in good:
        machine = MACHINES[row["machine"]]
        last = ("fitted to all",) if row["reported"].get("fitted to all") else ()
        for stage in ("baseline", "final", *last):
            errors, source = evaluated(row, stage)
            head = [row["machine"], row["direction"], machine.unit] if stage == "baseline" else ["", "", ""]
            cells = [told(errors[kind], machine.factor) for kind in KINDS]
            cells.append(told(held_out(row, stage)["windows"], machine.factor) if stage not in last else "")
            label = stage + differences_from_found(row) if stage in last else stage
            lines.append("| " + " | ".join([*head, label, *cells, source]) + " |")
        name, whole, windows = best(row)
        commit = (row["others"] or {}).get("commit")  # of an earlier row
        source = f"`compare` ({commit})" if commit else "`compare`"
        cells = [told(whole, machine.factor), told(windows, machine.factor), "", "", "", source]
        lines.append("| " + " | ".join(["", "", "", f"best other: {name}", *cells]) + " |")
    lines += [
        "",
        "| machine | direction | verdict | named (status) | cold: clock / processor [s] | warm [s] | "
        "the same again | commit |",
        "|---|---|---|---|---:|---:|---|---|",
    ]
    for row in good:
        again = {None: "-", True: "yes", False: "no"}[row.get("same_again")]
        commit = row["commit"] + ("" if row["clean"] else ", changed")
        cells = [row["machine"], row["direction"], row["verdict"], said(row), *times(row), again, commit]
        lines.append("| " + " | ".join(cells) + " |")
    lines += ["", *bands_of_tests(good), ""]
    lines += [f"- {r['machine']}, {r['direction']}: failed, {r['error']}" for r in rows if "error" in r]
    lines += [f"- {name}: left out, {reason}" for name, reason in results.get("left_out", {}).items()]
    return HEAD + "\n".join(lines).rstrip() + "\n"


def bands_of_tests(rows: list[Row]) -> list[str]:
    """Table of the bands over test recordings, for the directions that have bands."""
    lines = [
        "| machine | direction | unit | samples inside [%] | mean half width | widened by |",
        "|---|---|---|---:|---:|---|",
    ]
    for row in rows:
        machine, found = MACHINES[row["machine"]], row.get("bands") or []
        for k, band in enumerate(found, 1):
            direction = row["direction"] + (f", test {k}" if len(found) > 1 else "")
            cells = ["-", "-", band.get("error")]
            if "error" not in band:
                inside = " / ".join(f"{100 * share:.0f}" for share in band["coverage"].values())
                by = " / ".join(map(most_of, band["shares"].values()))
                cells = [inside, told(band["mean_half_width"], machine.factor), by]
            lines.append("| " + " | ".join([row["machine"], direction, machine.unit, *cells]) + " |")
    return [BANDS, "", *lines] if len(lines) > 2 else []


def most_of(shares: dict[str, float]) -> str:
    """Text with the parts that make at least a fifth of a variance, largest first."""
    large = sorted((pair for pair in shares.items() if pair[1] >= 0.2), key=lambda pair: -pair[1])
    return ", ".join(f"{name} {100 * share:.0f} %" for name, share in large)


def _place(key: str) -> tuple[int, str]:
    """Sort key of a row: the place of its machine in the registry."""
    names = list(MACHINES)
    machine = key.split(":")[0]
    return (names.index(machine) if machine in names else len(names), key)
