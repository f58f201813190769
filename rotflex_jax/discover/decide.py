"""Held-out likelihood decides, and it may decide for a set.

Two candidates whose held-out log-likelihoods differ by less than their scatter over half-second blocks
are reported together; a richer effect must beat the simpler one that it contains beyond doubt.
"""

import dataclasses

import numpy as np

from rotflex_jax.discover.heldout import Away, Trial, held_out, in_blocks
from rotflex_jax.effects import CATALOG
from rotflex_jax.fit.residuals import Data

# An effect must gain this on held-out data [nat], beyond this many deviations of the block gains, and
# this on the training data after half a log N per number that it needs, beyond as many deviations.
HELD_OUT_NATS, HELD_OUT_Z, TRAIN_NATS, TRAIN_Z = 5.0, 1.5, 8.0, 2.0
# Mean log error of free runs over short windows: near the sensor noise it may rise by no more than the
# first, elsewhere it must fall by the second.
WINDOWS_WORSE, WINDOWS_BETTER = 0.02, 0.01
# Two effects are told apart by this many deviations of their paired block differences, or by free runs
# over short windows whose errors differ by more than this (mean log ratio).
SEPARATE_Z, WINDOWS_APART = 2.0, 0.1


def lead(a: np.ndarray, b: np.ndarray) -> tuple[float, float]:
    """By how many nats blocks `a` lead blocks `b`, and how many deviations that is."""
    d = a - b
    spread = float(np.std(d, ddof=1)) * np.sqrt(len(d)) if len(d) > 1 else np.inf
    return float(d.sum()), float(d.sum()) / max(spread, 1e-12)


def describe(trial: Trial, base: Trial, data: Data) -> str:
    """One line: what a trial gained."""
    assert trial.place
    nats, z = lead(trial.blocks, base.blocks)
    train, train_z = _trained_lead(trial, base, data)
    gain = np.exp(-_change(trial, base))
    return (
        f"{trial.place[0]} at {trial.place[1]}: {nats:.0f} nats on held-out data (z {z:.1f}), {train:.0f} "
        f"on training data (z {train_z:.1f}), free runs {gain:.2f} times better"
    )


def _trained_lead(a: Trial, b: Trial, data: Data) -> tuple[float, float]:
    return lead(in_blocks(a.hypothesis.densities, data), in_blocks(b.hypothesis.densities, data))


def _change(trial: Trial, base: Trial) -> float:
    """Mean log ratio of the errors of short free runs; negative where the trial is better."""
    return float(np.mean(np.log(trial.windows / base.windows)))


def admissible(trial: Trial, base: Trial, data: Data, noise: np.ndarray) -> bool:
    """Whether what the trial adds is there beyond doubt.

    Args:
        trial: The richer hypothesis.
        base: Without what it adds.
        data: Training recordings.
        noise: Deviation of the sensor noise per channel.
    """
    nats, z = lead(trial.blocks, base.blocks)
    train, train_z = _trained_lead(trial, base, data)
    needed = TRAIN_NATS + 0.5 * trial.numbers * np.log(samples_of(data))
    # Likelihood speaks of the next samples, a user of free runs: neither may say no. Far from the sensor
    # noise, an effect that leaves free runs as they were is a way to bend, not a discovery.
    far = bool(np.any(base.windows > 2 * noise))
    limit = -WINDOWS_BETTER if far else WINDOWS_WORSE
    enough = nats > HELD_OUT_NATS and z > HELD_OUT_Z and train > needed and train_z > TRAIN_Z
    return enough and _change(trial, base) < limit


def choose(
    trials: list[Trial], base: Trial, data: Data, noise: np.ndarray
) -> tuple[Trial | None, list[Trial]]:
    """The best admissible trial and those that cannot be told from it; arguments as in `admissible`.

    A rival need not pass every test that the winner passed: where the effect is small, which of the two
    passes is chance. That it gains something, and that nothing tells it from the winner, is enough.
    """
    able = [t for t in trials if admissible(t, base, data, noise)]
    if not able:
        return None, []
    winner = max(able, key=lambda t: t.held_out)
    simpler = [t for t in able if _contained(t, winner) and not _clearly(winner, t, base)]
    if simpler:
        winner = max(simpler, key=lambda t: t.held_out)
    rivals = [
        t for t in trials if t is not winner and not _contained(winner, t) and not _contained(t, winner)
    ]
    gains = [t for t in rivals if t.held_out > base.held_out and _trained_lead(t, base, data)[0] > 0]
    return winner, [t for t in gains if not told_apart(winner, t, data)]


def on_equal_terms(away: Away, trials: list[Trial]) -> list[Trial]:
    """Trials of which a simpler law may begin in the held-out first states of a richer one that does better.

    The search for these states may end in different places, which is not what laws should be told by.
    """
    out = []
    for t in trials:
        richer = [r for r in trials if _contained(t, r) and r.held_out > t.held_out]
        if richer:
            best = max(richer, key=lambda r: r.held_out)
            again = held_out(away, t.hypothesis, best)
            t = max(t, dataclasses.replace(again, place=t.place, numbers=t.numbers), key=lambda x: x.held_out)
        out.append(t)
    return out


def told_apart(winner: Trial, rival: Trial, data: Data) -> bool:
    """Whether all recordings together, block by block, prefer the winner beyond doubt, or free runs do."""
    if _change(rival, winner) > WINDOWS_APART:
        return True
    a, b = (np.concatenate([t.blocks, in_blocks(t.hypothesis.densities, data)]) for t in (winner, rival))
    return lead(a, b)[1] >= SEPARATE_Z


def _contained(small: Trial, large: Trial) -> bool:
    """Whether `large` has the effect of `small` as a special case."""
    assert small.place and large.place
    return small.place[1] == large.place[1] and small.place[0] in CATALOG[large.place[0]].contains


def _clearly(rich: Trial, simple: Trial, base: Trial) -> bool:
    """Whether the richer effect earns its extra numbers on held-out and on training data."""
    nats, z = lead(rich.blocks, simple.blocks)
    train = rich.hypothesis.log_likelihood - simple.hypothesis.log_likelihood
    share = nats / max(lead(rich.blocks, base.blocks)[0], 1e-9)
    return nats > 10 and z > 2.5 and train > 20 and share > 0.003


def samples_of(data: Data) -> float:
    """Numbers measured."""
    return float(np.sum(data.seen)) * data.y.shape[-1]
