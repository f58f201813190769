"""Held-out likelihood: what the training data say of a model's size of error does not count elsewhere."""

import dataclasses

import numpy as np
import pytest
import small_problem as sp

from rotflex_jax.discover.hypothesis import Whitener
from rotflex_jax.discover.selection import admissible
from rotflex_jax.discover.validation import ValidationSet, validate


@pytest.fixture(scope="module")
def sides():
    """A trained baseline, and the held-out side: the same machine, other inputs."""
    train = sp.problem(sp.recordings(sp.records(0.0)))
    unseen = sp.recordings(sp.records(0.0, (31, 32)))
    return (
        train,
        sp.fitted(train),
        ValidationSet(sp.problem(unseen), 0.8),
    )


def test_a_model_that_fits_its_training_data_closely_is_not_punished_for_it(sides):
    """Ten times as small in training: in units of that, each held-out sample would lose some 50 nats."""
    _, h, validation = sides
    close = Whitener(10 * h.whitener.L)
    plain, proud = validate(validation, h), validate(validation, dataclasses.replace(h, whitener=close))
    np.testing.assert_allclose(proud.blocks, plain.blocks, atol=1.0)


def test_the_size_of_the_innovations_is_that_of_the_held_out_recordings(sides):
    """The likelihood is that of a normal law with the covariance found there: a closed form."""
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
    z[i] = 400.0  # as large as the numbers go
    lost = validate(validation, dataclasses.replace(h, z=z))
    lost = dataclasses.replace(lost, location=sp.HUB, parameter_count=1)
    assert not np.isfinite(lost.window_rmse).all() and np.isfinite(lost.blocks).all()
    assert not admissible(lost, validate(validation, h), train.measured_values, sp.NOISE)
