"""Marks, tables and pages of the benchmarks that use the arena, `rotflex_jax.arena`.

The simulator, the wrong worlds, the other methods and the marks of one answer are part of the package, for
`rotflex arena`; here is what only the benchmarks need: trials of the search beside its oracle, their tables,
calibration, the demonstration recording.
"""
