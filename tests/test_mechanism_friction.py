"""Dry friction over one step, against motion from event to event and a search over all modes."""

import functools
import itertools
from collections.abc import Callable
from typing import Any

import jax
import numpy as np
import pytest

from rotflex_jax.mechanism.friction import (
    all_slide,
    at_rest,
    coupled_contacts,
    independent_contacts,
    limited,
    sliding_torques,
    solve_masked,
)
from rotflex_jax.mechanism.gear import crossing_time
from rotflex_jax.runtime.xla import double_precision

CASES = 400


def run(function: Callable[..., Any], *arguments: Any) -> Any:
    """A compiled function in double precision; arrays of NumPy."""
    with double_precision():
        return jax.tree.map(np.asarray, jax.jit(function)(*(np.asarray(a) for a in arguments)))


def draws(rng: np.random.Generator, k: int) -> tuple[np.ndarray, ...]:
    """Speeds at the start, speeds at the end without friction, levels, (k, CASES).

    Some speeds at the start and some levels are zero.
    """
    v0, free = rng.normal(size=(2, k, CASES))
    up, down = rng.uniform(0.1, 1.0, size=(2, k, CASES))
    v0[rng.random(v0.shape) < 0.3] = 0.0
    none = rng.random(up.shape) < 0.1
    up[none] = down[none] = 0.0
    return v0, free, up, down


def moved(v0: float, free: float, stop: float, up: float, down: float) -> tuple[float, float | None, bool]:
    """Speed after a step of length one under a constant drive, time of its first zero, whether it rests."""
    push = free - v0
    if v0 != 0:
        way = np.sign(v0)
        slope = push - way * stop * (up if way > 0 else down)
        if way * (v0 + slope) > 0:
            return v0 + slope, None, False
        begun = -v0 / slope
    else:
        begun = 0.0
    level = stop * (up if push > 0 else down)
    if abs(push) <= level:
        return 0.0, begun, True
    return (1 - begun) * (push - np.sign(push) * level), begun, False


def test_a_contact_alone_moves_from_event_to_event() -> None:
    rng = np.random.default_rng(0)
    v0, free, up, down = (x[0] for x in draws(rng, 1))
    stop = rng.uniform(0.2, 3.0, CASES)
    found = run(independent_contacts, v0, free, stop, up, down)
    rests = 0
    for n in range(CASES):
        end, begun, held = moved(v0[n], free[n], stop[n], up[n], down[n])
        assert found.torque[n] == pytest.approx((end - free[n]) / stop[n], abs=1e-12)
        assert bool(found.crossed[n]) is (begun is not None)
        if begun is not None:
            assert found.t[n] == pytest.approx(begun, abs=1e-12)
        mean, drive = (up[n] + down[n]) / 2, (free[n] - v0[n]) / stop[n]
        if begun is None or mean == 0:
            assert found.holds[n] == 0
        else:
            # 1 at rest; it decreases to zero while the drive exceeds the level by up to one mean level.
            over = (abs(drive) - (up[n] if drive > 0 else down[n])) / mean
            assert found.holds[n] == pytest.approx(np.clip(1 - over, 0, 1), abs=1e-12)
        rests += held
    assert 20 < rests < CASES / 2


@pytest.mark.parametrize("free", [0.0, 1e-20, -1e-170, 1e-300, 5e-324])
def test_a_contact_at_rest_without_a_drive_has_derivatives(free: float) -> None:
    """At rest, friction cancels a small drive: its torque is `-free / stop`, the levels do not matter.

    From sample to sample, the speed of a machine at rest falls by a factor of 1e16, through numbers whose
    square is zero.
    """

    def torque(v0, free, stop, up, down):
        return independent_contacts(v0, free, stop, up, down).torque

    slopes = run(jax.grad(torque, argnums=(0, 1, 2, 3, 4)), 0.0, free, 2.0, 0.3, 0.4)
    np.testing.assert_allclose(slopes, [0.0, -0.5, 0.0, 0.0, 0.0], atol=1e-20)


@pytest.mark.parametrize("speed", [0.0, 1e-20, -1e-170, 5e-324])
def test_a_rotor_that_friction_holds_in_flight_has_derivatives(speed: float) -> None:
    """The time at which it would reach a stop is computed from its speed, and is not used."""
    slopes = run(jax.grad(crossing_time, argnums=(0, 1, 2)), -0.1, speed, -speed)
    assert np.all(np.isfinite(slopes))


