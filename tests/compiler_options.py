"""Compiler options of programs that tests run only a few times."""

ROUGH = {"xla_backend_optimization_level": 0, "xla_llvm_disable_expensive_passes": True}
"""Without optimisation, which would take longer than it saves."""
