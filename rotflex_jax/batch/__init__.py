"""Many recordings at once: processes of this machine or a Dask cluster, one row a recording."""

from rotflex_jax.batch.result import Fleet, RecordingRow
from rotflex_jax.batch.run import fleet

__all__ = ["Fleet", "RecordingRow", "fleet"]
