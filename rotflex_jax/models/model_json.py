"""A model as a JSON file: readable by people and other programs, and read back bit for bit."""

import dataclasses
import json
import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, get_args

import numpy as np
from jaxtyping import Float

from rotflex_jax import effects
from rotflex_jax.checks import shown
from rotflex_jax.effects import CATALOG
from rotflex_jax.effects.base import Effect, full_name
from rotflex_jax.errors import InputError
from rotflex_jax.mechanism import Exponential, Mechanism, SmoothRK4
from rotflex_jax.mechanism.intersample import Intersample
from rotflex_jax.mechanism.quantity import Units
from rotflex_jax.models.model import Model
from rotflex_jax.parameters import Estimate, HeldConstant, specifications
from rotflex_jax.text.files import is_search_result, path_of, write_file
from rotflex_jax.text.numbers import json_number

SCHEMA = 1
KIND = "rotflex_jax model"
WRITTEN = "`model.save` or `--save-model` has written"
LARGEST_FILE = 50_000_000
"""Largest size of a file that is read as a model file [bytes]."""

LARGEST_COUNT = 1000
"""Largest whole number in the settings of a file, such as a number of substeps."""

_SOLVERS = {cls.__name__: cls for cls in (Exponential, SmoothRK4)}


@dataclasses.dataclass(frozen=True, eq=False)
class Saved:
    """The contents of a model file.

    Attributes:
        model: The model.
        estimates: Fitted and trusted parameters with their intervals, if the model comes from a fit.
        covariance: Covariance of the parameters `covariance_names` [declared units], or None.
        covariance_names: Full names, in the order of `covariance`.
        Ts: Sampling period of the data to which the model was fitted [s], or None.
        n_init: Samples at the start of these data that the model may use, or None.
    """

    model: Model
    estimates: tuple[Estimate, ...] = ()
    covariance: Float[np.ndarray, "P P"] | None = None
    covariance_names: tuple[str, ...] = ()
    Ts: float | None = None
    n_init: int | None = None


def save(saved: Saved, path: str | os.PathLike[str]) -> Path:
    """Writes a model file.

    Args:
        saved: Contents of the file.
        path: Path of the file, which is replaced if it exists.

    Returns:
        The path.

    Raises:
        InputError: An effect is not in the catalogue, so the file could not be read back, or the file cannot
            be written. An existing file then stays as it is.
    """
    if not isinstance(saved, Saved):
        raise InputError(
            f"A fitted model is needed to write it, but {shown(saved)} was given; call `save` of the model."
        )
    return write_file(path, json.dumps(to_dict(saved), indent=2, allow_nan=False) + "\n")


