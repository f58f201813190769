"""Local polynomials against `scipy.signal`, which the package does not import for them."""

import subprocess
import sys

import numpy as np
import pytest
import scipy.signal

from rotflex_jax.recording.smoothing import local_polynomial, smoothed


@pytest.mark.parametrize(("width", "degree", "derivative"), [(5, 3, 0), (15, 3, 1), (41, 2, 2), (101, 2, 0)])
def test_the_filter_is_that_of_scipy_to_rounding_also_at_the_ends(
    width: int, degree: int, derivative: int
) -> None:
    y = np.cumsum(np.random.default_rng(3).standard_normal(300))
    options = {"deriv": derivative, "delta": 0.002}
    expected = np.asarray(scipy.signal.savgol_filter(y, width, degree, **options))
    found = smoothed(y, width, degree, derivative, 0.002)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-11 * np.abs(expected).max())
    weights = local_polynomial(width, degree, derivative, 0.002)[width // 2]
    # scipy returns the weights in reverse order, for a convolution.
    expected = np.asarray(scipy.signal.savgol_coeffs(width, degree, **options))[::-1]
    np.testing.assert_allclose(weights, expected, rtol=0, atol=1e-11 * np.abs(expected).max())


def test_a_signal_of_just_one_width_is_one_polynomial() -> None:
    t = np.arange(7.0)
    np.testing.assert_allclose(smoothed(t**2, 7, 2, 1, 0.5), 2 * t / 0.5, atol=1e-12)
    np.testing.assert_allclose(smoothed(t**2, 7, 1), np.polyval(np.polyfit(t, t**2, 1), t), atol=1e-12)


def test_a_search_does_not_import_scipy_signal() -> None:
    """Its import takes longer than a fit, so it is left to the functions that need it."""
    code = """
import sys
import rotflex_jax as rf
from rotflex_jax.arena.simulator.records import make_record
made = make_record([("coulomb", "hub")], seed=3, seconds=3.0, fs=200.0)
parts = rf.Recording(u=made["u"], y=made["y"], Ts=made["Ts"]).split(0.6)
before = "scipy.signal" in sys.modules
rf.discover(rf.joints.paper(), *parts, candidates=[], rounds=0)
print(before, "scipy.signal" in sys.modules)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["False", "False"]
