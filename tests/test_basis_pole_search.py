"""Least errors of filter banks against published tables, and the optimisation of poles."""

import numpy as np
import pytest
from linear_joint import POLES, impulse_response

from rotflex_jax.basis import (
    Delays,
    Orthonormal,
    Volterra,
    ar1,
    bank_covariance,
    best_laguerre,
    fir_nmse,
    memory_for,
    minimum_nmse,
    optimise_poles,
)
from rotflex_jax.basis.pole_search import _slopes
from rotflex_jax.data.excitation import noise
from rotflex_jax.errors import InputError
from rotflex_jax.reproduce.plants import plant, response

# Ts [ms]: error of five delays for white noise and for bandwidths of 10, 5 and 2 Hz.
FIVE_DELAYS = {
    1: (0.9986, 0.9371, 0.8559, 0.7754),
    2: (0.9901, 0.9079, 0.8237, 0.7562),
    5: (0.9040, 0.7913, 0.7177, 0.7050),
    10: (0.6581, 0.5946, 0.5805, 0.6648),
    20: (0.4463, 0.4753, 0.5319, 0.6434),
    50: (0.0682, 0.0665, 0.0596, 0.0463),
    100: (0.00054, 0.00054, 0.00055, 0.00067),
}
# Ts [ms]: numbers of delays for errors of 10 %, 1 % and 0.1 % under white noise.
MEMORY = {
    1: (191, 334, 411),
    2: (96, 168, 206),
    5: (39, 68, 83),
    10: (20, 35, 42),
    20: (11, 18, 22),
    50: (5, 8, 10),
    100: (3, 5, 5),
}


@pytest.mark.parametrize("ms", FIVE_DELAYS)
def test_least_error_of_five_delays(ms: int) -> None:
    Ts = ms / 1000
    h = impulse_response(Ts)
    for bandwidth, expected in zip((None, 10.0, 5.0, 2.0), FIVE_DELAYS[ms], strict=True):
        r = ar1(np.exp(-2 * np.pi * bandwidth * Ts) if bandwidth else 0.0, len(h))
        found = minimum_nmse(Delays(5), h, r)
        assert found == pytest.approx(expected, abs=1e-4 if ms < 100 else 5e-6)
        if ms >= 5:
            assert fir_nmse(h, r)[4] == pytest.approx(found, abs=1e-12)


@pytest.mark.parametrize("ms", MEMORY)
def test_memory_that_an_error_takes(ms: int) -> None:
    h = impulse_response(ms / 1000, 1.2)
    assert tuple(memory_for(nmse, h) for nmse in (0.1, 0.01, 0.001)) == MEMORY[ms]


def test_least_error_is_what_long_records_come_to() -> None:
    Ts, a = 0.05, np.exp(-2 * np.pi * 5.0 * 0.05)
    h, u = impulse_response(Ts), noise(200_000, Ts, seed=1)
    y = np.convolve(u, h)[: len(u)]
    phi = Delays(5).outputs(u)
    e = y - phi @ np.linalg.lstsq(phi, y, rcond=None)[0]
    found = minimum_nmse(Delays(5), h, ar1(a, len(h)))
    assert e @ e / (y @ y) == pytest.approx(found, rel=0.02)
    R1 = bank_covariance(Delays(5), ar1(a, 5))
    np.testing.assert_allclose(phi.T @ phi / len(u), R1, atol=0.02)
    # Outputs of orthonormal filters are uncorrelated if the input is white.
    bank = Orthonormal.at(POLES, Ts)
    np.testing.assert_allclose(bank_covariance(bank), np.eye(3), atol=1e-10)
    z = bank.outputs(u)
    np.testing.assert_allclose(z.T @ z / len(u), bank_covariance(bank, ar1(a, bank.reach)), atol=0.03)


# Ts [ms]: error of 2, 4 and 6 Kautz functions with the plant's resonance.
KAUTZ = {1: (0.278, 0.055, 0.011), 20: (0.254, 0.046, 0.0084), 50: (0.153, 0.018, 0.0021)}


