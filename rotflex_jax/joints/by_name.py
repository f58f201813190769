"""From texts of the command line to a joint, a model of the user, or an effect with its parameters."""

import importlib
import importlib.util
import inspect
import sys
from collections.abc import Iterable
from pathlib import Path
from types import ModuleType
from typing import Any

from rotflex_jax.checks import choose
from rotflex_jax.errors import InputError

JOINTS = (
    "paper",
    "quanser_2002",
    "quanser_2010",
    "flexible_link",
    "single_inertia",
    "position_servo",
    "servo",
    "sts3215",
    "xl330_pendulum",
)


def joint(text: str) -> Any:
    """The mechanism of `paper`, of `quanser_2010:spring=3,hub_anchor=A`, or of other texts for `model`."""
    return model(text).mechanism


def model(text: str, add: Iterable[str] = ()) -> Any:
    """The model of a joint, `FILE.py:NAME`, `FILE.xml:joint=NAME` or `MODEL.json`, with effects added."""
    found = _model(text)
    for each in add:
        found = found + effect(each)
    return found


def _model(text: str) -> Any:
    from rotflex_jax import joints
    from rotflex_jax.models.model import Model

    name, separator, values = text.partition(":")
    if name.endswith(".xml"):
        named_joints = _options(values, ("joint", "child"), f"option of {name}")
        return Model(joints.load_mjcf(name, **{key: str(value) for key, value in named_joints.items()}))
    if text.endswith(".json") or (separator and "=" not in values and name not in JOINTS):
        return named(text)
    preset = getattr(joints, choose(name, JOINTS, "joint"))
    # A motor or a servo is not a number: another one has to be given in Python.
    names = [key for key in inspect.signature(preset).parameters if key not in ("motor", "servo")]
    return Model(preset(**_options(values, names, f"option of {name}")))


def named(text: str) -> Any:
    """The model of `plant.py:turntable`, `package.module:turntable` or `model.json`.

    The file may register effects of its own, which are then in the catalogue.

    Args:
        text: A Python file or module with the name of a `Mechanism`, of a `Model` or of a function that
            returns one; or a file that `model.save` has written.

    Raises:
        InputError: The file, module or name does not exist, or the name is no mechanism and no model.
    """
    from rotflex_jax.mechanism import Mechanism
    from rotflex_jax.models.model import Model

    place, separator, name = text.rpartition(":")
    if not separator or text.endswith(".json"):
        return Model.load(text)
    found = getattr(imported(place), name, None)
    if callable(found) and not isinstance(found, type):
        found = found()
    if isinstance(found, Model):
        return found
    if isinstance(found, Mechanism):
        return Model(found)
    known = [n for n, v in vars(imported(place)).items() if isinstance(v, (Mechanism, Model))]
    raise InputError(
        f"{place} has no mechanism called {name!r}; "
        + (f"it has {', '.join(known)}." if known else f"write {name} = rotflex_jax.Mechanism(...) in it.")
    )


def imported(place: str) -> ModuleType:
    """The Python file or module, imported once."""
    try:
        if not place.endswith(".py"):
            here = str(Path.cwd())
            sys.path.insert(0, here)
            try:
                return importlib.import_module(place)
            finally:
                sys.path.remove(here)
        file = Path(place).resolve()
        if not file.is_file():
            raise InputError(f"{place} does not exist; give the path of a Python file.")
        known = sys.modules.get(file.stem)
        if known is not None and getattr(known, "__file__", None) == str(file):
            return known
        spec = importlib.util.spec_from_file_location(file.stem, file)
        assert spec is not None and spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        if known is None:
            sys.modules[file.stem] = module  # dataclasses look their module up
        spec.loader.exec_module(module)
        return module
    except InputError:
        raise
    except ModuleNotFoundError as error:
        raise InputError(
            f"{place} cannot be imported ({error}); give FILE.py:NAME or a module on the path."
        ) from None
    except Exception as error:
        raise InputError(
            f"{place} cannot be run: {type(error).__name__}: {error}; correct the file."
        ) from None


def effect(text: str) -> Any:
    """The effect of `coulomb@hub`, or of `coulomb@hub:level=0.03`.

    A signal comes after its port and before the values: `measured_disturbance@arm: wind [N]:gain=0.1`.
    """
    from rotflex_jax.effects import CATALOG
    from rotflex_jax.effects.base import driven_place

    place, _, values = text.partition(":")
    name, separator, port = place.partition("@")
    kind = CATALOG[choose(name, CATALOG, "effect")]
    ports = list(kind.ports)
    if kind.acts_on == "signal" and values:
        signal, colon, tail = values.rpartition(":")
        valued = bool(colon) and tail.partition("=")[0].strip() in kind.declared()
        signal, values = (signal, tail) if valued else (values, "")
        port = driven_place(port.strip(), signal.strip())
    if not separator and len(ports) > 1:
        raise InputError(
            f"The effect {name} was given no port, but can act at {', '.join(ports)}; give for "
            f"instance {name}@{ports[0]}."
        )
    parameters = _options(values, kind.declared(), f"parameter of {name}")
    return kind(at=port or ports[0], **parameters)


def _options(text: str, names: Iterable[str], what: str) -> dict[str, Any]:
    """`a=1,b=C` as a dict; a value that is no number stays text."""
    found: dict[str, Any] = {}
    for pair in filter(None, text.split(",")):
        key, separator, value = (part.strip() for part in pair.partition("="))
        if not separator or not value:
            raise InputError(f"{pair!r} has no value, but needs one; write {key}=VALUE.")
        choose(key, names, what)
        try:
            found[key] = int(value) if value.lstrip("+-").isdigit() else float(value)
        except ValueError:
            found[key] = value
    return found
