"""Results of B3 as markdown."""

from __future__ import annotations

from typing import Any

TITLES = {
    "silverbox": "Silverbox",
    "emps": "EMPS",
    "rigid arm": "Rotary arm, rigid: learnt from the run with gain 6",
    "flexible arm": "Rotary arm, flexible: learnt from the first 70 % of a run",
}


def page(found: dict[str, Any]) -> str:
    parts = ["# Discovery on public machines\n", "Written by `python benchmarks/B3_public.py`.\n"]
    for name in (n for n in TITLES if n in found):
        parts += [f"\n## {TITLES[name]}\n", *_case(found[name])]
    return "\n".join(parts) + "\n"


def _case(case: dict[str, Any]) -> list[str]:
    took = f"{case['discovery_seconds']:.0f} s for the discovery, {case['seconds']:.0f} s in all"
    lines = [f"`{case['verdict']}`: {case['sentence']} ({took})\n", *_errors(case)]
    for r in case["rounds"]:
        same = f" Or: {', '.join(f'{e} at {p}' for e, p in r['equivalent'])}." if r["equivalent"] else ""
        lines.append(f"- {r['effect']} at {r['port']}: {r['sentence']}.{same}")
    lines += [f"- {note}" for note in case["notes"]]
    for entry in case.get("free-run rounds", []):
        lines.append(f"- {_free_round(entry)}")
    kinds = ("estimates", "search estimates", "free-run estimates")
    last = {k: row[k] for k in kinds for row in case["rows"] if k in row}
    return [*lines, "", *_parameters(case, last)]


def _free_round(entry: dict[str, Any]) -> str:
    """Text on a round of the search by free runs, with the held-out errors of the best candidates."""
    pair = lambda e: " and ".join(f"{1e3 * v:.3g}" for v in e)  # noqa: E731
    nearest = sorted(entry["tried"], key=lambda k: entry["tried"][k][0] * entry["tried"][k][1])[:4]
    listed = ", ".join(f"{k} {pair(entry['tried'][k])}" for k in nearest)
    return (
        f"by free runs, round {entry['round']}: {entry['taken'] or 'nothing'} taken; held-out parts before "
        f"it {pair(entry['held_out'])}, with the best candidates {listed} (thousandths of the output's unit)."
    )


def _errors(case: dict[str, Any]) -> list[str]:
    """Table of root mean square errors of free runs, one row per stage, with published errors below."""
    tests = list(case["rows"][0]["free run"])
    both = "search" in case["rows"][0]
    heads = [f"{t} [{case['unit']}]" for t in tests]
    heads += [f"{t}, parameters of the search" for t in tests] if both else []
    heads += [f"windows of 2 s, {c}" for c in case["rows"][0].get("windows", {})]
    lines = ["| model | " + " | ".join(heads) + " |", "|---|" + "---|" * len(heads)]
    for k, row in enumerate(case["rows"]):
        label = row["model"] if k == 0 or row["model"].startswith("the ") else "+ " + row["model"]
        cells = [f"{row['free run'][t]:.3g}" for t in tests]
        cells += [f"{row['search'][t]:.3g}" if "search" in row else "" for t in tests] if both else []
        cells += [f"{e:.3g}" for e in row.get("windows", {}).values()]
        lines.append(f"| {label} | " + " | ".join(cells) + " |")
    if "bound" in case:
        cells = [f"{case['bound']['errors'][t]:.3g}" for t in tests]
        lines.append("| the last, fitted to the test itself (a bound) | " + " | ".join(cells) + " | |")
    for method, errors in case["published"].items():
        cells = [f"{errors[t]:.3g}" if t in errors else "" for t in tests]
        lines.append(f"| published: {method} | " + " | ".join(cells) + " |" * (1 + both))
    return [*lines, ""]


def _parameters(case: dict[str, Any], row: dict[str, Any]) -> list[str]:
    columns = {"search": "search estimates", "free run": "free-run estimates"}
    columns = {k: v for k, v in columns.items() if v in row} or {"": "estimates"}
    heads = [f"{k} 95 %".strip() for k in columns] + (["published"] if case["constants"] else [])
    names = list(dict.fromkeys(n for v in columns.values() for n in row[v]))
    lines = ["| parameter | " + " | ".join(heads) + " |", "|---|" + "---|" * len(heads)]
    for name in names:
        cells = [_interval(row[v].get(name)) for v in columns.values()]
        if case["constants"]:
            cells.append(f"{case['constants'][name][0]:.4g}" if name in case["constants"] else "")
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    return [*lines, ""]


def _interval(estimate: dict[str, Any] | None) -> str:
    if estimate is None:
        return ""
    ci = estimate["ci95"]
    inside = f" ({ci[0]:.4g} to {ci[1]:.4g})" if ci else ""
    return f"{estimate['value']:.4g}{inside} {estimate['unit']}".rstrip()
