"""Restarts of a fit: when they are needed, where they begin, and when there are enough."""

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.stats import norm

from rotflex_jax.optimise.restarts import FAR, MISSING, NEAR, enough, misses_something, moved_by_chance

# Standard deviation of a standard normal number that is limited to -2 to 2.
CUT = np.sqrt(quad(lambda n: min(abs(n), 2.0) ** 2 * norm.pdf(n), -9, 9)[0])


@pytest.mark.parametrize("distance", [NEAR, FAR])
def test_parameters_move_by_a_share_of_themselves(distance):
    z, bounded = np.array([-3.0, 5.0, 0.0]), np.array([True, False, False])
    random = np.random.default_rng(1)
    moved = np.array([moved_by_chance(z, bounded, distance, random) for _ in range(4000)]) - z
    # The coordinate of a bounded parameter has size one; a coordinate at zero is given the size 0.3.
    expected = distance * CUT * np.array([1.0, 5.0, 0.3])
    np.testing.assert_allclose(moved.std(axis=0), expected, rtol=0.05)
    assert np.all(np.abs(moved.mean(axis=0)) < 0.1 * expected)
    assert np.all(np.abs(moved) <= 2 * distance * np.array([1.0, 5.0, 0.3]) + 1e-12)


def test_three_ends_with_the_least_cost_are_enough():
    assert not enough([1.0], 0.5) and not enough([1.0, 1.4], 0.5)
    assert enough([9.0, 1.4, 1.0, 1.5], 0.5)
    assert not enough([9.0, 1.4, 1.0, 1.5, 0.2], 0.5)  # a lower cost was found later
    assert not enough([np.inf, np.inf, 1.0], 0.5)
    assert not enough([np.inf] * 3, 0.5)  # all have diverged


def test_errors_far_above_the_noise_ask_for_restarts():
    noise = np.array([1.0, 10.0])
    assert not misses_something(np.array([1.0, 1.1 * 10.0]), noise)
    assert misses_something(np.array([1.0, 1.1 * MISSING * 10.0]), noise)
    assert misses_something(np.array([np.nan, 10.0]), noise)
