"""One thread for the linear algebra library: matrices here are small and many, and threads only wait."""

from threadpoolctl import threadpool_limits

one_thread = threadpool_limits.wrap(limits=1, user_api="blas")
"""Decorator: inside the function linear algebra runs in one thread."""
