"""Compare a model of a machine with measurements, find the physics it lacks, add it, watch the error fall.

    import rotflex_jax as rf
    rec = rf.load("run.csv")
    train, test = rec.split(0.7)
    result = rf.discover(rf.joints.paper(), train, test)

Importing the package changes no setting of JAX and loads neither matplotlib nor pandas.
"""

from rotflex_jax import adaptive, basis, data, effects, joints, kernels, metrics
from rotflex_jax.compare import Comparison, compare
from rotflex_jax.data import load
from rotflex_jax.discover import Discovery, discover, locate
from rotflex_jax.errors import InputError
from rotflex_jax.fastloops import enable_compilation_cache, enable_fast_loops
from rotflex_jax.fit import SeriesFit, fit, forward_regression, least_squares
from rotflex_jax.mechanism import Exponential, Mechanism, SmoothRK4, linearise, simulate
from rotflex_jax.model import Fit, Model
from rotflex_jax.recording import Recording
from rotflex_jax.series import Series

__version__ = "0.1.0"

__all__ = [
    "Comparison",
    "Discovery",
    "Exponential",
    "Fit",
    "InputError",
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
    "fit",
    "forward_regression",
    "joints",
    "kernels",
    "least_squares",
    "linearise",
    "load",
    "locate",
    "metrics",
    "simulate",
]
