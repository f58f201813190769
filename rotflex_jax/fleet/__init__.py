"""Many recordings at once: processes of this machine or a Dask cluster, one row a recording."""

from rotflex_jax.fleet.loop import fleet
from rotflex_jax.fleet.result import Fleet, Row

__all__ = ["Fleet", "Row", "fleet"]