@pytest.mark.parametrize("ms", KAUTZ)
def test_kautz_functions_reach_what_the_table_says(ms: int) -> None:
    Ts = ms / 1000
    h = impulse_response(Ts)
    for count, expected in zip((2, 4, 6), KAUTZ[ms], strict=True):
        bank = Orthonormal.kautz(np.exp(POLES[1] * Ts), count)
        assert minimum_nmse(bank, h) == pytest.approx(expected, rel=0.03)
    # Six functions with the resonance without back-EMF, a wrong pole, leave a large error.
    wrong = minimum_nmse(Orthonormal.kautz(np.exp((-1.6 + 32.2j) * Ts), 6), h)
    assert wrong == pytest.approx({1: 0.396, 20: 0.397, 50: 0.404}[ms], abs=1e-3)


# Ts [ms]: error of 4, 6 and 8 Laguerre functions with their best pole.
LAGUERRE = {10: (0.037, 0.0057, 0.0008), 20: (0.035, 0.0050, 0.0007), 50: (0.019, 0.0020, 0.0002)}


@pytest.mark.parametrize("ms", LAGUERRE)
def test_the_best_laguerre_pole_reaches_what_the_table_says(ms: int) -> None:
    h = impulse_response(ms / 1000)
    for count, expected, digit in zip((4, 6, 8), LAGUERRE[ms], (1e-3, 1e-4, 1e-4), strict=True):
        bank, nmse = best_laguerre(h, count)
        assert nmse == pytest.approx(expected, abs=0.5 * digit)
        assert nmse == pytest.approx(minimum_nmse(bank, h), rel=1e-6)
        assert -21 < bank.continuous_poles(ms / 1000)[0].real < -16


def test_poles_of_a_linear_plant_are_found_from_afar() -> None:
    Ts = 0.02
    u = noise(2000, Ts, seed=2)
    y = np.convolve(u, impulse_response(Ts, 4.0))[:2000]
    start = Orthonormal.at((-20.0, -5.0 + 25.0j, -5.0 - 25.0j), Ts)
    bank, search = optimise_poles(u, y, start.poles, starts=3)
    assert search.status == "converged"
    assert search.nmse < 1e-18
    assert bank.kinds == ("real", "pair")
    np.testing.assert_allclose(
        np.sort_complex(bank.continuous_poles(Ts)), np.sort_complex(np.array(POLES)), atol=1e-6
    )
    # All starts end at the same error; they are listed with the best first.
    assert [start.nmse < 1e-15 for start in search.starts] == [True] * 3
    assert np.all(np.diff([start.nmse for start in search.starts]) >= 0)
    assert "converged" in str(search)
    assert "±" in str(search)


def test_friction_moves_the_poles_towards_the_locked_mode() -> None:
    Ts = 0.02
    u = noise(4000, Ts, seed=3)
    y = response(plant("S1"), u, Ts, step=1e-3)[:, 1]
    start = Orthonormal.at(POLES, Ts)
    bank, search = optimise_poles(u, y, start.poles, starts=1)
    assert search.status == "converged"
    real, pair = bank.continuous_poles(Ts)[:2]
    assert real.real == pytest.approx(-49.3, abs=5.0)  # -34.8 without friction
    assert pair == pytest.approx(-7.1 + 17.1j, abs=0.3)
    phi = Volterra(start, 1).regressors(u)
    e = y - phi @ np.linalg.lstsq(phi, y, rcond=None)[0]
    assert e @ e / np.sum((y - y.mean()) ** 2) == pytest.approx(0.0179, abs=0.003)
    assert search.nmse == pytest.approx(0.0097, abs=0.0012)


def test_repeated_poles_move_together() -> None:
    h = impulse_response(0.02)
    impulse = np.eye(1, len(h))[0]
    bank, search = optimise_poles(impulse, h, [0.7], repeat=4, constant=False, starts=1)
    assert bank.size == 4
    assert len(set(bank.poles)) == 1
    assert bank.names[0] == "Laguerre 1"
    assert len(search.poles) == 1
    best, nmse = best_laguerre(h, 4)
    assert search.nmse == pytest.approx(nmse, rel=1e-6)
    assert bank.poles[0].real == pytest.approx(best.poles[0].real, abs=1e-5)


def test_repeated_sections_keep_their_order() -> None:
    u = noise(500, 0.02, seed=6)
    true = (0.4, 0.7 + 0.4j, 0.7 - 0.4j)
    y = Orthonormal(true * 2).outputs(u) @ [1.0, -2.0, 0.5, 1.5, 1.0, -1.0]
    bank, search = optimise_poles(u, y, (0.5, 0.65 + 0.35j, 0.65 - 0.35j), repeat=2, starts=1)
    assert search.nmse < 1e-15
    np.testing.assert_allclose(search.poles, true, atol=1e-7)
    np.testing.assert_allclose(bank.poles, true * 2, atol=1e-7)
    assert bank.names[0] == "GOBF 1"
    pair = optimise_poles(u, y, true[1:], repeat=3, starts=1)[0]
    assert (pair.kinds, pair.names[0]) == (("pair",) * 3, "Kautz 1")


