"""A recording: measured input and outputs, checked once when it is created and never changed afterwards."""

from rotflex_jax.recording.quality import Finding as Finding
from rotflex_jax.recording.recording import Recording as Recording
