"""Likelihood of validation data: the covariance of innovations found on training data does not count."""

import dataclasses

import numpy as np
import pytest
import small_problem as sp

from rotflex_jax.discover.hypothesis import Whitener
from rotflex_jax.discover.selection import admissible
from rotflex_jax.discover.validation import ValidationSet, validate


@pytest.fixture(scope="module")
def sides():
    """Training data, fitted baseline, and validation data of the same machine with other inputs."""
    train = sp.problem(sp.recordings(sp.records(0.0)))
    unseen = sp.recordings(sp.records(0.0, (31, 32)))
    return (
        train,
        sp.fitted(train),
        ValidationSet(sp.problem(unseen), 0.8),
    )


def test_a_model_that_fits_its_training_data_closely_is_not_punished_for_it(sides):
    """If scaled by training errors ten times as small, each measured value would lose about 47 nats."""
    _, h, validation = sides
    close = Whitener(10 * h.whitener.L)
    plain, proud = validate(validation, h), validate(validation, dataclasses.replace(h, whitener=close))
    np.testing.assert_allclose(proud.blocks, plain.blocks, atol=1.0)


def test_the_size_of_the_innovations_is_that_of_the_held_out_recordings(sides):
    """The likelihood is that of a normal distribution with the covariance found there: a closed form."""
    _, h, validation = sides
    found = validate(validation, h)
    problem = validation.problem
    e = problem.innovations([found.adapted])[0][problem.seen > 0]
    S = e.T @ e / len(e) + np.diag((0.05 * sp.NOISE) ** 2)
    quadratic = np.einsum("nc,cd,nd->", e, np.linalg.inv(S), e)
    expected = -0.5 * (quadratic + len(e) * (2 * np.log(2 * np.pi) + np.linalg.slogdet(S)[1]))
    assert found.log_likelihood == pytest.approx(expected, rel=1e-9)


def test_a_model_that_diverges_on_held_out_data_is_refused(sides):
    train, h, validation = sides
    i = train.supermodel.mechanism.parameter_names.index("hub.motor.torque_constant")
    z = h.z.copy()
    z[i] = 400.0  # large enough for the model to diverge
    lost = validate(validation, dataclasses.replace(h, z=z))
    lost = dataclasses.replace(lost, location=sp.HUB, parameter_count=1)
    assert not np.isfinite(lost.window_rmse).all() and np.isfinite(lost.blocks).all()
    assert not admissible(lost, validate(validation, h), train.measured_values, sp.NOISE)