def test_the_best_of_several_minima_comes_first() -> None:
    h = impulse_response(0.02)
    _, search = optimise_poles(np.eye(1, len(h))[0], h, [0.6], repeat=4, constant=False, starts=6, spread=0.5)
    found = [start.nmse for start in search.starts]
    assert found == sorted(found)
    assert found[-1] > 1.2 * found[0]
    assert search.nmse == found[0] == pytest.approx(best_laguerre(h, 4)[1], rel=1e-6)


def test_several_recordings_count_together_and_skipped_samples_do_not() -> None:
    u = [noise(300, 0.01, seed=k) for k in (1, 2)] + [noise(200, 0.01, seed=3)]
    true = Orthonormal((0.8,))
    y = [true.outputs(x)[:, 0] + 0.5 for x in u]
    for record in y:
        record[:5] += 7.0
    bank, search = optimise_poles(u, y, [0.3], skip=5, starts=1)
    assert bank.poles[0].real == pytest.approx(0.8, abs=1e-7)
    assert search.nmse < 1e-12


def test_a_pole_never_leaves_the_unit_circle() -> None:
    # An integrator has its pole on the unit circle: the search approaches it and returns a status.
    u = noise(500, 0.01, seed=4)
    bank, search = optimise_poles(u, np.cumsum(u), [0.9], starts=2)
    assert all(abs(p) < 1 for p in bank.poles)
    assert bank.poles[0].real > 0.99
    assert search.status
    # A negative pole stays negative.
    y = Orthonormal((-0.6,)).outputs(u)[:, 0]
    assert optimise_poles(u, y, [-0.2], starts=1)[0].poles[0].real == pytest.approx(-0.6, abs=1e-7)


def test_other_values_compile_nothing() -> None:
    u = noise(123, 0.01)
    y = Orthonormal((0.5,)).outputs(u)[:, 0]
    optimise_poles(u, y, [0.4], starts=1)
    compiled = _slopes.programs_made
    optimise_poles(2 * u, y + u, [0.7], starts=2)
    assert _slopes.programs_made == compiled


@pytest.mark.parametrize(
    ("make", "sentence"),
    [
        (lambda: ar1(1.0, 5), "between -1 and 1, but is 1"),
        (lambda: minimum_nmse(Delays(3), np.zeros(9)), "zero throughout"),
        (lambda: minimum_nmse(Delays(3), np.ones(9), [0.0]), "begins with the variance, but that is 0"),
        (lambda: minimum_nmse(Delays(3), np.ones(9), ar1(0.9, 4)), "ends at lag 3 with 0.73 .* give more"),
        (lambda: memory_for(2.0, np.ones(9)), "between 0 and 1, but is 2"),
        (lambda: memory_for(0.01, 0.5 ** np.arange(40), first=1), "all 39 delays from lag 1 on leave 0.75;"),
        (lambda: fir_nmse(np.ones(9), first=9), "first delay is 9, but the impulse response has 9 samples"),
        (lambda: optimise_poles(np.ones(9), np.arange(9.0), [0.5], seed=-1), "`seed` must be a whole number"),
        (lambda: best_laguerre(np.zeros(9), 2), "zero throughout"),
        (lambda: optimise_poles(np.ones(9), np.ones(8), [0.5]), "as many outputs as inputs"),
        (lambda: optimise_poles(np.ones(9), np.ones(9), [0.5], skip=9), "the first 9 left out"),
        (lambda: optimise_poles(np.ones(9), np.ones(9), [0.5]), "does not change"),
        (lambda: optimise_poles(np.arange(9.0), np.arange(9.0), [1.5]), "inside the unit circle"),
        (lambda: optimise_poles(np.arange(9.0), np.arange(9.0), [0.5], starts=0), "Argument `starts`"),
    ],
)
def test_bad_input_is_told_in_a_sentence(make, sentence: str) -> None:
    with pytest.raises(InputError, match=sentence):
        make()
