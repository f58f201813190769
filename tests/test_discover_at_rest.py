"""A machine that friction holds at rest: the likeliest model without friction is one that does not move."""

import numpy as np
import pytest

import rotflex_jax as rf
from rotflex_jax.discover.stepwise import FAR_FROM_GIVEN
from rotflex_jax.effects import Cogging, Coulomb

INERTIA, LEVEL, OFFSET = 0.0075, 0.06, 0.1
# Motor of the arm: torque per volt [N m/V] and the damping by its back-EMF [N m s/rad].
DRIVE, DAMPING = 48.4 * 0.0107 / 3.29, (48.4 * 0.0107) ** 2 / 3.29


def arm(
    gain: float, step: float, seed: int, N: int = 3000, Ts: float = 0.002, fine: int = 20
) -> rf.Recording:
    """An arm in a proportional loop that follows four steps and rests between them.

        J w' = c (u + offset) - b w - friction

    in explicit steps of 0.1 ms, with static friction; the encoder has steps of 0.5 mrad.
    """
    rng, h = np.random.default_rng(seed), Ts / fine
    reference = step * np.repeat([0, 1, -1, 1], N // 4)
    u, y, q, w = np.empty(N), np.empty((N, 1)), 0.0, 0.0
    for k in range(N):
        y[k] = round((q + 1e-4 * rng.standard_normal()) / 5e-4) * 5e-4
        u[k] = gain * (reference[k] - y[k, 0])
        drive = DRIVE * (u[k] + OFFSET)
        for _ in range(fine):
            if w == 0.0 and abs(drive) <= LEVEL:
                break
            direction = np.sign(w if w else drive)
            after = w + h * (drive - DAMPING * w - LEVEL * direction) / INERTIA
            w = 0.0 if after * w < 0 else after
            q += h * w
    return rf.Recording(u, y, Ts, channels=("theta",), n_init=50)


def values(model: rf.Model) -> dict[str, float]:
    return model.mechanism.named_values


def test_a_baseline_that_does_not_move_hides_no_friction() -> None:
    train, validation, test = arm(8, 0.07, 0), arm(10, 0.07, 1), arm(14, 0.06, 2)
    model = rf.Model.of(rf.joints.rotary_arm(flexible=False))
    found = rf.discover(
        model, train, validation, test=test, candidates=[(Coulomb, "hub"), (Cogging, "hub")], rounds=1
    )
    # The baseline must be in the minimum that is tested: far from the machine, too heavy and too damped.
    inertia, damping = "hub.inertia.inertia", "hub.viscous.coefficient"
    assert values(found.baseline.model)[inertia] > FAR_FROM_GIVEN * values(model)[inertia]
    assert values(found.baseline.model)[damping] > 5 * DAMPING
    assert [note for note in found.notes if inertia in note and "rest" in note]
    assert found.verdict == "found" and found.final_fit is None
    assert [(r.effect, r.port) for r in found.rounds if r.effect != "voltage_offset"] == [("coulomb", "hub")]
    m = values(found.model)
    assert m["hub.coulomb.level"] == pytest.approx(LEVEL, rel=0.02)
    assert m[inertia] == pytest.approx(INERTIA, rel=0.02)
    assert m["input.voltage_offset.offset"] == pytest.approx(OFFSET, rel=0.02)
    error = found.model.simulate_windows(test, 2.0)[50:] - test.y[50:]
    assert np.sqrt(np.mean(error**2)) < 1e-3
