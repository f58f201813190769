"""The input of an average, where it starts, and how it is cut for standard errors."""

from typing import NamedTuple

import numpy as np

from rotflex_jax.errors import InputError
from rotflex_jax.kernels.subject import Subject
from rotflex_jax.mechanism.assembly import rest_state
from rotflex_jax.mechanism.initial import initial_states
from rotflex_jax.recording import Recording


class Stretches(NamedTuple):
    """The input of the average, and how it is cut.

    Attributes:
        u: Voltage (N,) [V].
        Ts: Sampling period [s].
        x0: First state.
        memory: Lags M of the kernels.
        reach: Lags L of the slopes.
        blocks: Number of stretches.
        width: Samples per stretch; the stretches end with the recording.
        mirrored: Whether the voltage of opposite sign takes part.
        unit: Units of input and output.
    """

    u: np.ndarray
    Ts: float
    x0: np.ndarray
    memory: int
    reach: int
    blocks: int
    width: int
    mirrored: bool
    unit: tuple[str, str]

    @property
    def about(self) -> float:
        """Input level that the kernels are about [V]."""
        return 0.0 if self.mirrored else float(np.mean(self.u))

    @classmethod
    def of(
        cls,
        s: Subject,
        data: Recording | np.ndarray,
        Ts: float | None,
        memory: int,
        reach: int | None,
        blocks: int,
        mirrored: bool,
    ) -> "Stretches":
        """Checked, with the first state that a recording tells."""
        reach = 2 * memory if reach is None else reach
        x0 = rest_state(s.mechanism.structure, np.float64)
        channel = s.mechanism.channels[s.output]
        unit, skip = ("V", s.unit), reach
        if isinstance(data, Recording):
            m, Ts, u = data.n_init, data.Ts, data.u.astype(float)
            unit = (data.input_unit, dict(zip(data.channels, data.units, strict=True)).get(channel, s.unit))
            skip = max(reach, m)
            if set(s.mechanism.channels) <= set(data.channels):
                y = np.stack([data.channel(c) for c in s.mechanism.channels], axis=1).astype(float)
                start = initial_states(s.mechanism, s.solver, s.gates, u[None, :m], y[None, :m], Ts)[0]
                x0[: len(start)] = start
        else:
            u = np.asarray(data, float)
        if Ts is None or not (np.isfinite(Ts) and Ts > 0) or u.ndim != 1 or not np.all(np.isfinite(u)):
            raise InputError(
                f"A voltage of shape {u.shape} with Ts = {Ts} was given, but finite values (N,) and a "
                "positive sampling period are needed; give both, or a recording."
            )
        width = (len(u) - skip) // max(blocks, 1)
        if reach < memory or blocks < 2 or width < memory:
            raise InputError(
                f"{len(u)} samples in {blocks} blocks with a memory of {memory} and a reach of {reach} lags "
                "were given, but the reach must not be below the memory and each of at least two blocks "
                "needs as many samples as the memory has lags; give a longer recording or fewer blocks."
            )
        return cls(u, float(Ts), x0, memory, reach, blocks, width, mirrored, unit)
