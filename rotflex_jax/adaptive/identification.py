"""An adaptive filter run over a recording, and the model that its last weights make."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from rotflex_jax.adaptive.filter import AdaptiveFilter
from rotflex_jax.adaptive.lattice import VolterraLattice
from rotflex_jax.adaptive.running import Run, run
from rotflex_jax.basis import Basis, Delays, Volterra
from rotflex_jax.errors import InputError
from rotflex_jax.models.series import Series
from rotflex_jax.recording import Recording
from rotflex_jax.recording.listing import single


@dataclass(frozen=True)
class Identified:
    """Result of a filter over a recording: a run, and a model.

    They have different errors. Those of the run are online: weights that follow the recording predict the
    next sample, which even a wrong model with a large step size does well. The weights of the model are
    frozen, and its error on another recording says what was identified. Only that one may be compared with
    other methods.

    Attributes:
        run: errors, weights and status of the filter, from sample `n_init` of the recording on.
        basis: of the regressors.
        recording: what the filter ran over.
        channel: the output.
    """

    run: Run
    basis: Basis
    recording: Recording
    channel: str

    @property
    def model(self) -> Series:
        """The last weights, frozen, as a model that simulates.

        Raises:
            InputError: the filter diverged, so that its weights mean nothing.
        """
        if self.run.diverged:
            raise InputError(
                f"The filter {self.run.status} of its run, so its weights make no model; "
                "give a smaller step size."
            )
        unit = self.recording.units[self.recording.channels.index(self.channel)]
        return Series(
            self.basis, self.run.weights, self.channel, self.recording.Ts, self.recording.input_unit, unit
        )

    @property
    def online_nmse(self) -> float:
        """Squared a-priori errors of the moving weights relative to the output about its mean [-].

            sum e^2 / sum (y - mean y)^2

        Not a quality of the model: see `frozen_nmse`. NaN after a divergence.
        """
        return _relative(self.run.errors, _scored(self.recording, self.channel))

    def frozen_nmse(self, recording: Recording) -> float:
        """Squared errors of the frozen weights relative to the output about its mean [-].

            sum (y - y_hat)^2 / sum (y - mean y)^2

        Args:
            recording: one that the filter did not see; its first `n_init` samples do not count.
        """
        y = _scored(recording, self.channel)
        return _relative(y - self.model.simulate(recording)[recording.n_init :, 0], y)


def identify(
    filter: AdaptiveFilter, basis: Basis, recording: Recording, channel: str, *, keep_every: int = 0
) -> Identified:
    """Runs an adaptive filter over a recording, on the regressors that a basis makes of its input.

    Nothing is taken off the data: a mean of the output is the basis's constant to learn, and an
    input's mean stays in it, as powers of the input depend on it. The filter starts at sample
    `n_init`. The samples before only fill the memory of the basis, which takes the input before the
    recording as zero; a bank that remembers longer than `n_init` passes its transient on to the
    filter. `VolterraLattice` makes its own regressors and takes what is before `n_init` as zero too.

    Args:
        filter: with its settings.
        basis: such as `Volterra(Delays(5))`.
        recording: its input drives the basis, one of its channels is the output to follow.
        channel: name of that channel.
        keep_every: keep the weights after every so many samples; 0 keeps only the last.

    Raises:
        InputError: no such channel, or a basis that is not the one that the filter is made for.
    """
    recording = single(recording, "recording")
    y, n = recording.channel(channel), recording.n_init
    if filter.from_input:
        done = run(filter, _own_input(filter, basis, recording)[n:], y[n:], keep_every=keep_every)
    else:
        done = run(filter, recording.u, y[n:], basis=basis, keep_every=keep_every)
    return Identified(done, basis, recording, channel)


def _own_input(filter: AdaptiveFilter, basis: Basis, recording: Recording) -> Float[np.ndarray, " N"]:
    """The input of a filter that makes its own regressors, if those are the basis's."""
    if not isinstance(filter, VolterraLattice):
        raise InputError(
            f"{type(filter).__name__} makes its own regressors, of which nothing is known here; "
            "use `run` on the input."
        )
    chosen = (0, 1, 2) if filter.constant else (1, 2)
    if not (
        isinstance(basis, Volterra)
        and isinstance(basis.bank, Delays)
        and basis.bank.memory == filter.memory
        and (basis.chosen, basis.layout) == (chosen, "triangular")
    ):
        raise InputError(
            f"{filter} needs the basis Volterra(Delays({filter.memory}), order=2, "
            f"constant={filter.constant}) in the triangular layout, but was given another; "
            "use RLS with that basis, or the lattice's own."
        )
    return basis.bank.outputs(recording.u)[:, 0]


def _scored(recording: Recording, channel: str) -> Float[np.ndarray, " N"]:
    """The output from `n_init` on."""
    return recording.channel(channel)[recording.n_init :].astype(float)


def _relative(e: Float[np.ndarray, " N"], y: Float[np.ndarray, " N"]) -> float:
    """Squares of e relative to those of y about its mean."""
    with np.errstate(all="ignore"):
        return float(np.sum(e.astype(float) ** 2) / np.sum((y - np.mean(y)) ** 2))
