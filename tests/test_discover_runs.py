"""An offset belongs to one run, unless another run has the same offset."""

import dataclasses

import numpy as np
import pytest
from test_discover_final_fit import OFFSET, run, short_runs_miss

import rotflex_jax as rf
from rotflex_jax.discover.result import KnownRuns
from rotflex_jax.effects import Coulomb
from rotflex_jax.errors import InputError
from rotflex_jax.recording.recording import digest_of_recordings, joined, of_one_run


@pytest.fixture(scope="module")
def parts():
    """Three parts of one run with an offset, and another run of the same machine without it."""
    first, rest = run(0.06, 0.04, 0, N=4500).split(1 / 3)
    return first, *rest.split(0.5), run(0.06, 0.0, 1)


@pytest.fixture(scope="module")
def found(parts):
    """A search on two parts of one run, tested on its third part and on another run."""
    arm = rf.joints.rotary_arm(flexible=False) + Coulomb("hub", level=0.03)
    return rf.discover(arm, parts[0], parts[1], test=parts[2:], candidates=[], rounds=0)


def test_parts_know_their_run(parts):
    first, second, third, other = parts
    assert of_one_run(first, second) and of_one_run(third, second) and of_one_run(other, other)
    assert not of_one_run(first, other) and not of_one_run(other, third)
    # Two runs that both begin at rest are not one run.
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
    # The order does not matter, and a part may refer to the part before it alone.
    for order in ([second, first], [first, third, second], [third, second, first]):
        (run,) = joined(order)
        assert run.start == first.start and sum(r.N for r in order) == run.N
    after = dataclasses.replace(third, continues=second)
    assert [r.N for r in joined([first, second, after])] == [first.N + second.N + third.N]
    # Not across a gap, and not if constants, channels, units or sampling periods differ.
    changes = {"constants": {"J": 1.0}, "channels": ("phi",), "units": ("deg",), "Ts": 2 * second.Ts}
    others = [
        dataclasses.replace(second, **{name: value}, resolution=None) for name, value in changes.items()
    ]
    two = dataclasses.replace(second, y=np.tile(second.y, 2), channels=("theta", "phi"), units=("rad", "rad"))
    for apart in ([first, third], *([first, other] for other in (*others, two))):
        assert all(a is b for a, b in zip(joined(apart), apart, strict=True))


def test_parts_of_one_run_share_its_offset_in_the_last_fit(parts):
    """Friction is trusted at half of its true level, so the search ends unexplained and has a final fit."""
    arm = (rf.joints.rotary_arm(flexible=False) + Coulomb("hub", level=0.03)).trust("hub.coulomb.level")
    first, second, third, other = parts
    found = rf.discover(arm, first, second, test=[third, other], candidates=[], rounds=0)
    last = found.final_fit
    assert last is not None and [r.N for r in last.recordings] == [first.N + second.N]
    assert [len(each) for each in last.fit.local.values()] == [1] * len(last.fit.local) != []
    assert last.fit.data == digest_of_recordings(last.recordings)
    # Models of all parts of this run have the offset, the model of the other run has none.
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
    # A part of no recording gets the offset of the nearest one.
    assert [known.index(second.slice(a, a + 600)) for a in (100, second.N - 700)] == [0, 1]


def test_another_run_starts_without_the_offset_of_one(found, parts):
    *_, third, other = parts
    value = found.model.mechanism.named_values
    assert value[OFFSET] == pytest.approx(0.04, abs=0.004)
    assert found.offsets == (("voltage_offset", "input"),)
    assert OFFSET in found.model_of(third).mechanism.parameter_names
    bare = found.model_of(other)
    assert OFFSET not in bare.mechanism.parameter_names
    # The reported errors are those of these models.
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


def test_a_torque_is_learned_only_beside_validation_data(found, tmp_path):
    alone = dataclasses.replace(found, validation=found.train)
    with pytest.raises(InputError, match="needs validation data"):
        alone.learned_torque()
    said: list[str] = []
    with pytest.raises(InputError, match="needs validation data"):
        alone.explanation(learned=True, progress=said.append)
    with pytest.raises(InputError, match="needs validation data"):
        alone.report(tmp_path / "report", learned=True, progress=said.append)
    assert not said and not (tmp_path / "report").exists()  # refused before any work
