"""Parts of `B1_rotflex.py` beside its tables: integrators, fits and figures."""
