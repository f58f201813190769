"""Trials, tables and pages of the benchmarks that use the arena, `rotflex_jax.arena`.

The package contains what `rotflex arena` needs: the simulator, wrong worlds, other methods, and the scoring
of one answer. This folder contains what only the benchmarks need: trials of the search and its oracle,
their tables and pages, calibration of probabilities, and the demonstration recording.
"""
