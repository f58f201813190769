"""Coloured noise of a sensor is distinguished from errors of the model."""

import dataclasses

import numpy as np
import pytest
import scipy
from spindle import PAIRS, SPINDLE, spun

import rotflex_jax as rf
from rotflex_jax.discover.explanation import _is_white, advice, coloured_noise
from rotflex_jax.discover.tables import next_steps

N, Ts = 3000, 0.004


def ar1(rng: np.random.Generator, a: float, n: int = N) -> np.ndarray:
    return scipy.signal.lfilter([1.0], [1.0, -a], rng.standard_normal(n + 200))[200:]


def driven(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """An input, and a position and a speed that follow it."""
    u = rf.data.excitation.noise(N, Ts, seed=seed)
    speed = scipy.signal.lfilter([0.01], [1.0, -0.99], u)
    return u, np.column_stack([Ts * np.cumsum(speed), speed])


@pytest.mark.parametrize("a", [0.4, 0.9, 0.98])
def test_an_ar1_is_told_with_its_coefficient(a: float) -> None:
    found = []
    for seed in range(20):
        u, motion = driven(seed)
        found.append(coloured_noise(0.01 * ar1(np.random.default_rng(seed), a), motion, u, Ts))
    told = [x for x in found if x is not None]
    assert len(told) >= 17  # each of four tests rejects at most once in 1000
    assert np.mean(told) == pytest.approx(a, abs=0.02)


def beside(x: np.ndarray, known: np.ndarray) -> np.ndarray:
    """The part of a signal that is orthogonal to another one."""
    return x - (x @ known) / (known @ known) * known


# Errors that are no AR(1), or that depend on the motion; each is tested in 10 recordings.
OTHER = {
    "white": lambda rng, u, m: rng.standard_normal(N),
    "an AR(2)": lambda rng, u, m: scipy.signal.lfilter([1], [1, -1.2, 0.7], rng.standard_normal(N)),
    "of the input": lambda rng, u, m: ar1(rng, 0.9) + scipy.signal.lfilter([0.5], [1, -0.9], u / u.std()),
    "of the sign of the speed": lambda rng, u, m: scipy.signal.lfilter(
        [1], [1, -0.9], rng.standard_normal(N) + 0.3 * np.sign(m[:, 1])
    ),
    "of the sign of the speed but not of the speed": lambda rng, u, m: scipy.signal.lfilter(
        [1], [1, -0.9], rng.standard_normal(N) + 0.3 * beside(np.sign(m[:, 1]), m[:, 1])
    ),
    "larger in one direction": lambda rng, u, m: scipy.signal.lfilter(
        [1], [1, -0.9], rng.standard_normal(N) * np.where(m[:, 1] > 0, 1.5, 1.0)
    ),
    "larger where it is fast": lambda rng, u, m: scipy.signal.lfilter(
        [1], [1, -0.9], rng.standard_normal(N) * (0.5 + (m[:, 1] / m[:, 1].std()) ** 2)
    ),
    "with a sine": lambda rng, u, m: ar1(rng, 0.9) + 8 * np.sin(0.3 * np.arange(N)),
    "constant": lambda rng, u, m: np.ones(N),
    "not finite": lambda rng, u, m: np.full(N, np.nan),
}


@pytest.mark.parametrize("kind", OTHER)
def test_what_is_something_else_is_not_told(kind: str) -> None:
    told = 0
    for seed in range(10):
        u, motion = driven(seed)
        e = OTHER[kind](np.random.default_rng(100 + seed), u, motion)
        told += coloured_noise(e, motion, u, Ts) is not None
    assert told <= 1


def test_errors_that_alternate_are_not_white() -> None:
    """Differences of white noise have the correlation -1/2 from one sample to the next."""
    e = np.random.default_rng(1).standard_normal(4000)
    assert _is_white(e) and not _is_white(np.diff(e)) and not _is_white(np.cumsum(e))


def test_short_errors_say_nothing() -> None:
    u, motion = driven(1)
    e = ar1(np.random.default_rng(1), 0.9)
    assert coloured_noise(e[:200], motion[:200], u[:200], Ts) is None and advice({}) == ()


def with_noise(run: rf.Recording, noise: np.ndarray) -> rf.Recording:
    return dataclasses.replace(run, y=run.y + noise[:, None])


@pytest.mark.usefixtures("without_final_fit")
def test_the_next_steps_of_a_verdict_say_so() -> None:
    """They name an AR(1) for a right model with a noisy tacho, and not for a model that lacks friction."""
    joint = SPINDLE + rf.effects.Coulomb(at="shaft")
    parts = with_noise(spun(4000), 0.05 * ar1(np.random.default_rng(5), 0.9, 4000)).split(0.5)
    right = rf.discover(joint, *parts, candidates=PAIRS[1:], rounds=0)
    assert right.verdict == "unexplained"
    steps = next_steps(right)
    assert "free-run errors of tacho (0." in steps[0] and "AR(1)" in steps[0]
    lacking = rf.discover(SPINDLE, *spun(4000).split(0.5), candidates=PAIRS[1:], rounds=0)
    assert lacking.verdict == "unexplained"
    assert not any("AR(1)" in step for step in next_steps(lacking))
