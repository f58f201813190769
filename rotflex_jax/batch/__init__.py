"""Searches of many recordings, in processes of this machine or on a Dask cluster; one row per recording."""

from rotflex_jax.batch.result import Fleet, RecordingRow
from rotflex_jax.batch.run import fleet

__all__ = ["Fleet", "RecordingRow", "fleet"]
