"""The two horizons at which hypotheses are fitted and compared: one-step prediction and short free runs."""

import dataclasses

from rotflex_jax.discover.hypothesis import Hypothesis, embed_initial_state
from rotflex_jax.discover.likelihood import LikelihoodProblem
from rotflex_jax.discover.validation import ValidatedHypothesis, ValidationSet, validate
from rotflex_jax.fit.windows import Windows
from rotflex_jax.metrics import window_starts
from rotflex_jax.models.model import Model


@dataclasses.dataclass(frozen=True)
class SearchHorizon:
    """Training and validation recordings at one horizon.

    Attributes:
        problem: The likelihood of the training recordings.
        validation: The validation recordings.
    """

    problem: LikelihoodProblem
    validation: ValidationSet


@dataclasses.dataclass(frozen=True)
class Horizons:
    """Both horizons; the same compiled programs serve both, as windows are data.

    Attributes:
        prediction: Each sample from the ones before it, with the process noise that the data ask for.
        free_run: From the voltage alone, starting again every few seconds.
    """

    prediction: SearchHorizon
    free_run: SearchHorizon

    @classmethod
    def of(
        cls, model: Model, train: LikelihoodProblem, validation: LikelihoodProblem | None, seconds: float
    ) -> "Horizons":
        """Both horizons of predictions.

        Args:
            model: The user's model.
            train: Predictions of the training recordings.
            validation: Predictions of the validation recordings; if None, each training recording validates
                what was fitted to the others.
            seconds: Length of a free run [s].
        """
        problems = (train, *([validation] if validation else []))
        recordings = [r for p in problems for r in p.dataset.recordings]
        number = max(len(window_starts(r, seconds)[0]) for r in recordings)
        whole = [dataclasses.replace(p, windows=Windows.whole(p.dataset, number)) for p in problems]
        cut = [p.of_free_runs(Windows.of_seconds(model, p.dataset, seconds, number)) for p in problems]
        if validation is None:
            sets = [ValidationSet.leave_one_out(p[0], seconds) for p in (whole, cut)]
        else:
            sets = [ValidationSet(p[1], seconds) for p in (whole, cut)]
        return cls(SearchHorizon(whole[0], sets[0]), SearchHorizon(cut[0], sets[1]))

    def validated(
        self, prediction: Hypothesis, free_run: Hypothesis, near: ValidatedHypothesis | None = None
    ) -> ValidatedHypothesis:
        """One structure, fitted at both horizons, on validation data.

        Args:
            prediction: Fitted to predictions.
            free_run: Fitted to free runs.
            near: Another structure; see `validate`.
        """
        runs = validate(self.free_run.validation, free_run, near.free_run if near else None)
        found = validate(self.prediction.validation, prediction, near, runs.adapted)
        return dataclasses.replace(found, free_run=runs)


def at_horizon(problem: LikelihoodProblem, h: Hypothesis, intensity: dict[str, float]) -> Hypothesis:
    """The parameters of a hypothesis at another horizon, from measured first states; not fitted.

    Args:
        problem: The same recordings at that horizon.
        h: Its parameters.
        intensity: Port -> process noise [(N m)^2 s]; a free run has none.
    """
    x0 = embed_initial_state(problem.supermodel, h.locations, problem.windows.first_states)
    start = problem.with_process_noise(dataclasses.replace(h, x0=x0), intensity)
    return problem.evaluated(start, problem.innovations([start])[0])


def as_free_run(problem: LikelihoodProblem, h: Hypothesis) -> Hypothesis:
    """A hypothesis of predictions as one of free runs; `problem` is that of free runs."""
    return at_horizon(problem, h, dict.fromkeys(problem.ports, 0.0))
