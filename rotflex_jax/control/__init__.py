"""Controllers from fitted models: design, simulation on every model that the data leave possible, C code."""

from rotflex_jax.control.assessment import ControlAssessment, assess, credible_models
from rotflex_jax.control.c_code import controller_to_c
from rotflex_jax.control.closed_loop import ClosedLoop, LimitCycle, Plant, close_loop
from rotflex_jax.control.design import Controller, PlannedMotion, controller

__all__ = [
    "ClosedLoop",
    "ControlAssessment",
    "Controller",
    "LimitCycle",
    "Plant",
    "PlannedMotion",
    "assess",
    "close_loop",
    "controller",
    "controller_to_c",
    "credible_models",
]
