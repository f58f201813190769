"""Measured against simulated outputs of one or several models, as one figure."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from rotflex_jax.checks import names
from rotflex_jax.effects.labels import effect_label
from rotflex_jax.errors import InputError
from rotflex_jax.mechanism import Mechanism
from rotflex_jax.models.model import Model
from rotflex_jax.recording import Recording

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def compare_plot(
    recording: Recording,
    *models: Any,
    labels: Sequence[str] | None = None,
    seconds: float | None = None,
) -> "Figure":
    """Figure of measured and simulated outputs, with errors and the fit in per cent; a notebook displays it.

        fit = 100 (1 - norm(e) / norm(y - mean(y))),    e = y - y_hat

    Args:
        recording: Measured data; its input drives the models.
        models: Fits, results of searches, models, mechanisms, or any object with `simulate(recording)`.
        labels: Names of the models; by default the effects that each has in addition to the first.
        seconds: Length of the windows after which free runs start again [s]; a single free run if None.

    Returns:
        The figure; its `savefig` writes a file.

    Raises:
        InputError: No recording or no model was given, or an object cannot simulate.
    """
    if not isinstance(recording, Recording):
        raise InputError(
            f"A recording is compared with models, but {type(recording).__name__} was given in its "
            "place; give the recording first, then the models."
        )
    if not models:
        raise InputError("No model was given to compare with the recording; give one or several after it.")
    named = None if labels is None else names(labels, "labels")
    if named is not None and len(named) != len(models):
        raise InputError(
            f"Argument `labels` has {len(named)} names for {len(models)} models; give one for each."
        )
    simulators = [simulator(m) for m in models]
    shown = default_labels(simulators) if named is None else named
    channels = shared_channels(simulators, recording)
    runs = [
        (name, _outputs(m, recording, channels, seconds)) for name, m in zip(shown, simulators, strict=True)
    ]
    from rotflex_jax.models.run_figure import run_figure  # matplotlib is loaded only where it draws

    kind = "free run" if seconds is None else f"free runs of {seconds:g} s"
    source = f"{recording.source}: " if recording.source else ""
    return run_figure(recording, channels, runs, f"{source}measured and simulated, {kind}")


def simulator(thing: Any) -> Any:
    """The object that simulates: the model of a fit or a search, a mechanism as a model, others unchanged.

    Raises:
        InputError: The object cannot simulate.
    """
    found = getattr(thing, "model", thing)
    found = Model(found) if isinstance(found, Mechanism) else found
    if not callable(getattr(found, "simulate", None)):
        raise InputError(
            f"{type(thing).__name__} has no method simulate(recording), but a model is needed; give a fit, a "
            "model or a mechanism."
        )
    return found


def default_labels(simulators: Sequence[Any]) -> tuple[str, ...]:
    """Names of models: the effects that each has in addition to the first, else a number.

    >>> from rotflex_jax.effects import Coulomb
    >>> from rotflex_jax.joints import paper
    >>> default_labels([Model(paper())]), default_labels([Model(paper()), Model(paper() + Coulomb(at="hub"))])
    (('simulated',), ('model 1', '+ Coulomb friction at hub'))
    """
    if len(simulators) == 1:
        return ("simulated",)
    each = [_places(m) for m in simulators]
    names = ["model 1"]
    for k, places in enumerate(each[1:], 2):
        added = [place for place in places if place not in each[0]]
        grown = added and set(each[0]) <= set(places)
        names.append(f"+ {', '.join(effect_label(*p) for p in added)}" if grown else f"model {k}")
    return tuple(names)


def _places(model: Any) -> list[tuple[str, str]]:
    return [(e.name, e.at) for e in model.mechanism.effects] if isinstance(model, Model) else []


def shared_channels(simulators: Sequence[Any], recording: Recording) -> tuple[str, ...]:
    """Channels that all models have, in the order of the first model.

    Raises:
        InputError: The models have no channel in common.
    """
    each = [_channels(m, recording) for m in simulators]
    shared = tuple(c for c in each[0] if all(c in other for other in each))
    if not shared:
        listed = "; ".join(", ".join(names) for names in each)
        raise InputError(f"The models have no output in common ({listed}); compare models of one output.")
    return shared


def _channels(model: Any, recording: Recording) -> tuple[str, ...]:
    if isinstance(model, Model):
        return model.mechanism.channels
    return tuple(getattr(model, "channels", recording.channels))


def _outputs(
    model: Any, recording: Recording, channels: Sequence[str], seconds: float | None
) -> Float[np.ndarray, "N C"]:
    if isinstance(model, Model):
        model.measured(recording)  # raises an error that names a missing channel
    if seconds is None:
        y = model.simulate(recording)
    elif hasattr(model, "simulate_windows"):
        y = model.simulate_windows(recording, seconds)
    else:
        raise InputError(
            f"Argument `seconds` needs models that start again, but {type(model).__name__} has only one free "
            "run; leave `seconds` out."
        )
    own = _channels(model, recording)
    return np.asarray(y, float)[:, [own.index(c) for c in channels]]
