"""Input signals against their definitions: variance, spectrum, levels, times."""

import numpy as np
import pytest

from rotflex_jax.data import excitation
from rotflex_jax.data.excitation import INPUTS, multisine, noise, prbs, pulse, steps, sweep
from rotflex_jax.errors import InputError

Ts = 0.01
SEEDED = ("noise", "multisine", "prbs", "steps")


@pytest.mark.parametrize("kind", INPUTS)
def test_every_input_has_its_samples_and_is_finite(kind: str) -> None:
    u = INPUTS[kind](1000, Ts)
    assert u.shape == (1000,)
    assert u.dtype == np.float64
    assert np.all(np.isfinite(u))
    assert np.ptp(u) > 0


@pytest.mark.parametrize("kind", INPUTS)
def test_number_of_samples_may_come_from_a_division(kind: str) -> None:
    np.testing.assert_array_equal(INPUTS[kind](10 / Ts, Ts), INPUTS[kind](1000, Ts))


@pytest.mark.parametrize("kind", SEEDED)
def test_seed_decides(kind: str) -> None:
    first = INPUTS[kind](500, Ts, seed=1)
    np.testing.assert_array_equal(first, INPUTS[kind](500, Ts, seed=np.random.default_rng(1)))
    assert not np.array_equal(first, INPUTS[kind](500, Ts, seed=2))


def test_noise_is_stationary_with_the_variance_and_memory_it_is_made_for() -> None:
    rng = np.random.default_rng(3)
    runs = np.array([noise(200, Ts, rms=2.0, bandwidth=2.0, seed=rng) for _ in range(4000)])
    # Each variance of 4000 runs has a relative standard deviation of sqrt(2 / 4000) = 2.2 %.
    variance = runs.var(axis=0)
    assert variance[0] == pytest.approx(4.0, rel=0.1)
    np.testing.assert_allclose(variance, 4.0, rtol=0.12)
    a = np.exp(-2 * np.pi * 2.0 * Ts)
    correlation = np.mean(runs[:, :-10] * runs[:, 10:]) / 4.0
    assert correlation == pytest.approx(a**10, abs=0.02)


def test_multisine_has_exactly_its_power_in_exactly_its_band() -> None:
    for optimise_crest in (True, False):
        u = multisine(2000, Ts, band=(0.5, 8.0), rms=1.5, optimise_crest=optimise_crest, seed=4)
        assert np.sqrt(np.mean(u**2)) == pytest.approx(1.5, rel=1e-12)
        lines = np.abs(np.fft.rfft(u)) / 1000
        frequency = np.fft.rfftfreq(2000, Ts)
        inside = (frequency > 0.5 - 1e-9) & (frequency < 8.0 + 1e-9)
        np.testing.assert_allclose(lines[inside], 1.5 * np.sqrt(2 / np.sum(inside)), rtol=1e-9)
        assert np.max(lines[~inside]) < 1e-9


@pytest.mark.parametrize("seed", range(5))
def test_optimised_phases_bring_the_peak_well_below_random_ones(seed: int) -> None:
    def crest(**options: bool) -> float:
        u = multisine(2000, Ts, band=(0.1, 12.0), seed=seed, **options)
        return float(np.max(np.abs(u)) / np.sqrt(np.mean(u**2)))

    assert crest(optimise_crest=False) > 2.2
    # A single sine has sqrt(2), and no sum of many comes much below it.
    assert 1.3 < crest(optimise_crest=True) < 1.75


def test_multisine_repeats() -> None:
    u = multisine(1200, Ts, periods=3, band=(1.0, 5.0))
    np.testing.assert_array_equal(u[:400], u[400:800])
    np.testing.assert_array_equal(u[:400], u[800:])


def test_full_prbs_period_has_the_autocorrelation_of_a_shift_register() -> None:
    u = prbs(63, Ts, amplitude=2.0, hold=Ts, seed=5) / 2.0
    assert set(u) == {-1.0, 1.0}
    assert abs(np.sum(u)) == 1
    circular = np.fft.ifft(np.abs(np.fft.fft(u)) ** 2).real
    np.testing.assert_allclose(circular, [63] + [-1] * 62, atol=1e-9)


def test_prbs_holds_its_bits_and_does_not_repeat() -> None:
    u = prbs(4000, Ts, hold=0.05)
    assert np.all(np.flatnonzero(np.diff(u)) % 5 == 4)
    bits = u[::5]
    words = {tuple(bits[k : k + 10]) for k in range(len(bits) - 9)}
    assert len(words) == len(bits) - 9


def test_random_steps_keep_their_levels_and_times() -> None:
    u = steps(20000, Ts, amplitude=3.0, hold=(0.2, 0.4), seed=6)
    lengths = np.diff(np.flatnonzero(np.diff(u)))
    assert lengths.min() >= 20
    assert lengths.max() <= 40
    levels = u[np.flatnonzero(np.diff(u))]
    assert np.max(np.abs(levels)) <= 3.0
    # uniform levels: standard deviation 3 / sqrt(3), from some 660 of them
    assert np.std(levels) == pytest.approx(np.sqrt(3), rel=0.06)


def test_sweep_passes_through_the_band_at_a_constant_rate_in_octaves() -> None:
    u = sweep(100_000, 1e-4, band=(1.0, 16.0), amplitude=2.0)
    assert np.max(np.abs(u)) == pytest.approx(2.0, rel=1e-3)
    assert u[0] == 0.0
    rising = np.flatnonzero((u[:-1] < 0) & (u[1:] >= 0)) * 1e-4
    middle, frequency = 0.5 * (rising[:-1] + rising[1:]), 1 / np.diff(rising)
    np.testing.assert_allclose(frequency, 16.0 ** (middle / 10.0), rtol=0.02)


def test_pulse_is_where_it_was_asked_for() -> None:
    u = pulse(100, Ts, amplitude=-2.0, width=0.3, delay=0.2)
    np.testing.assert_array_equal(np.flatnonzero(u), np.arange(20, 50))
    assert set(u) == {0.0, -2.0}


@pytest.mark.parametrize(
    ("kind", "arguments", "options", "phrase"),
    [
        ("noise", (0, Ts), {}, "`N` and `Ts`"),
        ("noise", (10.5, Ts), {}, "`N` and `Ts`"),
        ("prbs", (100, -Ts), {}, "`N` and `Ts`"),
        ("noise", (100, Ts), {"bandwidth": 0.0}, "`bandwidth` must be a finite number above 0"),
        ("prbs", (100, Ts), {"amplitude": -1.0}, "`amplitude` must be a finite number above 0"),
        ("steps", (100, Ts), {"hold": (0.0, 1.0)}, "`hold` must be a finite number above 0"),
        ("multisine", (1000, Ts), {"band": (1.0, 60.0)}, "half the sampling rate"),
        ("multisine", (1000, Ts), {"band": (5.0, 1.0)}, "must rise"),
        ("multisine", (1000, Ts), {"band": (1.01, 1.05)}, "must hold a multiple of 0.1 Hz"),
        ("multisine", (1000, Ts), {"periods": 3}, "multiple of `periods`"),
        ("sweep", (1000, Ts), {"band": (0.0, 10.0)}, "`band` must be a finite number above 0"),
        ("pulse", (100, Ts), {"width": 2.0}, "within the 1 s"),
    ],
)
def test_what_makes_no_signal_is_refused(kind: str, arguments: tuple, options: dict, phrase: str) -> None:
    with pytest.raises(InputError, match=phrase):
        excitation.INPUTS[kind](*arguments, **options)
