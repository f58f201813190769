"""The catalogue of effects as pages: everything in it is what the effects declare of themselves."""

import dataclasses
import inspect
import io
import math
import re

from generate.docstrings import plain
from generate.effect_figures import figure
from rotflex_jax.effects import CATALOG, LearnedTorque
from rotflex_jax.effects.base import KINDS, Effect
from rotflex_jax.export.equations import equation
from rotflex_jax.parameters import Specification

# What the figure shows, by kind, where that is not plain from its axes.
CAPTIONS = {
    "with memory": "A wide swing, then narrow ones about another place: where the motion turns, the torque "
    "begins a new branch.",
    "dry friction": "The bar at standstill: friction takes whatever value holds the port.",
}
OWN_CAPTIONS = {
    "heating": "The warmer the motor, the less torque is left.",
    "second_mode": "Below its frequency the part is carried along, near it it pulls hard, above it it stays "
    "where it is.",
    "learned_torque": "The splines along the speed; a weight for each makes the map.",
    "motor": "Less torque the faster it turns: the back-EMF takes voltage away.",
    "current_meter": "After a jump of the current.",
    "duty_meter": "After a jump of the duty.",
    "coulomb_asymmetric": "With half the level backwards.",
    "load_friction": "Turning forwards, a positive load is the motor's own; backwards it is the machine's.",
}


def shown() -> list[type[Effect]]:
    """All effects of the catalogue, kind by kind, and the learned torque."""
    order = [kind.kind_label for kind in KINDS]
    classes = [cls for cls in CATALOG.values() if cls.__module__.startswith("rotflex_jax.")]
    return sorted([*classes, LearnedTorque], key=lambda cls: (order.index(cls.kind_label), cls.name))


def pages() -> dict[str, str]:
    """File name -> text: for each effect a page and a figure."""
    written = {}
    for cls in shown():
        written[f"{cls.name}.rst"] = _page(cls)
        picture = io.StringIO()
        figure(cls).savefig(picture, format="svg", metadata={"Date": None, "Creator": None})
        written[f"{cls.name}.svg"] = picture.getvalue()
    return written


def overview(on_site: bool = False) -> str:
    """The list of all effects, `docs/catalogue.md`; its links lead to the code, on the site to the pages."""
    lines = [
        "# Catalogue of effects",
        "",
        "Every effect that a model can have, from the list that the search reads. `rotflex effects` prints",
        "it on a terminal with all parameters" + ("." if on_site else "; the documentation site"),
        *([] if on_site else ["([how to build it](../CONTRIBUTING.md)) has a page with a drawing for each."]),
        "[An effect of your own](add_effect.md) takes part in everything from the moment it is registered.",
        "",
        "An equation gives the torque *on* its port in the port's positive direction; only the level of dry",
        "friction is a positive number that opposes motion. The places are those of the flexible joint; on",
        "[another machine](own_machine.md) they are read by what acts there.",
        "",
    ]
    for kind in KINDS:
        lines += [f"## {kind.kind_label.capitalize()}", "", kind.kind_meaning, ""]
        lines += ["| effect | what it is | equation | searched at |", "|---|---|---|---|"]
        for cls in (c for c in shown() if c.kind_label == kind.kind_label):
            where = ", ".join(f"`{place}`" for place in cls.searched) or "no"
            file = f"../{cls.__module__.replace('.', '/')}.py"
            link = f"effects/{cls.name}.rst" if on_site else file
            written = cls.equation.replace("|", r"\|")
            lines.append(f"| [`{cls.name}`]({link}) | {cls.title} | `{written}` | {where} |")
        lines.append("")
    if on_site:
        lines += ["```{toctree}", ":hidden:", "", *(f"effects/{cls.name}" for cls in shown()), "```", ""]
    return "\n".join(lines)


