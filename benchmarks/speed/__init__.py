"""How quick the toolkit is beside C, numba and the libraries that people use for the same work."""
