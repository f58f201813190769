"""Held-out likelihood: what the training data say of a model's size of error does not count elsewhere."""

import dataclasses

import numpy as np
import pytest
import small_bench as sb

from rotflex_jax.discover.decide import admissible
from rotflex_jax.discover.heldout import Away, held_out
from rotflex_jax.discover.whiten import Whitener
from rotflex_jax.fit.residuals import first_states
from rotflex_jax.model import Model


@pytest.fixture(scope="module")
def sides():
    """A trained baseline, and the held-out side: the same machine, other inputs."""
    train = sb.judge(sb.recordings(sb.records(0.0)))
    unseen = sb.recordings(sb.records(0.0, (31, 32)))
    return (
        train,
        sb.fitted(train),
        Away(sb.judge(unseen), unseen, first_states(Model(sb.baseline()), unseen), 0.8),
    )


def test_a_model_that_fits_its_training_data_closely_is_not_punished_for_it(sides):
    """Ten times as small in training: in units of that, each held-out sample would lose some 50 nats."""
    _, h, away = sides
    close = Whitener(h.whitener.a, 10 * h.whitener.L)
    plain, proud = held_out(away, h), held_out(away, dataclasses.replace(h, whitener=close))
    np.testing.assert_allclose(proud.blocks, plain.blocks, atol=1.0)


def test_the_size_of_the_innovations_is_that_of_the_held_out_recordings(sides):
    """The likelihood is that of a normal law with the covariance found there: a closed form."""
    _, h, away = sides
    found = held_out(away, h)
    bench = away.judge.bench
    e = bench.innovations([found.adapted.lane(bench)])[0][bench.data.seen > 0]
    S = e.T @ e / len(e) + np.diag((0.05 * sb.NOISE) ** 2)
    quadratic = np.einsum("nc,cd,nd->", e, np.linalg.inv(S), e)
    expected = -0.5 * (quadratic + len(e) * (2 * np.log(2 * np.pi) + np.linalg.slogdet(S)[1]))
    assert found.held_out == pytest.approx(expected, rel=1e-9)


def test_a_model_that_diverges_on_held_out_data_is_refused(sides):
    train, h, away = sides
    i = train.bench.supermodel.mechanism.parameter_names.index("hub.motor.torque_constant")
    z = h.z.copy()
    z[i] = 400.0  # as large as the numbers go
    lost = dataclasses.replace(held_out(away, dataclasses.replace(h, z=z)), place=sb.HUB, numbers=1)
    assert not np.isfinite(lost.windows).all() and np.isfinite(lost.blocks).all()
    assert not admissible(lost, held_out(away, h), train.bench.data, sb.NOISE)
