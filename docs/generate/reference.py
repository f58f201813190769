"""Pages of the reference: one for each package, its public names in the order of `__all__`."""

import importlib
import inspect
import sys
from types import ModuleType

from generate.docstrings import plain

# Package -> heading. A package without `__all__` shows what it defines itself.
PACKAGES = {
    "rotflex_jax": "What most programs need",
    "rotflex_jax.recording": "Recordings",
    "rotflex_jax.data": "Files and public data",
    "rotflex_jax.data.excitation": "Inputs to record with",
    "rotflex_jax.data.datasets": "Benchmarks with their protocol",
    "rotflex_jax.joints": "Ready-made machines",
    "rotflex_jax.mechanism": "Mechanisms and their motion",
    "rotflex_jax.parameters": "Parameters and estimates",
    "rotflex_jax.effects.base": "Kinds of effect",
    "rotflex_jax.metrics": "Errors",
    "rotflex_jax.discover": "Discovery",
    "rotflex_jax.latent": "Latent torque",
    "rotflex_jax.experiment": "The next experiment",
    "rotflex_jax.control": "Controllers",
    "rotflex_jax.compare": "Every method on the same recording",
    "rotflex_jax.arena": "The arena",
    "rotflex_jax.batch": "Many recordings",
    "rotflex_jax.notebook": "In a notebook",
    "rotflex_jax.basis": "Bases",
    "rotflex_jax.fit": "Fits",
    "rotflex_jax.adaptive": "Adaptive filters",
    "rotflex_jax.kernels": "Volterra kernels",
    "rotflex_jax.export": "Export",
    "rotflex_jax.report": "Reports",
}

# Types that public names take or return without offering them themselves.
ALSO = {
    "rotflex_jax.data": ["rotflex_jax.data.registry.PublicDataset", "rotflex_jax.data.registry.PublicFile"],
    "rotflex_jax.mechanism": [
        "rotflex_jax.mechanism.quantity.Quantity",
        "rotflex_jax.mechanism.quantity.Units",
        "rotflex_jax.mechanism.assembly.Constants",
        "rotflex_jax.mechanism.assembly.EquationsOfMotion",
        "rotflex_jax.mechanism.smooth_rk4.SmoothConstants",
    ],
    "rotflex_jax.effects.base": [
        "rotflex_jax.effects.base.Stamp",
        "rotflex_jax.effects.motor.PositionLoop",
    ],
    "rotflex_jax.discover": [
        "rotflex_jax.discover.result.SearchResult",
        "rotflex_jax.discover.verdict.Verdict",
        "rotflex_jax.discover.probabilities.Probabilities",
        "rotflex_jax.discover.probabilities.SetProbability",
        "rotflex_jax.discover.probabilities.FittedSet",
        "rotflex_jax.discover.explanation.Explanation",
        "rotflex_jax.discover.explanation.LatentTorqueComparison",
        "rotflex_jax.discover.spline_map.Formula",
        "rotflex_jax.discover.spline_map.Term",
    ],
    "rotflex_jax.compare": ["rotflex_jax.compare.method.Simulator", "rotflex_jax.compare.method.Horizon"],
    "rotflex_jax.notebook": ["rotflex_jax.notebook.explorer.Explorer"],
    "rotflex_jax.basis": ["rotflex_jax.basis.pole_search.PoleStart"],
    "rotflex_jax.adaptive": [
        "rotflex_jax.adaptive.objectives.TuningPath",
        "rotflex_jax.adaptive.filter.Weights",
        "rotflex_jax.adaptive.rls.SquareRootState",
        "rotflex_jax.adaptive.lms.WindowState",
        "rotflex_jax.adaptive.rls.KalmanState",
        "rotflex_jax.adaptive.lattice.LatticeState",
        "rotflex_jax.adaptive.lattice.LatticeStage",
    ],
}


def public_names(package: ModuleType) -> list[str]:
    """Names that a package offers, in its own order; modules have pages of their own."""
    listed = getattr(package, "__all__", None)
    if listed is None:
        inside = package.__name__
        listed = [
            name
            for name, thing in vars(package).items()
            if not name.startswith("_")
            and (inspect.isclass(thing) or inspect.isfunction(thing))
            and (thing.__module__ == inside or thing.__module__.startswith(inside + "."))
        ]
    return [name for name in listed if not inspect.ismodule(getattr(package, name))]


def pages() -> dict[str, str]:
    """File name -> text. A name that several packages offer is described where it comes first."""
    described: dict[int, str] = {}
    written = {}
    for package, heading in PACKAGES.items():
        importlib.import_module(package)
        module = sys.modules[package]  # not an attribute: `rotflex_jax.fit` is the function
        title = f"{heading}: ``{package}``"
        lines = [title, "=" * len(title), ""]
        lines += [plain((inspect.getdoc(module) or "").partition("\n\n")[0]), ""]
        things = {f"{package}.{name}": getattr(module, name) for name in public_names(module)}
        things |= {name: _found(name) for name in ALSO.get(package, [])}
        own = {name: thing for name, thing in things.items() if id(thing) not in described}
        described |= {id(thing): name for name, thing in own.items()}
        lines += [".. list-table::", "   :widths: 30 70", ""]
        for thing in things.values():
            name = described[id(thing)]
            lines += [f"   * - :py:obj:`{name.rpartition('.')[2]} <{name}>`", f"     - {_first_line(thing)}"]
        lines.append("")
        for name, thing in own.items():
            lines += _directive(name, thing)
        written[f"{package.replace('.', '_')}.rst"] = "\n".join(lines)
    written["index.md"] = _index(written)
    return written


def _found(name: str) -> object:
    module, _, attribute = name.rpartition(".")
    return getattr(importlib.import_module(module), attribute)


def _first_line(thing: object) -> str:
    if not callable(thing):
        return f"{len(thing)} entries" if isinstance(thing, dict) else type(thing).__name__
    return plain((inspect.getdoc(thing) or "").partition("\n")[0])


def _directive(name: str, thing: object) -> list[str]:
    if inspect.isclass(thing):
        extra = "" if issubclass(thing, Exception) else "\n   :members:"
        return [f".. autoclass:: {name}{extra}", ""]
    if inspect.isroutine(thing):
        return [f".. autofunction:: {name}", ""]
    entries = ", ".join(f"``{key}``" for key in thing) if isinstance(thing, dict | tuple) else str(thing)
    return [f".. py:data:: {name}", "", f"   {plain(entries)}.", ""]


def _index(written: dict[str, str]) -> str:
    entries = [f"{heading} <{package.replace('.', '_')}>" for package, heading in PACKAGES.items()]
    return "\n".join(
        [
            "# Reference",
            "",
            "Every public name, from its docstring. In a program, `import rotflex_jax as rf` gives the first",
            "page and the packages `rf.data`, `rf.effects`, `rf.joints`, `rf.metrics`, `rf.basis`,",
            "`rf.adaptive`, `rf.kernels` and `rf.export`. The effects themselves are in the",
            "[catalogue](../catalogue.md).",
            "",
            "```{toctree}",
            ":maxdepth: 1",
            "",
            *entries,
            "```",
            "",
        ]
    )
