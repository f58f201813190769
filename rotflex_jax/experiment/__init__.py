"""For two effects that a recording cannot tell apart: the input that would."""

from rotflex_jax.experiment.design import next_experiment
from rotflex_jax.experiment.limits import Limits
from rotflex_jax.experiment.result import Experiment, Rated

__all__ = ["Experiment", "Limits", "Rated", "next_experiment"]
