"""Recordings in objects of other packages.

Such an object is recognised by its attributes `u` and `y`. Its attributes `sampling_time`,
`state_initialization_window_length` and `name` are used if present. The other packages are not imported.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from rotflex_jax.errors import InputError
from rotflex_jax.recording import Recording
from rotflex_jax.recording.samples import real_numbers

FOREIGN_NAMES = {
    "Ts": ("sampling_time", "Ts", "dt"),
    "n_init": ("state_initialization_window_length", "n_init"),
}
"""Attribute of a recording -> names of this attribute in other packages."""


def is_foreign(source: Any) -> bool:
    """Whether an object holds an input and outputs.

    >>> from types import SimpleNamespace
    >>> is_foreign(SimpleNamespace(u=[1.0], y=[2.0])), is_foreign("run.csv")
    (True, False)
    """
    # A table with columns u and y has these attributes too.
    table = isinstance(source, Mapping | Recording) or hasattr(source, "columns")
    return not table and hasattr(source, "u") and hasattr(source, "y")


def from_foreign(
    source: Any,
    channels: str | Sequence[str] | None = None,
    units: Mapping[str, str] | None = None,
    Ts: float | None = None,
    accept: str | Sequence[str] = (),
) -> Recording:
    """A recording from an object with `u` and `y`.

    Such objects have no names of channels and no units, so give them. By default a single output is called
    `output`, several outputs `output_1`, `output_2` and so on, without a unit.

    Args:
        source: the object.
        channels: names of the outputs, in order.
        units: channel -> unit.
        Ts: sampling period [s]; that of the object if None.
        accept: faults to accept, as in `Recording`.

    Returns:
        The recording; its `n_init` is that of the object, if the object has one.

    Raises:
        InputError: there is no sampling period, `units` names no channel, or as in `Recording`.

    >>> from types import SimpleNamespace
    >>> k = np.arange(100)
    >>> run = SimpleNamespace(u=np.sin(k), y=np.cos(k), sampling_time=0.01, name="train",
    ...     state_initialization_window_length=20)
    >>> from_foreign(run, channels="position", units={"position": "m"}).n_init
    20
    """
    label = str(getattr(source, "name", "") or type(source).__name__)
    known = {key: _first(source, names) for key, names in FOREIGN_NAMES.items()}
    period = known["Ts"] if Ts is None else Ts
    if period is None:
        raise InputError(f"{label} has no sampling_time, but a recording needs one; give Ts= in seconds.")
    y = real_numbers(source.y, f"{label}: `y`")
    width = 1 if y.ndim < 2 else y.shape[1]
    numbered = ["output"] if width == 1 else [f"output_{k + 1}" for k in range(width)]
    given = numbered if channels is None else [channels] if isinstance(channels, str) else list(channels)
    if strange := [name for name in units or {} if name not in given]:
        raise InputError(
            f"{label}: argument `units` names {strange[0]!r}, but the channels are {', '.join(given)}; name "
            "one of these."
        )
    return Recording(
        u=real_numbers(source.u, f"{label}: `u`"),
        y=y,
        Ts=float(np.asarray(period)),
        channels=given,
        units=[(units or {}).get(name, "") for name in given],
        n_init=known["n_init"],
        source=label,
        accept=accept,
    )


def _first(source: Any, names: Sequence[str]) -> Any:
    """The first of these attributes that is not None."""
    return next((v for n in names if (v := getattr(source, n, None)) is not None), None)
