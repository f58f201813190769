"""The transform between unconstrained coordinates and physical values: one to one, and within all bounds."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from rotflex_jax.cli.terminal import estimate_line
from rotflex_jax.parameters import Estimate, Specification, Transform, parameter
from rotflex_jax.runtime.xla import double_precision

FREE = Specification(unit="N m", typical=0.02)
POSITIVE = Specification(unit="kg m^2", typical=0.002, lower=0.0)
RAISED = Specification(unit="ohm", typical=2.6, lower=0.5)
BOXED = Specification(unit="rad", typical=1.0, lower=-0.5, upper=3.0)
CAPPED = Specification(unit="V", typical=1.0, upper=5.0)
ALL = (FREE, POSITIVE, RAISED, BOXED, CAPPED)


def constrain(specs, z):
    with double_precision():
        return np.asarray(Transform.of(specs).constrain(jnp.asarray(z, float)))


def inside(spec: Specification) -> st.SearchStrategy[float]:
    """Values away from the bounds, where the inverse is exact."""
    if math.isfinite(spec.lower) and math.isfinite(spec.upper):
        span = spec.upper - spec.lower
        return st.floats(spec.lower + 0.01 * span, spec.upper - 0.01 * span)
    if math.isfinite(spec.lower):
        return st.floats(-2, 6).map(lambda k: spec.lower + spec.typical * 10**k)
    if math.isfinite(spec.upper):
        return st.floats(-2, 6).map(lambda k: spec.upper - spec.typical * 10**k)
    return st.floats(-1e4, 1e4).map(lambda k: spec.typical * k)


@settings(deadline=None, max_examples=60, derandomize=True)
@given(st.tuples(*map(inside, ALL)))
def test_there_and_back(p):
    z = Transform.of(ALL).unconstrain(np.array(p))
    np.testing.assert_allclose(constrain(ALL, z), p, rtol=1e-9, atol=1e-12)


@settings(deadline=None, max_examples=60, derandomize=True)
@given(st.lists(st.floats(-1e6, 1e6), min_size=len(ALL), max_size=len(ALL)))
def test_bounds_are_never_left(z):
    for p in (constrain(ALL, z), Transform.of(ALL).physical(np.array(z))[0]):
        assert np.isfinite(p).all()
        for value, spec in zip(p, ALL, strict=True):
            assert spec.lower <= value <= spec.upper


@settings(deadline=None, max_examples=40, derandomize=True)
@given(st.lists(st.floats(-50, 50), min_size=len(ALL), max_size=len(ALL)))
def test_physical_is_constrain_with_its_derivative(z):
    transform, z = Transform.of(ALL), np.array(z)
    with double_precision():
        point = jnp.asarray(z)
        p, slope = jax.jvp(transform.constrain, (point,), (jnp.ones_like(point),))
    mine, its_slope = transform.physical(z)
    np.testing.assert_allclose(mine, p, rtol=1e-12, atol=1e-15)
    np.testing.assert_allclose(its_slope, slope, rtol=1e-10, atol=1e-18)


def test_closed_forms():
    """p is typical z, lower + exp(z), upper - exp(z) or, with both bounds, a logistic curve."""
    z = np.array([1.5, np.log(2.0), np.log(2.0), np.log(0.5), np.log(2.0)])
    np.testing.assert_allclose(constrain(ALL, z), [0.03, 2.0, 2.5, -0.5 + 3.5 / 3, 3.0], rtol=1e-12)
    # The inverse, near the bound of 0.5.
    near = Transform.of([RAISED]).unconstrain(np.array([0.6]))
    np.testing.assert_allclose(near, np.log(0.1), rtol=1e-12)


def test_several_sets_side_by_side():
    transform, z = Transform.of(ALL), np.random.default_rng(0).normal(size=(2, 3, len(ALL)))
    rows = np.array([[transform.physical(row) for row in block] for block in z])
    together = np.stack(transform.physical(z), axis=2)
    np.testing.assert_array_equal(together, rows)


def test_a_value_on_its_bound_starts_where_it_can_move():
    specs = (POSITIVE, BOXED, BOXED, CAPPED)
    z = Transform.of(specs).unconstrain(np.array([0.0, -0.5, 3.0, 5.0]))
    p, slope = Transform.of(specs).physical(z)
    assert 0 < p[0] <= 1e-3 * POSITIVE.typical * (1 + 1e-9)
    np.testing.assert_allclose(p[1:], [-0.5, 3.0, 5.0], atol=0.004)
    assert p[3] < 5.0
    assert (slope != 0).all()


def test_single_precision_stays_single():
    p = Transform.of(ALL).constrain(jnp.zeros(len(ALL), jnp.float32))
    assert p.dtype == jnp.float32


def test_the_typical_size_follows_the_default():
    made = [parameter(d, unit="V").metadata["parameter"].typical for d in (0.25, -3.0, 0.0, None)]
    assert made == [0.25, 3.0, 1.0, 1.0]


@pytest.mark.parametrize("free", [True, False])
def test_an_estimate_says_what_it_is(free):
    nan = float("nan")
    std, ci = (0.1, (1.8, 2.2)) if free else (nan, (nan, nan))
    estimate = Estimate("hub.coulomb.level", 2.0, std, ci, "N m", free=free)
    assert ("held" in str(estimate)) is not free
    assert str(estimate).startswith(f"hub.coulomb.level = {'2.00' if free else '2'} N m")
    told = estimate.to_dict()
    assert told == {
        "value": 2.0,
        "std": 0.1 if free else None,
        "ci95": [1.8, 2.2] if free else None,
        "unit": "N m",
    }


@pytest.mark.parametrize(
    ("value", "std", "shown"),
    [
        (1.20012, 2e-5, "1.200120 N m/rad  [1.200080, 1.200160]"),
        (1.25, 0.1, "1.25 N m/rad  [1.05, 1.45]"),
        (12.3, 0.3, "12.30 N m/rad  [11.70, 12.90]"),
        (-431.2, 20.0, "-431 N m/rad  [-471, -391]"),
        (2.5e-6, 1e-8, "2.500e-06 N m/rad  [2.480e-06, 2.520e-06]"),
        (1.20012, 0.0, "1.20012 N m/rad  [1.20012, 1.20012]"),
    ],
)
def test_value_and_bounds_have_as_many_digits_as_the_interval_is_worth(value, std, shown):
    ci = (value - 2 * std, value + 2 * std)
    estimate = Estimate("joint.spring.stiffness", value, std, ci, "N m/rad")
    assert str(estimate) == f"joint.spring.stiffness = {shown}"
    assert estimate_line("stiffness", estimate).startswith(f"stiffness = {shown.split('  ')[0]}   95 %: ")


@pytest.mark.parametrize(("value", "word"), [(0.0, "lower"), (10.0, "upper"), (5.0, "")])
def test_an_estimate_tells_that_it_is_at_a_bound(value, word):
    spec = Specification(unit="", typical=1.0, lower=0.0, upper=10.0)
    note = Estimate.of("x", value, 0.1, spec).note
    assert note == (f"at its {word} bound" if word else "")


@pytest.mark.parametrize(("std", "near"), [(0.002, False), (0.004, True)])
def test_an_estimate_near_a_bound_is_at_it_if_its_interval_includes_the_bound(std, near):
    """At 0.005 from the bound, 1.96 standard deviations are 0.0039 and 0.0078."""
    spec = Specification(unit="", typical=1.0, lower=0.0)
    assert Estimate.of("x", 0.005, std, spec).note == ("at its lower bound" if near else "")


@pytest.mark.parametrize(("value", "healthy"), [(-0.01, False), (0.0, True), (1.0, True), (1.01, False)])
def test_an_estimate_outside_its_physical_range_on_either_side_says_so(value, healthy):
    spec = Specification(unit="", typical=1.0, physical=(0.0, 1.0))
    assert Estimate.of("x", value, 0.1, spec).note == ("" if healthy else "outside its physical range")
