"""Compare a model of a machine with measurements, find the physics it lacks, add it, watch the error fall.

    import rotflex_jax as rf
    rec = rf.load("run.csv")
    train, test = rec.split(0.7)
    result = rf.discover(rf.joints.paper(), train, test)

Importing the package changes no setting of JAX and loads neither matplotlib nor pandas.
"""

from rotflex_jax import adaptive, basis, data, effects, export, joints, kernels, metrics
from rotflex_jax.compare import Comparison, compare
from rotflex_jax.data import load
from rotflex_jax.discover import Discovery, LearnedTorqueResult, discover, learn_torque, locate
from rotflex_jax.display import explore, live
from rotflex_jax.errors import InputError
from rotflex_jax.experiment import Experiment, Limits, next_experiment
from rotflex_jax.fastloops import enable_compilation_cache, enable_fast_loops
from rotflex_jax.fit import ManyStarts, SeriesFit, fit, forward_regression, least_squares, many_starts
from rotflex_jax.fit.fitted import Fit
from rotflex_jax.fleet import Fleet, fleet
from rotflex_jax.latent import LatentTorque, latent_torque
from rotflex_jax.mechanism import Exponential, Mechanism, SmoothRK4, linearise, simulate
from rotflex_jax.model import Model
from rotflex_jax.recording import Recording
from rotflex_jax.series import Series

__version__ = "0.1.0"

__all__ = [
    "Comparison",
    "Discovery",
    "Experiment",
    "Exponential",
    "Fit",
    "Fleet",
    "InputError",
    "LatentTorque",
    "LearnedTorqueResult",
    "Limits",
    "ManyStarts",
    "Mechanism",
    "Model",
    "Recording",
    "Series",
    "SeriesFit",
    "SmoothRK4",
    "adaptive",
    "basis",
    "compare",
    "data",
    "discover",
    "effects",
    "enable_compilation_cache",
    "enable_fast_loops",
    "explore",
    "export",
    "fit",
    "fleet",
    "forward_regression",
    "joints",
    "kernels",
    "latent_torque",
    "learn_torque",
    "least_squares",
    "linearise",
    "live",
    "load",
    "locate",
    "many_starts",
    "metrics",
    "next_experiment",
    "simulate",
]
