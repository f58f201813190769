"""What a search compiles: a few programs, none a second time, and none for other numbers."""

from collections.abc import Callable

import numpy as np

import rotflex_jax as rf
import rotflex_jax.effects as fx
from rotflex_jax.arena.simulator.records import make_record
from rotflex_jax.discover import Discovery
from rotflex_jax.runtime.persistent_jit import program_counts, release_programs

CANDIDATES = [(fx.Coulomb, "hub"), (fx.CubicSpring, "joint")]
# A structure that is fitted has a run and its slopes, one that is reported four programs for its free runs;
# a score has one program of the run and one of each family of candidates.
FITTED, REPORTED, SCORED = 2, 4, 3


def searched(seed: int, samples: int = 1500) -> Discovery:
    made = make_record([("coulomb", "hub")], seed=seed, seconds=3.0, fs=500.0)
    whole = rf.Recording(u=made["u"][:samples], y=made["y"][:samples], Ts=made["Ts"])
    train, test = whole.split(0.6)
    return rf.discover(rf.joints.paper(), train, test, candidates=CANDIDATES)


def made_by(search: Callable[[], Discovery]) -> tuple[int, Discovery]:
    """How many programs a search made, compiled or loaded, and its result."""
    before = program_counts()
    found = search()
    after = program_counts()
    return after.compiled + after.loaded - before.compiled - before.loaded, found


def test_a_search_makes_few_programs_and_each_once() -> None:
    release_programs()
    first, found = made_by(lambda: searched(2010))
    assert [(r.effect, r.port) for r in found.rounds] == [("coulomb", "hub")]
    # Fitted: the baseline, with either candidate, with both. Scored: the baseline and the first effect.
    assert 0 < first <= 4 * FITTED + 2 * REPORTED + 2 * SCORED + 2
    again, same = made_by(lambda: searched(2010))
    assert again == 0
    np.testing.assert_array_equal(same.final.model.mechanism.values, found.final.model.mechanism.values)


def test_another_length_makes_no_more() -> None:
    """Of the same recording a part, which has another number of samples and fewer windows."""
    searched(2010)
    others, found = made_by(lambda: searched(2010, samples=1310))
    assert [(r.effect, r.port) for r in found.rounds] == [("coulomb", "hub")]
    assert others == 0


def test_other_numbers_make_no_more() -> None:
    """Another recording of the same length, on which the same structures are tried."""
    searched(2010)
    others, found = made_by(lambda: searched(2011))
    assert [(r.effect, r.port) for r in found.rounds] == [("coulomb", "hub")]
    assert others <= FITTED + REPORTED
