"""Discovery: which physical effect does the model lack?"""

from rotflex_jax.discover.locate import locate
from rotflex_jax.discover.loop import discover
from rotflex_jax.discover.result import Discovery, Ranked, Round, Stage, Where

__all__ = ["Discovery", "Ranked", "Round", "Stage", "Where", "discover", "locate"]
