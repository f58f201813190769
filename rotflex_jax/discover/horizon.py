"""The two horizons at which hypotheses are fitted and compared: one-step prediction and short free runs."""

import dataclasses

import numpy as np

from rotflex_jax.discover.hypothesis import Hypothesis, embed_initial_state
from rotflex_jax.discover.likelihood import LikelihoodProblem
from rotflex_jax.discover.refit import refit
from rotflex_jax.discover.validation import ValidatedHypothesis, ValidationSet, validate
from rotflex_jax.discover.windows import Windows
from rotflex_jax.models.model import Model


@dataclasses.dataclass(frozen=True)
class SearchHorizon:
    """Training and validation recordings at one horizon.

    Attributes:
        name: "prediction" or "free_run", as in the JSON.
        problem: The likelihood of the training recordings.
        validation: The validation recordings.
    """

    name: str
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
        number = max(Windows.of_seconds(model, p.dataset, seconds).number for p in problems)
        whole = [dataclasses.replace(p, windows=Windows.whole(p.dataset, number)) for p in problems]
        cut = [p.of_free_runs(Windows.of_seconds(model, p.dataset, seconds, number)) for p in problems]
        if validation is None:
            sets = [ValidationSet.leave_one_out(p[0], seconds) for p in (whole, cut)]
        else:
            sets = [ValidationSet(p[1], seconds) for p in (whole, cut)]
        return cls(SearchHorizon("prediction", whole[0], sets[0]), SearchHorizon("free_run", cut[0], sets[1]))

    def validated(
        self, prediction: Hypothesis, free_run: Hypothesis, near: ValidatedHypothesis | None = None
    ) -> ValidatedHypothesis:
        """One structure, fitted at both horizons, on validation data.

        Args:
            prediction: Fitted to predictions.
            free_run: Fitted to free runs.
            near: Another structure; see `validate`.
        """
        found = validate(self.prediction.validation, prediction, near)
        runs = validate(self.free_run.validation, free_run, near.free_run if near else None)
        return dataclasses.replace(found, free_run=runs)


def as_free_run(problem: LikelihoodProblem, h: Hypothesis) -> Hypothesis:
    """A hypothesis of predictions as one of free runs, which start in measured states; not fitted.

    Args:
        problem: Of free runs.
        h: Its parameters.
    """
    x0 = embed_initial_state(problem.supermodel, h.locations, problem.windows.first_states)
    start = problem.with_process_noise(dataclasses.replace(h, x0=x0), dict.fromkeys(problem.ports, 0.0))
    return problem.evaluated(start, problem.innovations([start])[0])


def as_prediction(problem: LikelihoodProblem, h: Hypothesis, intensity: dict[str, float]) -> Hypothesis:
    """The parameters of a hypothesis of free runs in predictions; not fitted.

    Args:
        problem: Of predictions.
        h: Its parameters.
        intensity: Port -> process noise [(N m)^2 s].
    """
    x0 = embed_initial_state(problem.supermodel, h.locations, problem.windows.first_states)
    start = problem.with_process_noise(dataclasses.replace(h, x0=x0), intensity)
    return problem.evaluated(start, problem.innovations([start])[0])


def fit_free_runs(problem: LikelihoodProblem, *starts: Hypothesis) -> Hypothesis:
    """The best fit of free runs from the parameters of hypotheses of predictions.

    Args:
        problem: Of free runs.
        starts: Of one structure.
    """
    begun = [as_free_run(problem, h) for h in starts]
    finite = [h for h in begun if np.isfinite(h.log_likelihood)]
    return max(refit(problem, finite or begun), key=lambda h: h.log_likelihood)