@pytest.mark.parametrize("side", [0.999, 1.001])
def test_a_speed_is_zero_to_64_units_of_rounding(side: float) -> None:
    """The rounding is that of the speeds that drive and friction cause in a step."""
    free, stop, up, down = -2.0, 3.0, 0.4, 0.7
    v0 = side * 64 * np.finfo(float).eps * (2.0 + 3.0 * 1.1)
    for sign in (1, -1):
        assert bool(run(at_rest, sign * v0, free, stop, up, down)) is (side < 1)


def test_torques_are_limited_to_their_levels_with_whole_derivatives() -> None:
    slopes = jax.grad(limited, argnums=(0, 1, 2))
    for f, expected in ((2.0, (0, 0, 1)), (0.2, (1, 0, 0)), (-0.2, (1, 0, 0)), (-2.0, (0, -1, 0))):
        assert run(limited, f, 0.5, 0.9) == np.clip(f, -0.5, 0.9)
        assert run(slopes, f, 0.5, 0.9) == expected
    assert run(slopes, 0.0, 0.0, 0.0) == (1, 0, 0)


def positive_definite(rng: np.random.Generator, k: int, rank: int) -> np.ndarray:
    """Speeds of k contacts caused by a torque at each; the mechanism has `rank` coordinates."""
    ports = rng.normal(size=(k, rank))
    return ports @ ports.T + (0.3 * np.eye(k) if rank >= k else 0)


@pytest.mark.parametrize("k", [1, 2, 3])
@pytest.mark.parametrize("many", [False, True], ids=["one matrix", "a matrix each"])
def test_masked_rows_are_solved_and_others_kept(k: int, many: bool) -> None:
    rng = np.random.default_rng(k)
    shape = (k, k, CASES) if many else (k, k)
    matrix = np.broadcast_to(positive_definite(rng, k, k)[:, :, *[None] * many], shape).copy()
    matrix *= rng.uniform(0.5, 2.0, shape[2:])
    mask = rng.random((k, CASES)) < 0.6
    rhs, other = rng.normal(size=(2, k, CASES))
    found = run(solve_masked, matrix, mask, rhs, other)
    for n in range(CASES):
        A, m = (matrix[..., n] if many else matrix), mask[:, n]
        expected = other[:, n].copy()
        expected[m] = np.linalg.solve(A[np.ix_(m, m)], rhs[m, n] - A[np.ix_(m, ~m)] @ other[~m, n])
        np.testing.assert_allclose(found[:, n], expected, rtol=1e-7, atol=1e-8)


@pytest.mark.parametrize("size", [1e-6, 1.0, 1e6])
def test_contacts_that_share_one_motion_share_the_torque(size: float) -> None:
    """A ridge of 1e-10 of the largest entry gives the solution of least norm, up to amplified rounding."""
    matrix, mask = np.full((2, 2), 3.0 * size), np.ones((2, 1), bool)
    found = run(solve_masked, matrix, mask, np.full((2, 1), 6.0 * size), np.zeros((2, 1)))
    np.testing.assert_allclose(found, 1.0, rtol=1e-4)


def ends_by_modes(
    v0: np.ndarray, free: np.ndarray, stop: np.ndarray, up: np.ndarray, down: np.ndarray
) -> np.ndarray:
    """Speeds at the end of contacts that slide on or are at rest, by trying every mode of those at rest."""
    k, slides = len(v0), v0 != 0
    for modes in itertools.product((-1, 0, 1), repeat=k):
        m = np.where(slides, np.sign(v0), modes).astype(int)
        if any(slides) and tuple(m[slides]) != tuple(np.array(modes)[slides]):
            continue
        f = np.where(m > 0, -up, np.where(m < 0, down, 0.0))
        held = m == 0
        A = stop[np.ix_(held, held)]
        f[held] = -np.linalg.lstsq(A, (free + stop @ f)[held], rcond=1e-12)[0]
        end = free + stop @ f
        within = bool(np.all((f <= down + 1e-12) & (f >= -up - 1e-12)))
        if within and np.all(m[~held] * end[~held] > 0) and np.allclose(end[held], 0, atol=1e-9):
            return end
    raise AssertionError("no mode fits")