def _page(cls: type[Effect]) -> str:
    title = f"{cls.title[:1].upper()}{cls.title[1:]}: ``{cls.name}``"
    first, prose, source = _told(cls)
    lines = [
        title,
        "=" * len(title),
        "",
        f".. py:class:: rotflex_jax.effects.{cls.__name__}({_signature(cls)})",
    ]
    lines += [f"   :canonical: {cls.__module__}.{cls.__qualname__}", "", first, ""]
    for line in equation(cls).split(r", \quad "):
        lines += [".. math::", "", f"   {line}", ""]
    caption = OWN_CAPTIONS.get(cls.name) or CAPTIONS.get(cls.kind_label, "")
    about = plain(f"Figure of the equation of {cls.title}")
    lines += [f".. figure:: {cls.name}.svg", f"   :alt: {about}", "   :width: 34em", "", f"   {caption}", ""]
    for paragraph in prose:
        lines += [paragraph, ""]
    lines += _parameters(cls)
    lines += [f":Kind: {cls.kind_label}", f":Searched at: {_places(cls)}"]
    if cls.amplitudes:
        absent = " and ".join(f"``{name}``" for name in cls.amplitudes)
        lines.append(f":Absent where: {absent} {'are' if len(cls.amplitudes) > 1 else 'is'} zero")
    if cls.vanishes_with:
        lines.append(":Vanishes with: " + " and ".join(f"``{name}``" for name in cls.vanishes_with))
    if cls.contains:
        lines.append(":Contains: " + ", ".join(f":doc:`{name}`" for name in cls.contains))
    if cls is not LearnedTorque:
        lines.append(f":In words: “{plain(_example(cls).sentence())}”")
    lines += [f":Source: {source}", ""]
    return "\n".join(lines)


def _example(cls: type[Effect]) -> Effect:
    place = (*cls.searched, *cls.ports, "hub")[0]
    return cls(at=place)


def _places(cls: type[Effect]) -> str:
    if cls.searched:
        return ", ".join(f"``{place}``" for place in cls.searched)
    return "nowhere unless you ask: ``discover(..., candidates=...)``, or ``model + effect``"


def _told(cls: type[Effect]) -> tuple[str, list[str], str]:
    """First line, the paragraphs in words, and the source, from the docstring."""
    paragraphs = re.split(r"\n\s*\n", (inspect.getdoc(cls) or "").strip())
    source = next((p for p in paragraphs if p.startswith("Source:")), "Source: none given")
    prose = [p for p in paragraphs[1:] if not re.match(r" {2,}|\t|(Args|Attributes|Source|Raises):|>>>", p)]
    flat = [plain(" ".join(p.split())).replace("`", "``") for p in [paragraphs[0], *prose, source]]
    # "M. Nordin" would begin a list.
    return flat[0], flat[1:-1], re.sub(r"^(\w)\.", r"\1\.", flat[-1].removeprefix("Source:").strip())


def _signature(cls: type[Effect]) -> str:
    fields = {f.name: f.default for f in dataclasses.fields(cls)}
    return ", ".join(
        name if value is dataclasses.MISSING else f"{name}={value!r}" for name, value in fields.items()
    )


def _parameters(cls: type[Effect]) -> list[str]:
    if not cls.declared():
        return []
    lines = [".. list-table::", "   :header-rows: 1", ""]
    head = ("parameter", "meaning", "unit", "default", "usual size", "bounds")
    rows = [head]
    for field in dataclasses.fields(cls):
        if field.name in cls.declared():
            spec = cls.declared()[field.name]
            default = "none" if field.default is None else f"{field.default:g}"
            unit = plain(spec.unit) or "1"
            rows.append(
                (f"``{field.name}``", spec.meaning, unit, default, f"{spec.typical:g}", _bounds(spec))
            )
    for row in rows:
        lines += [f"   {'*' if k == 0 else ' '} - {cell}" for k, cell in enumerate(row)]
    return [*lines, ""]


def _bounds(spec: Specification) -> str:
    low, high = spec.lower, spec.upper
    if math.isinf(low) and math.isinf(high):
        text = "none"
    elif math.isinf(high):
        text = f"from {low:g}"
    else:
        text = f"{low:g} to {high:g}" if math.isfinite(low) else f"to {high:g}"
    low, high = spec.physical
    if math.isfinite(low) or math.isfinite(high):
        healthy = f"from {low:g}" if math.isinf(high) else f"{low:g} to {high:g}"
        text += f"; healthy: {healthy}"
    return text
