"""Volterra series of any order on any bank, all weights at once by least squares."""

import dataclasses
from collections.abc import Sequence

from rotflex_jax.basis import Volterra
from rotflex_jax.compare.banks import Kind, banks
from rotflex_jax.compare.held_in import one_period
from rotflex_jax.compare.method import Fitted, Progress
from rotflex_jax.compare.series_rows import Choice, choose
from rotflex_jax.compare.series_run import model_of
from rotflex_jax.model import Model
from rotflex_jax.recording import Recording

RIDGES = (1e-9, 1e-7, 1e-5, 1e-3, 1e-1)


@dataclasses.dataclass(frozen=True)
class BatchSeries:
    """A Volterra series of the input by batch least squares, fitted to free runs.

    The time scale of the bank, and whether the series is an output or its rate, are those with the
    best free run over the last part of the training recordings; for each output its own. Not where
    friction sticks: no polynomial of the past input holds a machine still.

    Source: Schetzen 1980; orthonormal banks Wahlberg 1991, IEEE Trans. Autom. Control 36.

    Attributes:
        name: Short.
        title: In words.
        bank: Kind of the bank.
        order: Of the Volterra series.
        count: Columns of the bank.
        penalties: Ridges to choose from, on weights of regressors of size one, per sample.
        share: Share of each training recording to learn from; the rest decides.
    """

    name: str
    title: str
    bank: Kind = "delays"
    order: int = 2
    count: int = 12
    penalties: tuple[float, ...] = (0.0,)
    share: float = 0.7
    family: str = "series"

    def fit(self, model: Model, train: Sequence[Recording], say: Progress) -> Fitted:
        """Takes no notice of the model."""
        one_period(train, "a series")
        candidates = [Volterra(b, self.order) for b in banks(self.bank, self.count, train)]
        choices = []
        for c, name in enumerate(train[0].channels):
            choices.append(choose(candidates, train, c, self.share, self.penalties))
            say(f"{name}: log error {choices[-1].cost:.2f}")
        found = model_of([choice.series for choice in choices])
        return Fitted(found, found.parameters, in_words(choices, train[0]), found.predict)


def in_words(choices: Sequence[Choice], recording: Recording) -> str:
    """What was chosen for each channel."""
    said = []
    for choice, name in zip(choices, recording.channels, strict=True):
        bank = choice.series.basis.bank
        seconds = min(int(bank.reach), recording.N) * recording.Ts
        rate = "rate of " if choice.series.integrates else ""
        said.append(f"{rate}{name} from {seconds:.2g} s of input")
    return ", ".join(said)
