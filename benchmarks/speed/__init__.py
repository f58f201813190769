"""B7: computing times of the toolkit, compared with C, numba and other libraries for the same tasks."""