def read(path: str | os.PathLike[str]) -> Saved:
    """Reads a model file.

    Raises:
        InputError: It is no model file, it is from a later version, or it has an effect that is not known.
    """
    path = path_of(path)
    try:
        if os.path.getsize(path) > LARGEST_FILE:
            raise InputError(f"{path} is too large for a model file; give a file that {WRITTEN}.")
        data = json.loads(Path(path).read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise InputError(f"{path} does not exist; give the path of a model file.") from None
    except OSError as error:
        raise InputError(
            f"{path} cannot be read ({error.strerror}); give the path of a model file."
        ) from None
    except InputError:
        raise
    except (ValueError, RecursionError, MemoryError):  # no JSON, no UTF-8, or a whole number of 5,000 digits
        raise InputError(f"{path} is not JSON; give a file that {WRITTEN}.") from None
    if not isinstance(data, dict) or data.get("kind") != KIND:
        searched = is_search_result(data)
        what = "is the result of a search, not a model file" if searched else "is no model file"
        raise InputError(f"{path} {what}; give a file that {WRITTEN}.")
    try:
        return from_dict(data)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    except Exception as error:  # the values of a changed file reach the constructor of any effect
        reason = f"{type(error).__name__}: {' '.join(str(error).split())[:200]}"
        raise InputError(
            f"{path} is incomplete or was changed by hand ({reason}); save the model again."
        ) from None


def to_dict(saved: Saved) -> dict[str, Any]:
    """The contents of a model file in plain JSON types."""
    mechanism, model = saved.model.mechanism, saved.model
    covariance = saved.covariance
    return {
        "kind": KIND,
        "schema": SCHEMA,
        "mechanism": {
            "coordinates": list(mechanism.coordinates),
            "ports": {name: list(vector) for name, vector in mechanism.ports},
            "outputs": {name: {"port": port, "what": what} for name, (port, what) in mechanism.outputs},
            "effects": [_effect(e, mechanism) for e in mechanism.effects],
            "signals": list(mechanism.signals),
            "units": list(mechanism.units[:4]),
            "input_unit": mechanism.units.input,
        },
        "solver": {"rule": type(model.solver).__name__, **dataclasses.asdict(model.solver)},
        "gates": None if model.gates is None else list(model.gates),
        "data": {"Ts": saved.Ts, "n_init": saved.n_init},
        "estimates": {
            e.name: {k: _json(v) for k, v in e.to_dict().items()} | {"free": e.free, "note": e.note}
            for e in saved.estimates
        },
        "covariance": None
        if covariance is None
        else {
            "names": list(saved.covariance_names),
            "matrix": [[_json(c) for c in row] for row in covariance],
        },
    }


def _effect(effect: Effect, mechanism: Mechanism) -> dict[str, Any]:
    cls = type(effect)
    if _known(effect.name) is not cls:
        raise InputError(
            f"{cls.__name__} at {effect.at} is not in the catalogue, so a file with it could not be "
            "read back; put @register above the class."
        )
    declared = specifications(effect)
    parameters = {
        name: {
            "value": _json(float(value)),
            "unit": mechanism.unit_of(effect, declared[name].unit),
            "bounds": [_json(declared[name].lower), _json(declared[name].upper)],
            "trusted": effect.full_name(name) in mechanism.trusted,
            "meaning": declared[name].meaning,
        }
        for name, value in effect.values.items()
    }
    return {
        "effect": effect.name,
        "at": effect.at,
        "kind": cls.kind_label,
        "equation": effect.equation,
        "parameters": parameters,
        "settings": _settings(effect),
    }


def _settings(effect: Effect) -> dict[str, Any]:
    """Fields of an effect that are no parameters, such as its number of splines."""
    known = {"at", *type(effect).declared()}
    return {f.name: _json(getattr(effect, f.name)) for f in dataclasses.fields(effect) if f.name not in known}


def _json(value: Any) -> Any:
    if isinstance(value, (np.ndarray, tuple, list)):
        return [_json(v) for v in value]
    if isinstance(value, (float, np.floating)):
        return json_number(float(value))
    return value


def _back(value: Any) -> Any:
    return tuple(_back(v) for v in value) if isinstance(value, list) else value


_NUMBER, _WHOLE, _TEXT, _FLAG = "a number", "a whole number", "text", "true or false"
_PARAMETER = {"value": _NUMBER, "unit": _TEXT, "trusted": _FLAG}
_ESTIMATE = {
    "value": (_NUMBER,),
    "std": (_NUMBER,),
    "ci95": ([(_NUMBER,), (_NUMBER,)],),
    "unit": _TEXT,
    "free": _FLAG,
    "note": _TEXT,
}
_FORM: dict[str, Any] = {
    "mechanism": {
        "coordinates": [_TEXT],
        "ports": {"*": [_NUMBER]},
        "outputs": {"*": {"port": _TEXT, "what": _TEXT}},
        "effects": [{"effect": _TEXT, "at": _TEXT, "parameters": {"*": _PARAMETER}, "settings": {}}],
        "units": [_TEXT, _TEXT, _NUMBER, _NUMBER],
    },
    "solver": {"rule": _TEXT},
    "gates": ([_NUMBER],),
    "data": {"Ts": (_NUMBER,), "n_init": (_WHOLE,)},
    "estimates": {"*": _ESTIMATE},
    "covariance": ({"names": [_TEXT], "matrix": [[(_NUMBER,)]]},),
}
"""Form of a model file: a list of one form has any length, `*` is any key, parentheses allow null."""


def _check(value: Any, form: Any, where: str) -> None:
    """Raise `TypeError` where a value does not have its form, and `KeyError` where a value is missing."""
    if isinstance(form, tuple):
        return None if value is None else _check(value, form[0], where)
    if isinstance(form, str):
        number = isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < math.inf
        fits = {
            _NUMBER: number,
            _WHOLE: number and isinstance(value, int),
            _TEXT: isinstance(value, str),
            _FLAG: isinstance(value, bool),
        }
        if not fits[form]:
            raise TypeError(f"{where} must be {form}")
        return None
    if not isinstance(value, type(form)):
        raise TypeError(f"{where} must be {'a list' if isinstance(form, list) else 'an object'}")
    if isinstance(form, list):
        if len(form) > 1 and len(value) != len(form):
            raise TypeError(f"{where} must have {len(form)} entries")
        for k, entry in enumerate(value):
            _check(entry, form[k % len(form)], f"{where}[{k}]")
        return None
    for key, part in form.items():
        for name in value if key == "*" else [key]:
            _check(value[name], part, f"{where}.{name}".lstrip("."))
    return None


def _check_settings(value: Any, where: str, depth: int = 0) -> None:
    """Raise `ValueError` if a setting has no sensible size."""
    if isinstance(value, dict | list) and depth < 5:
        for entry in value.values() if isinstance(value, dict) else value:
            _check_settings(entry, where, depth + 1)
    elif isinstance(value, dict | list):
        raise ValueError(f"the settings of {where} are nested too deeply")
    elif isinstance(value, int) and abs(value) > LARGEST_COUNT:
        raise ValueError(f"the settings of {where} have {value:.3e}, beyond {LARGEST_COUNT}")
    elif isinstance(value, float) and not math.isfinite(value):
        raise ValueError(f"the settings of {where} have {value}")


def from_dict(data: Mapping[str, Any]) -> Saved:
    """The inverse of `to_dict`.

    Raises:
        InputError: The file is from a later version, or has an effect or a solver that is not known.
        KeyError: A value is missing.
        TypeError: A value does not have the right type.
        ValueError: A value has no sensible size.
    """
    if not isinstance(data["schema"], int) or data["schema"] > SCHEMA:
        raise InputError(
            f"The file has schema {data['schema']!s:.20}, but this version reads up to {SCHEMA}; "
            "install a later rotflex_jax."
        )
    _check(data, _FORM, "")
    for part in (*data["mechanism"]["effects"], data["solver"]):
        _check_settings(part.get("settings", part), part.get("effect", "the solver"))
    given = data["mechanism"]
    units = Units(*given["units"], input=given.get("input_unit", "V"))
    built = [_effect_back(e) for e in given["effects"]]
    trusted = [
        full_name(e["at"], e["effect"], name)
        for e in given["effects"]
        for name, p in e["parameters"].items()
        if p["trusted"]
    ]
    mechanism = Mechanism(
        coordinates=tuple(given["coordinates"]),
        ports=given["ports"],
        effects=tuple(built),
        outputs={name: (o["port"], o["what"]) for name, o in given["outputs"].items()},
        trusted=trusted,
        units=units,
        signals=tuple(given.get("signals", ())),
    )
    for effect, saved in zip(mechanism.effects, given["effects"], strict=True):
        _check_units(mechanism, effect, saved["parameters"])
    rule = dict(data["solver"])
    name = rule.pop("rule")
    if name not in _SOLVERS:
        raise InputError(
            f"The file has the solver {name!r}, but {', '.join(_SOLVERS)} are known; write one of these."
        )
    for key, value in rule.items():
        words = get_args(Intersample) if isinstance(value, str) else (None,)
        positive = isinstance(value, int | float) and not isinstance(value, bool) and value > 0
        if not positive and value not in words:
            raise ValueError(f"the solver has {key} = {value!r:.50}")
    if not (data["data"]["Ts"] or 1) > 0 or not (data["data"]["n_init"] or 1) > 0:
        raise ValueError("the sampling period and the samples at the start must be positive")
    gates = data["gates"]
    model = Model(mechanism, _SOLVERS[name](**rule), None if gates is None else tuple(gates))
    covariance = data["covariance"]
    return Saved(
        model=model,
        estimates=tuple(_estimate(name, e) for name, e in data["estimates"].items()),
        covariance=None if covariance is None else np.array(covariance["matrix"], dtype=float),
        covariance_names=() if covariance is None else tuple(covariance["names"]),
        Ts=data["data"]["Ts"],
        n_init=data["data"]["n_init"],
    )


def _effect_back(given: Mapping[str, Any]) -> Effect:
    name, parameters = given["effect"], given["parameters"]
    cls = _known(name)
    if cls is None:
        raise InputError(
            f"The file has the effect {name!r}, which is not in the catalogue; import the module that "
            f"registers it first, or install a later rotflex_jax."
        )
    settings = {key: _back(value) for key, value in given["settings"].items()}
    effect = cls(at=given["at"], **settings)
    known = cls.declared() | specifications(effect)
    return effect.replace(**{key: p["value"] for key, p in parameters.items() if key in known})


def _check_units(mechanism: Mechanism, effect: Effect, parameters: Mapping[str, Any]) -> None:
    """Refuses parameters that the effect does not have, or has in another unit."""
    declared = effect.declared() | specifications(effect)
    units = {name: mechanism.unit_of(effect, s.unit) for name, s in declared.items()}
    for key, p in parameters.items():
        if units.get(key) != p["unit"]:
            has = ", ".join(f"{name} [{unit}]" for name, unit in units.items())
            raise InputError(
                f"The file gives {effect.name!r} the parameter {key} [{p['unit']}], but the effect has {has}"
                "; use the version of the effect that the file was written with."
            )


def _known(name: str) -> type[Effect] | None:
    """An effect class by name: of the catalogue, or of the package if it is not in the catalogue."""
    offered = (e for e in vars(effects).values() if isinstance(e, type) and issubclass(e, Effect))
    return CATALOG.get(name) or next((e for e in offered if getattr(e, "name", "") == name), None)


def _estimate(name: str, given: Mapping[str, Any]) -> Estimate:
    nan = float("nan")
    std = nan if given["std"] is None else given["std"]
    low, high = (nan, nan) if given["ci95"] is None else given["ci95"]
    held = tuple(HeldConstant(**c) for c in given.get("given", ()))
    return Estimate(name, given["value"], std, (low, high), given["unit"], given["free"], given["note"], held)
