"""For two effects that a recording cannot distinguish: the input that would."""

from rotflex_jax.experiment.design import next_experiment
from rotflex_jax.experiment.result import Experiment, Rated
from rotflex_jax.experiment.standard_inputs import Limits

__all__ = ["Experiment", "Limits", "Rated", "next_experiment"]
