"""Mechanisms and their motion: from ports and effects to simulated outputs."""

from rotflex_jax.mechanism.linear import StateSpace, kalman_gains, linearise
from rotflex_jax.mechanism.mechanism import Mechanism
from rotflex_jax.mechanism.quantity import Units
from rotflex_jax.mechanism.simulate import Solver, free_run, predictor_run, simulate, simulate_states
from rotflex_jax.mechanism.smooth_rk4 import SmoothRK4
from rotflex_jax.mechanism.step import Exponential

__all__ = [
    "Exponential",
    "Mechanism",
    "SmoothRK4",
    "Solver",
    "StateSpace",
    "Units",
    "free_run",
    "kalman_gains",
    "linearise",
    "predictor_run",
    "simulate",
    "simulate_states",
]
