"""Trusted constants on which intervals depend are named; equal constants of a motor may be tied."""

import json

import numpy as np
import pytest
from scipy.linalg import expm

import rotflex_jax as rf
from rotflex_jax import Recording, fit, joints
from rotflex_jax.effects import Motor, Stribeck
from rotflex_jax.errors import InputError
from rotflex_jax.fit.held_constants import with_held_constants
from rotflex_jax.models.model_json import read
from rotflex_jax.parameters import Estimate

K_T, DAMPER, EMF = "hub.motor.torque_constant", "hub.viscous.coefficient", "hub.motor.back_emf"
NUMBERS = (PAPER := joints.paper()).named_values
RATIO, R = NUMBERS["hub.motor.gear_ratio"], NUMBERS["hub.motor.resistance"]


def turned(constant: float, emf: float, damper: float) -> Recording:
    """A recording of the paper's joint with another motor and damper, by the matrix exponential."""
    J, Ja, k = (NUMBERS[n] for n in ("hub.inertia.inertia", "arm.inertia.inertia", "joint.spring.stiffness"))
    gain = RATIO * constant / R
    M = np.linalg.inv([[J + Ja, Ja], [Ja, Ja]])
    A, Ts, N = np.zeros((5, 5)), 0.004, 800
    A[:2, 2:4] = np.eye(2)
    A[2:4, :2] = -M @ np.diag([0.0, k])
    A[2:4, 2:4] = -M @ np.diag([damper + gain * RATIO * emf, 0.002])
    A[2:4, 4] = M @ [gain, 0.0]
    step, rng = expm(A * Ts), np.random.default_rng(5)
    u = np.repeat(rng.uniform(-3, 3, N // 25), 25)
    x, y = np.zeros(4), np.empty((N, 2))
    for n in range(N):
        y[n], x = x[:2], step[:4, :4] @ x + step[:4, 4] * u[n]
    return Recording(u=u, y=y + 3e-4 * rng.standard_normal(y.shape), Ts=Ts, accept=("units",))


@pytest.fixture(scope="module")
def recording() -> Recording:
    return turned(1.05 * NUMBERS[K_T], 1.05 * NUMBERS[EMF], 0.0041)


@pytest.fixture(scope="module")
def untied(recording: Recording) -> rf.Fit:
    return fit(PAPER, recording)


def test_a_damper_that_is_wrong_by_another_constant_says_on_which_it_hangs(untied: rf.Fit) -> None:
    found = untied[DAMPER]
    assert found.ci95[0] > 1.5 * 0.0041  # narrow and wrong: the true back-EMF is 5 % larger
    first = found.given[0]
    assert (first.name, first.value, first.unit) == (EMF, NUMBERS[EMF], "V s/rad")
    assert found.value + 5 * first.change == pytest.approx(0.0041, abs=4 * found.std)
    words = f"given {EMF} 0.00767 V s/rad"
    assert words in str(untied) and words in untied._repr_html_() and words in found.remark
    assert json.loads(json.dumps(found.to_dict()))["given"][0]["name"] == EMF
    # It depends on the torque constant too, but that is free; the damper of the joint depends on no motor.
    assert K_T not in {c.name for e in untied.parameters for c in e.given}
    assert EMF not in {c.name for c in untied["joint.viscous.coefficient"].given}


@pytest.mark.parametrize("constant", [EMF, "arm.inertia.inertia", "hub.motor.efficiency"])
def test_a_fit_with_another_constant_ends_where_the_words_say(
    constant: str, untied: rf.Fit, recording: Recording
) -> None:
    again = fit(untied.model.mechanism.with_values({constant: 1.01 * NUMBERS[constant]}), recording)
    named = {e.name: c.change for e in untied.parameters for c in e.given if c.name == constant}
    assert named
    for e in untied.parameters:
        if e.free:
            moved = again[e.name].value - e.value
            assert moved == pytest.approx(named.get(e.name, 0.0), rel=0.03, abs=0.3 * e.std)
    assert again.cost == pytest.approx(untied.cost, abs=0.01)  # the recording does not distinguish the two


def test_tied_constants_are_fitted_as_one(untied: rf.Fit, recording: Recording, tmp_path) -> None:
    tied = joints.paper(tied=True)
    assert tied.free_names == PAPER.free_names and tied.parameter_names == PAPER.parameter_names
    found = fit(tied, recording)
    assert found[K_T].value == pytest.approx(1.05 * NUMBERS[K_T], abs=4 * found[K_T].std)
    assert found[EMF].value == found[K_T].value == found.model.mechanism.effect("motor", "hub").back_emf
    assert found[EMF].note == f"tied to {K_T}" and f"tied to {K_T}" in str(found)
    assert found[DAMPER].value == pytest.approx(0.0041, abs=4 * found[DAMPER].std)
    assert EMF not in {c.name for c in found[DAMPER].given}
    kept = read(found.save(tmp_path / "fit.json"))
    assert (kept.Ts, kept.n_init) == (recording.Ts, recording.n_init)  # an export needs no --Ts
    assert kept.model.mechanism == found.model.mechanism and repr(kept.estimates) == repr(found.parameters)
    assert read(untied.save(tmp_path / "untied.json")).estimates[8].given == untied[DAMPER].given


def test_a_tied_constant_has_no_value_of_its_own() -> None:
    tied = joints.quanser_2010(tied=True)
    moved = tied.with_values({K_T: 0.009})
    assert moved.named_values[EMF] == 0.009
    assert tied.with_values(tied.named_values) == tied
    for refused in (lambda: tied.with_values({EMF: 0.009}), lambda: tied.release(EMF)):
        with pytest.raises(InputError, match=f"'{EMF}'.*tied to '{K_T}'.*tied=False"):
            refused()
    with pytest.raises(InputError, match="tied='yes'"):
        Motor(tied="yes")  # pyright: ignore[reportArgumentType]
    assert Motor(torque_constant=0.02, tied=True).back_emf == 0.02


@pytest.mark.parametrize(("wide", "named"), [(0.999, True), (1.001, False)])
def test_a_heavier_arm_scales_all_torques_and_no_speed(wide: float, named: bool) -> None:
    """With an arm heavier by 1 %, a run is the same if every other torque is larger by 1 %.

    The speed of a law is then the same. An arm that is wrong by 5 % is named where this moves an estimate by
    more than half of its 95 % interval.
    """
    arm, speed = "arm.inertia.inertia", "hub.stribeck.speed"
    friction = Stribeck("hub", level=0.01, excess=0.005, speed=0.4)
    damped = joints.paper(hub_damping=0.004, joint_damping=0.003)
    mechanism = damped.with_values({arm: 1e-4}) + friction
    values, free = mechanism.named_values, mechanism.free_names
    given = [
        Estimate(name, v, wide * 0.05 * v / 1.959964, (0.0, 2 * v), "", free=name in free)
        for name, v in values.items()
    ]
    found = {e.name: {c.name: c.change for c in e.given} for e in with_held_constants(mechanism, given)}
    assert {"hub.stribeck.level", speed, "joint.spring.stiffness"} <= set(free)
    for name in free:
        change = pytest.approx(0.01 * values[name], rel=1e-4) if named and name != speed else None
        assert found[name].get(arm) == change
