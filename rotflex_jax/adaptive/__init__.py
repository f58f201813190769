"""Adaptive filters: weights that are corrected after every sample.

The package also contains the theory of the simplest filter, LMS (`Moments`, `analyse`, bounds and learning
curves), and searches for settings of filters by gradient (`tune`) or on a grid (`grid`).
"""

from rotflex_jax.adaptive.filter import AdaptiveFilter, scan
from rotflex_jax.adaptive.lattice import VolterraLattice
from rotflex_jax.adaptive.learning_curve import (
    LearningCurve,
    learning_curve,
    settling_factor,
    settling_samples,
    settling_step_size,
)
from rotflex_jax.adaptive.lms import LMS, NLMS, AffineProjection, fixed_point
from rotflex_jax.adaptive.moments import Moments, ar1_covariance
from rotflex_jax.adaptive.objectives import Tuned
from rotflex_jax.adaptive.rls import RLS, Kalman
from rotflex_jax.adaptive.running import Identified, Run, identify, run
from rotflex_jax.adaptive.step_sizes import Stability, analyse, mean_bound, mean_square_bound
from rotflex_jax.adaptive.tuning import grid, tune

__all__ = [
    "LMS",
    "NLMS",
    "RLS",
    "AdaptiveFilter",
    "AffineProjection",
    "Identified",
    "Kalman",
    "LearningCurve",
    "Moments",
    "Run",
    "Stability",
    "Tuned",
    "VolterraLattice",
    "analyse",
    "ar1_covariance",
    "fixed_point",
    "grid",
    "identify",
    "learning_curve",
    "mean_bound",
    "mean_square_bound",
    "run",
    "scan",
    "settling_factor",
    "settling_samples",
    "settling_step_size",
    "tune",
]
