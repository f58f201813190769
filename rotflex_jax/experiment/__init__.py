"""Experiments to distinguish models: the best next input, and experiments that stop when it is decided."""

from rotflex_jax.experiment.design import next_experiment
from rotflex_jax.experiment.result import Experiment, Rated, Segment, SequentialResult
from rotflex_jax.experiment.rig import CallbackRig, FileRig, Rig, SimulatedRig
from rotflex_jax.experiment.standard_inputs import Limits
from rotflex_jax.experiment.until_decided import experiment_until

__all__ = [
    "CallbackRig",
    "Experiment",
    "FileRig",
    "Limits",
    "Rated",
    "Rig",
    "Segment",
    "SequentialResult",
    "SimulatedRig",
    "experiment_until",
    "next_experiment",
]
