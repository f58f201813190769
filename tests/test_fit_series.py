"""Forward regression: ratios against their definition, recovery of the true terms, and when it stops."""

import numpy as np
import pytest

from rotflex_jax.basis import Delays, Volterra
from rotflex_jax.errors import InputError
from rotflex_jax.fit import forward_regression, least_squares
from rotflex_jax.fit.linear import factor
from rotflex_jax.fit.series import forward_path
from rotflex_jax.recording import Recording

TRUE = {"u[t-1]": 1.0, "u[t-3]": -0.6, "u[t]^2": 0.4, "u[t-1] * u[t-2]": 0.25}


def record(N: int = 3000, sigma: float = 0.1, seed: int = 0) -> Recording:
    rng = np.random.default_rng(seed)
    u = rng.standard_normal(N)
    basis = Volterra(Delays(5))
    w = np.array([TRUE.get(name, 0.0) for name in basis.names])
    y = basis.regressors(u) @ w + sigma * rng.standard_normal(N)
    return Recording(u=u, y=y, Ts=0.1, channels="alpha")


def by_definition(phi: np.ndarray, y: np.ndarray, terms: int) -> tuple[list[int], list[float]]:
    """Error reduction ratios by definition: each regressor less its regression on those chosen before."""
    order: list[int] = []
    ratios = []
    for _ in range(terms):
        gains = np.full(phi.shape[1], -1.0)
        for k in set(range(phi.shape[1])) - set(order):
            q = phi[:, k]
            if order:
                q = q - phi[:, order] @ np.linalg.lstsq(phi[:, order], q, rcond=None)[0]
            gains[k] = (q @ y) ** 2 / (q @ q) / (y @ y)
        order.append(int(np.argmax(gains)))
        ratios.append(float(gains[order[-1]]))
    return order, ratios


def test_ratios_are_those_of_the_definition_and_add_up() -> None:
    rng = np.random.default_rng(1)
    phi = rng.standard_normal((200, 8)) @ rng.standard_normal((8, 8))
    y = rng.standard_normal(200)
    order, ratios = forward_path(factor(np.column_stack([phi, y])), 8)
    expected = by_definition(phi, y, 8)
    assert order == expected[0]
    np.testing.assert_allclose(ratios, expected[1], rtol=1e-8)
    e = y - phi @ np.linalg.lstsq(phi, y, rcond=None)[0]
    assert sum(ratios) == pytest.approx(1 - e @ e / (y @ y), abs=1e-12)


@pytest.mark.parametrize("seed", range(5))
def test_the_true_terms_are_found_and_no_others(seed: int) -> None:
    fit = forward_regression(Volterra(Delays(5)), record(seed=seed), "alpha")
    assert set(fit.selected) == set(TRUE)
    for name, value in TRUE.items():
        assert abs(fit[name].value - value) < 4.5 * fit[name].std
    assert "4 terms by held-out blocks" in fit.status
    assert next(iter(fit.err.values())) > 0.4
    # The constant is not chosen, although the quadratic terms have a mean.
    assert fit["1"].value == 0.0
    assert fit["1"].note == "not chosen"


def test_chance_gains_of_one_record_are_not_taken() -> None:
    # The plain minimum of the held-out error takes too many terms in a third of these recordings.
    fits = [forward_regression(Volterra(Delays(5)), record(400, 0.5, seed)) for seed in range(20)]
    assert all(set(TRUE) <= set(fit.selected) for fit in fits)
    assert sum(len(fit.selected) == 4 for fit in fits) >= 16


def test_few_terms_beat_all_of_them_on_unseen_data() -> None:
    train, test = record(150, 0.8, seed=3), record(4000, 0.0, seed=4)
    basis = Volterra(Delays(8))
    errors = []
    for fit in (least_squares(basis, train), forward_regression(basis, train)):
        errors.append(np.mean((fit.model.simulate(test) - test.y) ** 2))
    assert errors[1] < 0.3 * errors[0]


def test_pure_noise_gets_one_term() -> None:
    rng = np.random.default_rng(5)
    r = Recording(u=rng.standard_normal(2000), y=rng.standard_normal(2000), Ts=0.1, channels="alpha")
    assert len(forward_regression(Volterra(Delays(5)), r).selected) == 1


def test_a_number_of_terms_may_be_given_and_doubles_are_passed_over() -> None:
    r = record()
    fit = forward_regression(Volterra(Delays(2), layout="full"), r, terms=7)
    assert len(fit.selected) == 6
    assert fit.status == "converged, only 6 terms are independent"
    whole = least_squares(Volterra(Delays(2)), r)
    np.testing.assert_allclose(fit.model.simulate(r), whole.model.simulate(r), atol=1e-10)
    assert forward_regression(Volterra(Delays(2)), r, terms=2).status == "converged"


def test_the_table_shows_ratios_in_the_order_of_choice() -> None:
    fit = forward_regression(Volterra(Delays(5)), record())
    lines = str(fit).splitlines()
    assert lines[2].split() == ["term", "weight", "std", "t", "unit", "ERR", "%"]
    assert len(lines) == 3 + len(TRUE)
    assert lines[3].startswith("  u[t-1] ")
    assert float(lines[3].split()[-1]) == pytest.approx(100 * fit.err["u[t-1]"], rel=0.01)


def test_one_block_cannot_decide() -> None:
    with pytest.raises(InputError, match="needs at least 2, but 1 was given"):
        forward_regression(Volterra(Delays(2)), record(), blocks=1)
    with pytest.raises(InputError, match="Argument `terms` must be a whole number from 1"):
        forward_regression(Volterra(Delays(2)), record(), terms=0)
