"""Recordings from files and from public data sets, and input signals for experiments."""

from rotflex_jax.data import datasets as datasets, excitation as excitation
from rotflex_jax.data.datasets import (
    Benchmark as Benchmark,
    benchmark as benchmark,
    demo_recording as demo_recording,
    fetch as fetch,
    list_datasets as list_datasets,
    load_dataset as load_dataset,
)
from rotflex_jax.data.files import load as load, save_csv as save_csv
from rotflex_jax.data.readers import (
    load_bam_xl330 as load_bam_xl330,
    load_bam_xl330_released as load_bam_xl330_released,
    load_rotflex as load_rotflex,
)
