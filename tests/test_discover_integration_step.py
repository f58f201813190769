"""Steps of integration of a search, and errors of free runs that noise alone causes."""

import dataclasses

import numpy as np
import pytest
from pendulum import PENDULUM, swung

import rotflex_jax as rf
from rotflex_jax.discover.evaluation import errors_by_noise
from rotflex_jax.discover.search import _prepare
from rotflex_jax.discover.verdict import NEAR_FLOOR, TORQUE_NATS, Verdict, assess
from rotflex_jax.effects import CATALOG, Inertia
from rotflex_jax.mechanism import Units
from rotflex_jax.models.model import Model

LAWS = [(CATALOG[name], "shaft") for name in ("coulomb", "stribeck")]


@pytest.mark.parametrize("seed", [21, 31])
def test_a_pendulum_in_coarse_steps_is_explained(seed):
    """At 100 Hz most of the error of its free runs comes from the step, and much of the rest from noise."""
    found = rf.discover(PENDULUM, *swung(16.0, seed).split(0.7), candidates=LAWS)
    assert found.verdict == Verdict.FOUND, found.sentence
    assert [(r.effect, r.port) for r in found.rounds] == [("stribeck", "shaft")]
    substeps = found.model.solver.substeps
    assert substeps > 1 and found.final.model.solver.substeps == substeps
    assert [note for note in found.notes if f"integrated in {substeps} steps" in note] == [
        note for note in found.notes if "integrated in" in note
    ]
    true = {"level": 0.06, "excess": 0.05, "speed": 0.4}
    for name, estimate in found.rounds[0].parameters.items():
        assert estimate.value == pytest.approx(true[name], rel=0.1)
    inertia = found.final.model.mechanism.named_values["shaft.inertia.inertia"]
    assert inertia == pytest.approx(0.012, rel=1e-3)


def test_the_error_by_noise_is_that_of_a_line_through_the_first_samples():
    """A mass without friction: the error of a run is that of the straight line through `n_init` samples."""
    Ts, N, noise = 0.01, 2000, 2e-3
    mass = rf.Mechanism(
        coordinates=["x"],
        ports={"axis": (1,)},
        effects=[CATALOG["current_drive"](at="axis", gain=1.0), Inertia(at="axis", inertia=0.5)],
        outputs={"position": "axis"},
        units=Units("m", "N", input="A"),
        trusted=["axis.current_drive.gain"],
    )
    rng = np.random.default_rng(3)
    u = np.repeat(rng.uniform(-1, 1, N // 20), 20)
    y = rf.simulate(mass, u, Ts) + noise * rng.standard_normal((N, 1))
    recording = rf.Recording(u, y, Ts, channels="position", units="m", input_name="current", input_unit="A")
    train, other = recording.split(0.5)
    at = _prepare(Model.of(mass), (train,), (other,), [], 2.0).free_run.validation
    sigma, (part,) = at.problem.noise[0], at.problem.dataset.recordings
    A = np.column_stack([np.ones(200), np.arange(200)])
    covariance = np.linalg.inv(A[: part.n_init].T @ A[: part.n_init])
    variance = 1 + np.einsum("ni,ij,nj->n", A, covariance, A)[part.n_init :]
    found = errors_by_noise(at, [Model.of(mass)])
    assert found["position"] / sigma == pytest.approx(np.sqrt(variance.mean()), rel=0.15)


def test_errors_count_over_what_noise_causes():
    before, floor = {"theta": 1.0, "alpha": 1.0}, {"theta": 0.01, "alpha": 0.01}
    after = {"theta": 0.03, "alpha": 0.011}
    assert not assess(before, after, floor, 0.0).is_explained
    end = assess(before, after, floor, 0.0, 2.0, {"theta": 0.025, "alpha": 0.005})
    assert end.is_explained and end.misfit == 1.0
    assert end.remaining["theta"] == pytest.approx(3.0)
    assert end.to_dict()["expected_over_noise"]["theta"] == pytest.approx(2.5)
    assert "what noise alone causes (theta 2.5" in end.criterion
    # Less than the noise of the sensor is never expected, and a random torque still speaks against a model.
    assert assess(before, after, floor, 0.0, 2.0, {"theta": 0.015}).at_noise is False
    assert assess({}, {"theta": 0.014}, floor, 0.0, 2.0, {"theta": 0.001}).at_noise
    assert not dataclasses.replace(end, torque_nats=2 * TORQUE_NATS).is_explained
    worse = dataclasses.replace(end, remaining={"theta": 1.1 * NEAR_FLOOR * 2.5})
    assert "(limit theta 3.75" in worse.criterion and worse.misfit == pytest.approx(1.21)
