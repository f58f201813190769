"""Recordings prepared for fits and searches."""

import numpy as np
import pytest

import rotflex_jax as rf
from rotflex_jax.fit.dataset import padded_length, prepare

MODEL = rf.Model(rf.joints.paper())


def recording(N: int, Ts: float, size: float = 1.0) -> rf.Recording:
    u = size * np.sin(np.arange(N) / 20)
    y = rf.simulate(MODEL.mechanism, u, Ts) + 1e-3 * np.random.default_rng(N).normal(size=(N, 2))
    return rf.Recording(u=u, y=y, Ts=Ts, accept=("units",))


def test_shorter_recordings_are_padded_with_samples_that_do_not_count():
    both = recording(300, 0.004), recording(200, 0.005)
    data = prepare(MODEL, both, length=padded_length(both)).data
    assert data.y.shape == (2, 320, 2) and data.u.shape == data.seen.shape == (2, 320)
    np.testing.assert_array_equal(data.seen.sum(axis=1), [300, 200])
    np.testing.assert_array_equal(data.Ts, [0.004, 0.005])
    for r, u, y, seen in zip(both, data.u, data.y, data.seen > 0, strict=True):
        np.testing.assert_array_equal(u[seen], r.u)
        np.testing.assert_array_equal(y[seen], r.y)
        assert not y[~seen].any()


def test_noise_and_torque_are_those_of_the_recordings_or_taken_over():
    small, large = recording(900, 0.004), recording(900, 0.004, size=3.0)
    first = prepare(MODEL, [small], noise_of=[large])
    np.testing.assert_allclose(first.noise, 1e-3, rtol=0.15)
    other = prepare(MODEL, [large])
    assert other.torque_scale == pytest.approx(3 * first.torque_scale)
    assert first.first_states.shape == other.first_states.shape == (1, 4)
    like = prepare(MODEL, [large], like=first)
    assert like.noise is first.noise and like.torque_scale == first.torque_scale
    np.testing.assert_array_equal(like.first_states, other.first_states)


@pytest.mark.parametrize(("longest", "length"), [(1000, 1024), (1024, 1024), (1025, 1152), (1152, 1152)])
def test_lengths_come_in_eight_steps_to_the_next_power_of_two(longest, length):
    assert padded_length([recording(400, 0.01), recording(longest, 0.01)]) == length


def test_without_a_recording_there_is_nothing_to_prepare():
    assert padded_length([]) == 0
    with pytest.raises(rf.InputError, match="No recording"):
        prepare(MODEL, [])
