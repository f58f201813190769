"""Discovery: which physical effect does the model lack?"""

from rotflex_jax.discover.discovery import Discovery
from rotflex_jax.discover.learned_torque import LearnedTorqueResult, learn_torque
from rotflex_jax.discover.localise import locate
from rotflex_jax.discover.result import Ranked, Round, Stage, Where
from rotflex_jax.discover.search import discover

__all__ = [
    "Discovery",
    "LearnedTorqueResult",
    "Ranked",
    "Round",
    "Stage",
    "Where",
    "discover",
    "learn_torque",
    "locate",
]
