"""A reversed sign of a channel or the input is refused; right signs and rough parameters are accepted."""

import dataclasses
import functools

import numpy as np
import pytest
import scipy.signal

import rotflex_jax as rf
from rotflex_jax.arena.simulator.records import make_record
from rotflex_jax.fit.plausibility import check_signs, motion

JOINT = rf.Model(rf.joints.paper())


@functools.cache
def recorded(u: float = 1, theta: float = 1, alpha: float = 1, kind: str = "noise") -> rf.Recording:
    """A joint with friction and a voltage offset, by the independent simulator; signs as given."""
    hidden = [("coulomb", "hub"), ("voltage_offset", "input")]
    made = make_record(hidden, kind=kind, seed=107, seconds=8.0, fs=250.0)
    y = made["y"] * np.array([theta, alpha])
    return rf.Recording(u=u * made["u"], y=y, Ts=made["Ts"], channels=("theta", "alpha"))


@pytest.mark.parametrize(
    ("signs", "sentence"),
    [
        ({"theta": -1}, "theta moves against .* negate the column of theta"),
        ({"alpha": -1}, "alpha moves against .* negate the column of alpha"),
        ({"u": -1}, "theta and alpha move against .* negate the input"),
    ],
)
def test_a_sign_turned_round_is_named(signs: dict[str, float], sentence: str) -> None:
    good, bad = recorded(), recorded(**signs)
    for run in (check_signs, rf.fit, rf.many_starts):
        with pytest.raises(rf.InputError, match=sentence):
            run(JOINT, [bad])
    with pytest.raises(rf.InputError, match=sentence):
        rf.discover(JOINT, good, bad)


def test_of_several_recordings_the_one_with_the_wrong_sign_is_named() -> None:
    good, bad = recorded(), recorded(theta=-1)
    with pytest.raises(rf.InputError, match=r"input in recording 2 of 3 .* negate the column of theta there"):
        check_signs(JOINT, [good, bad, good])
    named = dataclasses.replace(bad, source="monday.csv")
    with pytest.raises(rf.InputError, match=r"input in monday\.csv \(correlation"):
        rf.fit(JOINT, [good, named])
    with pytest.raises(rf.InputError, match=r"under this input \(correlation"):
        check_signs(JOINT, [bad, named])


@pytest.mark.parametrize("kind", ["noise", "multisine", "prbs", "steps", "sweep"])
def test_right_signs_pass_whatever_the_input(kind: str) -> None:
    check_signs(JOINT, [recorded(kind=kind)])


def test_rough_numbers_pass() -> None:
    """Every parameter is wrong by a random factor from 1/2 to 2."""
    rng = np.random.default_rng(5)
    for _ in range(20):
        values = JOINT.mechanism.values * 2.0 ** rng.uniform(-1, 1, len(JOINT.mechanism.values))
        check_signs(dataclasses.replace(JOINT, mechanism=JOINT.mechanism.with_values(values)), [recorded()])


@pytest.mark.parametrize(("Ts", "width"), [(0.004, 9), (0.001, 31), (0.02, 5)])
def test_positions_and_speeds_are_those_of_a_cubic_over_30_ms(Ts: float, width: int) -> None:
    """Over an even number of sampling periods, at least four."""
    y = np.random.default_rng(3).standard_normal((200, 2))
    found = motion(JOINT.mechanism, y, Ts)
    inside = slice(width, -width)
    for port, of in (("hub", y[:, 0]), ("joint", y[:, 1]), ("arm", y.sum(axis=1))):
        for order, values in enumerate(found[port]):
            expected = scipy.signal.savgol_filter(of, width, 3, deriv=order, delta=Ts)
            np.testing.assert_allclose(values[inside], expected[inside], rtol=1e-6, atol=1e-9)
