"""Discovery: which physical effect does the model lack?"""

from rotflex_jax.discover.learned import learn_torque
from rotflex_jax.discover.learned_result import LearnedTorqueResult
from rotflex_jax.discover.locate import locate
from rotflex_jax.discover.loop import discover
from rotflex_jax.discover.result import Discovery, Ranked, Round, Stage, Where

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
