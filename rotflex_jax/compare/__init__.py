"""Comparison of methods on the same recordings: same split, same first samples, free runs only."""

from rotflex_jax.compare.adaptive_series import AdaptiveSeries
from rotflex_jax.compare.arx import ARX
from rotflex_jax.compare.linear_models import LinearStateSpace, Subspace
from rotflex_jax.compare.method import METHODS, Fitted, Method, register
from rotflex_jax.compare.physics import (
    Discovered,
    GreyBox,
    GreyBoxPredictor,
    LearnedTorqueMethod,
    LinearPart,
    Textbook,
)
from rotflex_jax.compare.run import compare
from rotflex_jax.compare.series import RIDGES, BatchSeries
from rotflex_jax.compare.sindy import SINDy
from rotflex_jax.compare.table import Comparison, Row

# The methods run in this order; each further method is one more line.
register(Textbook())
register(LinearPart())
register(GreyBox())
register(GreyBoxPredictor())
register(Discovered())
register(LearnedTorqueMethod())
register(ARX())
register(Subspace())
register(LinearStateSpace())
register(BatchSeries("fir_ls", "a finite impulse response, by least squares", order=1, count=40))
register(BatchSeries("volterra_ls", "a Volterra series on delays, order 2, by least squares"))
register(
    BatchSeries(
        "volterra3_ridge",
        "a Volterra series on delays, order 3, by ridge",
        order=3,
        count=6,
        penalties=RIDGES,
    )
)
register(BatchSeries("laguerre_ls", "Laguerre functions, by least squares", "laguerre", 1, 8))
register(
    BatchSeries("laguerre_ridge", "a Laguerre-Volterra series, order 2, by ridge", "laguerre", 2, 7, RIDGES)
)
register(
    BatchSeries("laguerre3_ridge", "a Laguerre-Volterra series, order 3, by ridge", "laguerre", 3, 5, RIDGES)
)
register(BatchSeries("kautz_ridge", "a Kautz-Volterra series, order 2, by ridge", "kautz", 2, 6, RIDGES))
register(
    BatchSeries(
        "pole_ridge",
        "a Volterra series on the poles of a linear model, order 2, by ridge",
        "poles",
        2,
        6,
        RIDGES,
    )
)
register(AdaptiveSeries("volterra_lms", "a Volterra series, order 2, by LMS, step sizes from a grid"))
register(
    AdaptiveSeries(
        "volterra_lms_gradient", "a Volterra series, order 2, by LMS, step sizes by gradient", gradient=True
    )
)
register(AdaptiveSeries("volterra_nlms", "a Volterra series, order 2, by NLMS", "nlms"))
register(AdaptiveSeries("volterra_rls", "a Volterra series, order 2, by RLS", "rls"))
register(AdaptiveSeries("volterra_kalman", "a Volterra series, order 2, by a Kalman filter", "kalman"))
register(
    AdaptiveSeries(
        "laguerre3_rls",
        "a Laguerre-Volterra series, order 3, by RLS",
        "rls",
        bank="laguerre",
        order=3,
        count=5,
    )
)
register(SINDy())
register(SINDy("sindy_ensemble", "sparse equations of motion, median of an ensemble", "ensemble"))
register(SINDy("sindy_weak", "sparse equations of motion, weak form", "weak"))
register(
    SINDy(
        "sindy_free_run",
        "sparse equations of motion, weak form, coefficients refined for free runs",
        "weak",
        free_runs=True,
    )
)

QUICK = tuple(name for name in METHODS if name not in ("discovered", "learned_torque", "sindy_ensemble"))
"""Names of the methods without a long search."""

__all__ = [
    "ARX",
    "AdaptiveSeries",
    "BatchSeries",
    "Comparison",
    "Discovered",
    "Fitted",
    "GreyBox",
    "GreyBoxPredictor",
    "LearnedTorqueMethod",
    "LinearPart",
    "LinearStateSpace",
    "METHODS",
    "Method",
    "QUICK",
    "RIDGES",
    "Row",
    "SINDy",
    "Subspace",
    "Textbook",
    "compare",
    "register",
]
