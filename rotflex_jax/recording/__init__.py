"""A recording: what was measured, checked once when it is made and never changed after."""

from rotflex_jax.recording.quality import Finding as Finding
from rotflex_jax.recording.recording import Recording as Recording