@pytest.mark.parametrize(("k", "missed"), [(2, 0.0), (3, 0.02)])
def test_coupled_contacts_take_the_one_mode_that_fits(k: int, missed: float) -> None:
    """Each is at rest, or so fast that it keeps its direction; some of those at rest break away.

    If three break away together, one may be released although the friction of the others would hold it. This
    happens in at most 2 % of the cases.
    """
    rng = np.random.default_rng(11 * k)
    stop = positive_definite(rng, k, k)
    rest = rng.random((k, CASES)) < 0.6
    speed = 30 * rng.choice([-1, 1], (k, CASES))
    v0 = np.where(rest, 0.0, speed)
    free = v0 + rng.normal(size=(k, CASES)) * 2
    up, down = rng.uniform(0.2, 1.5, size=(2, k, CASES))
    found = run(coupled_contacts, v0, free, stop, up, down)
    ends = free + stop @ found.torque
    expected = np.column_stack(
        [ends_by_modes(v0[:, n], free[:, n], stop, up[:, n], down[:, n]) for n in range(CASES)]
    )
    right = np.isclose(ends, expected, atol=1e-8).all(axis=0)
    assert np.mean(~right) <= missed
    at_zero = (np.abs(expected) < 1e-9) & right
    assert 0.2 < at_zero[rest].mean() < 0.8
    np.testing.assert_array_equal(found.crossed, rest)
    assert (found.holds[at_zero] == 1).all() and (found.holds[~rest] == 0).all()
    assert (found.t[rest] == 0).all()


def test_a_single_pass_lets_no_contact_go() -> None:
    """The result is the torques that would hold all contacts, each limited to its level."""
    rng = np.random.default_rng(7)
    stop, free = positive_definite(rng, 2, 2), rng.normal(size=(2, CASES))
    up, down = rng.uniform(0.2, 1.5, size=(2, 2, CASES))
    once = functools.partial(coupled_contacts, passes=1)
    found = run(once, np.zeros((2, CASES)), free, stop, up, down)
    np.testing.assert_allclose(found.torque, np.clip(-np.linalg.solve(stop, free), -up, down), atol=1e-9)


def test_three_contacts_on_two_coordinates_rest_together() -> None:
    """The torques are not unique, but all speeds are zero and all torques are within their levels."""
    rng = np.random.default_rng(5)
    stop = positive_definite(rng, 3, 2)
    free = stop @ rng.uniform(-0.3, 0.3, (3, CASES))
    levels = np.full((3, CASES), 5.0)
    found = run(coupled_contacts, np.zeros((3, CASES)), free, stop, levels, levels)
    np.testing.assert_allclose(free + stop @ found.torque, 0.0, atol=1e-9)
    assert (found.holds == 1).all()
    assert (np.abs(found.torque) <= 5).all()


def test_contacts_that_do_not_touch_are_as_if_alone() -> None:
    """They slide, stop, break away or reverse in the step."""
    rng = np.random.default_rng(6)
    v0, free, up, down = draws(rng, 3)
    own = rng.uniform(0.2, 3.0, 3)
    together = run(coupled_contacts, v0, free, np.diag(own), up, down)
    alone = run(independent_contacts, v0, free, np.repeat(own[:, None], CASES, 1), up, down)
    for a, b in zip(together, alone, strict=True):
        np.testing.assert_allclose(a, b, atol=1e-9)


@pytest.mark.parametrize("k", [1, 2, 3])
def test_contacts_that_all_slide_need_no_elimination(k: int) -> None:
    """Where `all_slide` holds, the full law gives the same torques, and no contact stops."""
    rng = np.random.default_rng(10 + k)
    v0, _, up, down = draws(rng, k)
    free, up, down = v0 + 0.3 * rng.normal(size=v0.shape), 0.3 * up, 0.3 * down
    L = rng.normal(size=(k, k))
    stop = L @ L.T + 0.2 * np.eye(k)
    slide = run(all_slide, v0, free, stop, up, down)
    found = run(coupled_contacts, v0, free, stop, up, down)
    torque = run(sliding_torques, v0, up, down)
    assert 0.02 < np.mean(slide) < 0.7
    np.testing.assert_allclose(found.torque[:, slide], torque[:, slide], rtol=1e-14)
    assert not found.crossed[:, slide].any()
    # Conversely, `all_slide` holds where all contacts keep their direction in the full law and each alone.
    together, alone = free + stop @ found.torque, free + np.diag(stop)[:, None] * torque
    keeps = np.all((v0 * together > 0) & (v0 * alone > 0) & ~found.crossed, axis=0)
    assert slide[keeps].all()
