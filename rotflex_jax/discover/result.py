"""What discovery returns: stages, rounds, ranking, places of failure, a verdict, what to do next."""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rotflex_jax.discover.findings import Ranked, Round, Stage, Where, plain
from rotflex_jax.experiment import Experiment
from rotflex_jax.model import Model
from rotflex_jax.recording import Recording

if TYPE_CHECKING:
    from rotflex_jax.discover.learned_result import LearnedTorqueResult
    from rotflex_jax.discover.photographs import Photographs

# Name of the file beside a report that holds the input to play next.
NEXT = "next_experiment.csv"

__all__ = ["NEXT", "VERDICTS", "Discovery", "Ranked", "Round", "Stage", "Where"]

VERDICTS = ("found", "nothing_missing", "ambiguous", "unexplained", "not_excited")


@dataclasses.dataclass(frozen=True)
class Discovery:
    """Result of the loop.

    Attributes:
        verdict: One of `VERDICTS`; speaks of the end state.
        sentence: The verdict in words.
        train: Recordings that were fitted.
        test: Recordings that were held out.
        baseline: The user's model, fitted.
        rounds: What was added, in order.
        ranking: All candidates as the baseline's score test saw them, best first.
        where: Where the baseline fails.
        noise_floor: Channel -> deviation of the sensor noise.
        elapsed_s: Time taken [s].
        notes: Remarks for a reader.
        proposal: Where two effects remain: the standard input that tells them apart best.
    """

    verdict: str
    sentence: str
    train: tuple[Recording, ...]
    test: tuple[Recording, ...]
    baseline: Stage
    rounds: tuple[Round, ...]
    ranking: tuple[Ranked, ...]
    where: tuple[Where, ...]
    noise_floor: dict[str, float]
    elapsed_s: float
    notes: tuple[str, ...] = ()
    proposal: Experiment | None = None

    @property
    def model(self) -> Model:
        """The model after the last round."""
        return self.final.model

    @property
    def final(self) -> Stage:
        """The stage after the last round."""
        return self.rounds[-1].stage if self.rounds else self.baseline

    @property
    def stages(self) -> tuple[Stage, ...]:
        """Baseline, then one stage per round."""
        return (self.baseline, *(r.stage for r in self.rounds))

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON types, schema 1."""
        return {
            "schema": 1,
            "verdict": self.verdict,
            "sentence": self.sentence,
            "baseline": self.baseline.errors(),
            "noise_floor": plain(self.noise_floor),
            "rounds": [r.to_dict() for r in self.rounds],
            "ranking": [r.to_dict() for r in self.ranking],
            "where": [w.to_dict() for w in self.where],
            "next_experiment": self.proposal.to_dict(NEXT) if self.proposal else None,
            "notes": list(self.notes),
            "elapsed_s": self.elapsed_s,
        }

    def latent_torque(self, progress: Callable[[str], None] | None = None) -> "Photographs":
        """Torques that the baseline and the final model lack, on a fitted and a held-out recording."""
        from rotflex_jax.discover.photographs import photographs  # which knows of this module

        longest = [max(group, key=lambda r: r.N) for group in (self.train, self.test)]
        return photographs(self.baseline, self.final if self.rounds else None, longest, progress)

    def learned_torque(
        self, at: str = "hub", progress: Callable[[str], None] | None = None
    ) -> "LearnedTorqueResult":
        """A smooth map of position and speed learned on top of the final model, for what is unexplained.

        Args:
            at: Port of the torque.
            progress: Called with a line of text at each stage.
        """
        from rotflex_jax.discover.learned import learn_torque  # which knows of this module

        seconds = self.baseline.window_seconds
        return learn_torque(self.model, self.train, self.test, at, window_seconds=seconds, progress=progress)

    def save(self, path: str | Path) -> Path:
        """Write the final model as JSON, with its estimates; `Model.load` reads the model."""
        from rotflex_jax.export.files import Saved, save

        seen = self.train[0]
        return save(Saved(self.model, self.final.estimates, Ts=seen.Ts, n_init=seen.n_init), path)

    def next_experiment(self, **changes: Any) -> Experiment | None:
        """Design the input that tells the first effect found from its equal; None where it has none.

        The model, its noise and the machine's limits are those of the recordings: no more voltage, slew or
        deflection than they hold.

        Args:
            changes: Other arguments of `rotflex_jax.next_experiment`, its `limits` for instance.
        """
        from rotflex_jax.discover.proposal import proposed  # it needs this module

        return proposed(self, **changes)

    def report(self, folder: str | Path, *, learned: bool | None = None) -> Path:
        """Write `report.html` (self-contained) and `result.json` into a folder; returns the HTML path.

        Where the verdict is ambiguous, the input to play next lies beside them as a file.

        Args:
            folder: Where to write.
            learned: Whether to learn a torque for what is left, which takes about as long as a round; where
                the verdict is `unexplained` if None.
        """
        from rotflex_jax.report import write_report  # the layer above, on request

        page = write_report(self, Path(folder), learned=learned)
        if self.proposal is not None:
            self.proposal.save_csv(Path(folder) / NEXT)
        return page

    def _repr_html_(self) -> str:
        from rotflex_jax.display.cards import discovery_card  # the layer above, when a notebook asks

        return discovery_card(self)

    def __str__(self) -> str:
        lines = [self.sentence]
        lines += [f"  {i}. {r.sentence}" for i, r in enumerate(self.rounds, 1)]
        return "\n".join(lines)
