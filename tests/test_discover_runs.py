"""An offset belongs to a run until another run shows the same."""

import dataclasses

import numpy as np
import pytest
from test_discover_final_fit import OFFSET, run, short_runs_miss

import rotflex_jax as rf
from rotflex_jax.discover.result import KnownRuns
from rotflex_jax.effects import Coulomb
from rotflex_jax.recording.recording import digest_of_recordings, joined, of_one_run


@pytest.fixture(scope="module")
def parts():
    """A run with an offset in three parts, and one of the same machine without."""
    first, rest = run(0.06, 0.04, 0, N=4500).split(1 / 3)
    return first, *rest.split(0.5), run(0.06, 0.0, 1)


@pytest.fixture(scope="module")
def found(parts):
    """Learnt from one run, and evaluated on its end and on another one."""
    arm = rf.joints.rotary_arm(flexible=False) + Coulomb("hub", level=0.03)
    return rf.discover(arm, parts[0], parts[1], test=parts[2:], candidates=[], rounds=0)


def test_parts_know_their_run(parts):
    first, second, third, other = parts
    assert of_one_run(first, second) and of_one_run(third, second) and of_one_run(other, other)
    assert not of_one_run(first, other) and not of_one_run(other, third)
    # A common beginning at rest makes no common run.
    N, moving = 200, np.random.default_rng(0).normal(size=(2, 200))
    a, b = (
        rf.Recording(np.r_[np.zeros(N), u], np.r_[np.zeros(N), u][:, None], 0.002, channels=("theta",))
        for u in moving
    )
    assert not of_one_run(a.slice(N, 2 * N), b.slice(N, 2 * N))


def test_parts_that_follow_on_each_other_are_one_recording(parts):
    first, second, third, other = parts
    whole, same = joined([first, other, second])
    assert same is other and whole.N == first.N + second.N and whole.start == first.start
    np.testing.assert_array_equal(whole.y, np.concatenate([first.y, second.y]))
    np.testing.assert_array_equal(whole.u, np.concatenate([first.u, second.u]))
    assert [r.N for r in joined([second, third])] == [second.N + third.N]
    assert joined([second, third])[0].continues is second.continues
    # In whatever order they are given, and where a part knows only the one before it.
    for order in ([second, first], [first, third, second], [third, second, first]):
        (run,) = joined(order)
        assert run.start == first.start and sum(r.N for r in order) == run.N
    after = dataclasses.replace(third, continues=second)
    assert [r.N for r in joined([first, second, after])] == [first.N + second.N + third.N]
    # Not across a gap, and not what is of another machine or measured otherwise.
    changes = {"constants": {"J": 1.0}, "channels": ("phi",), "units": ("deg",), "Ts": 2 * second.Ts}
    others = [
        dataclasses.replace(second, **{name: value}, resolution=None) for name, value in changes.items()
    ]
    two = dataclasses.replace(second, y=np.tile(second.y, 2), channels=("theta", "phi"), units=("rad", "rad"))
    for apart in ([first, third], *([first, other] for other in (*others, two))):
        assert all(a is b for a, b in zip(joined(apart), apart, strict=True))


def test_parts_of_one_run_share_its_offset_in_the_last_fit(parts):
    """Half of the friction is missing and may not be fitted, so the search ends unexplained."""
    arm = (rf.joints.rotary_arm(flexible=False) + Coulomb("hub", level=0.03)).trust("hub.coulomb.level")
    first, second, third, other = parts
    found = rf.discover(arm, first, second, test=[third, other], candidates=[], rounds=0)
    last = found.final_fit
    assert last is not None and [r.N for r in last.recordings] == [first.N + second.N]
    assert [len(each) for each in last.fit.local.values()] == [1] * len(last.fit.local) != []
    assert last.fit.data == digest_of_recordings(last.recordings)
    # Every part of the run knows the offset, no other run does.
    assert [OFFSET in found.model_of(r).mechanism.parameter_names for r in parts] == [True] * 3 + [False]


def test_runs_are_compared_where_validation_has_another_one(parts):
    first, second, third, other = parts
    assert not KnownRuns.of([first], [second, third]).compared
    assert KnownRuns.of([first], [second, other]).compared
    assert KnownRuns.of([first, other], [first, other]).compared
    assert KnownRuns.of([other, first], [second]).index(third) == 1


def test_of_parts_of_one_run_the_one_that_has_a_recording_knows_its_offset(parts):
    first, second, third, other = parts
    known = KnownRuns.of([first, third], [second])
    assert [known.index(r) for r in (first, third, third.slice(200, 900), other)] == [0, 1, 1, None]
    # Where none has it, the one that is nearest.
    assert [known.index(second.slice(a, a + 600)) for a in (100, second.N - 700)] == [0, 1]


def test_another_run_starts_without_the_offset_of_one(found, parts):
    *_, third, other = parts
    value = found.model.mechanism.named_values
    assert value[OFFSET] == pytest.approx(0.04, abs=0.004)
    assert found.offsets == (("voltage_offset", "input"),)
    assert OFFSET in found.model_of(third).mechanism.parameter_names
    bare = found.model_of(other)
    assert OFFSET not in bare.mechanism.parameter_names
    # Reported are the errors of just these models.
    missed = [short_runs_miss(found.model_of(r), r) for r in (third, other)]
    lengths = [r.N for r in (third, other)]
    together = np.sqrt(np.average(np.square(missed), weights=lengths))
    assert found.final.test.windows["theta"] == pytest.approx(together, rel=0.05)
    assert missed[1] < 0.2 * short_runs_miss(found.model, other)
    assert any("seen in one run" in note for note in found.notes)


def test_an_offset_that_two_runs_share_is_the_machine_s(parts):
    arm = rf.joints.rotary_arm(flexible=False) + Coulomb("hub", level=0.03)
    again, unseen = run(0.06, 0.04, 2), run(0.06, 0.04, 3)
    found = rf.discover(arm, parts[0], again, test=unseen, candidates=[], rounds=0)
    assert found.model_of(unseen) == found.model
    assert not any("seen in one run" in note for note in found.notes)
    assert OFFSET in found.model.mechanism.parameter_names
