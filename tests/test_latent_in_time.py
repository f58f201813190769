"""Sinusoids and drifts in latent torques: found where they exist, and not found where they do not."""

import dataclasses

import numpy as np
import pytest
import scipy

import rotflex_jax as rf
from rotflex_jax.arena.simulator.records import make_record
from rotflex_jax.data import excitation
from rotflex_jax.latent.in_time import drift, periodic_torques
from rotflex_jax.latent.result import ASKED_FOR, LatentTorque

Ts, N = 0.004, 4000
T = Ts * np.arange(N)


def coloured(rng: np.random.Generator, memory: float = 0.98) -> np.ndarray:
    """A torque without spectral lines, of standard deviation one: low-pass filtered white noise."""
    x = scipy.signal.lfilter([1.0], [1.0, -memory], rng.standard_normal(N + 500))[500:]
    return x / x.std()


def dry_friction(u: np.ndarray) -> np.ndarray:
    """A friction torque; it has the spectral lines of the motion."""
    return -np.sign(scipy.signal.lfilter([1.0], [1.0, -0.99], u))


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(("amplitude", "frequency"), [(1.2, 1.7), (0.2, 11.3), (2.0, 50.0)])
def test_a_sine_is_found_with_frequency_and_amplitude(seed: int, amplitude: float, frequency: float) -> None:
    rng = np.random.default_rng(seed)
    x = coloured(rng) + amplitude * np.sin(2 * np.pi * frequency * T + rng.uniform(0, 6))
    (line,) = periodic_torques(x, excitation.noise(N, Ts, seed=seed), Ts)
    # The frequency has the variance 6 / (pi^2 T^2 N signal-to-noise), its root far below 1 / T.
    assert line.frequency == pytest.approx(frequency, abs=0.5 / (N * Ts))
    low, high = line.interval
    assert low < line.amplitude < high and high - low < 2 * amplitude
    assert line.amplitude == pytest.approx(amplitude, abs=(high - low))
    assert line.p_value < 1e-3


def test_intervals_hold_the_amplitude_as_often_as_they_say() -> None:
    held = []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        x = coloured(rng) + 0.5 * np.sin(2 * np.pi * 7.3 * T + rng.uniform(0, 6))
        low, high = periodic_torques(x, excitation.noise(N, Ts, seed=seed), Ts)[0].interval
        held.append(low <= 0.5 <= high)
    assert np.mean(held) >= 0.85  # 0.95 expected, and 0.85 is beyond three standard deviations


def test_the_interval_in_white_noise_is_that_of_a_regression() -> None:
    """An amplitude in white noise of standard deviation one has the standard deviation sqrt(2 / N)."""
    sine, widths = 0.5 * np.sin(2 * np.pi * 7.3 * T), []
    for seed in range(8):
        x = sine + np.random.default_rng(seed).standard_normal(N)
        low, high = periodic_torques(x, excitation.noise(N, Ts, seed=seed), Ts)[0].interval
        widths.append(high - low)
    assert np.mean(widths) == pytest.approx(2 * 1.96 * np.sqrt(2 / N), rel=0.1)


def test_the_spectrum_of_white_noise_is_flat_at_its_level() -> None:
    """White noise of standard deviation s has the amplitude density s sqrt(2 Ts) per root Hz."""
    n = 20_000
    torque = 0.3 * np.random.default_rng(0).standard_normal((n, 1))
    none = np.zeros((n, 1))
    found = LatentTorque(
        ports=("hub",),
        torque=torque,
        std=none,
        time=Ts * np.arange(n),
        position=none,
        speed=none,
        voltage=none[:, 0],
        recording=np.zeros(n, int),
        Ts=(Ts,),
        intensity={"hub": 1.0},
        gain_nats={"hub": 0.0},
        scale=1.0,
        linear={},
    )
    f, density = found.spectrum("hub")
    assert f[-1] == pytest.approx(0.5 / Ts)
    for part in np.array_split(density[:-1] ** 2, 4):
        assert np.mean(part) == pytest.approx(0.3**2 * 2 * Ts, rel=0.1)


def test_two_sines_are_two() -> None:
    x = coloured(np.random.default_rng(1)) + np.sin(2 * np.pi * 5 * T) + 2 * np.cos(2 * np.pi * 23 * T)
    lines = periodic_torques(x, excitation.noise(N, Ts, seed=1), Ts)
    assert [round(line.frequency, 1) for line in lines] == [23.0, 5.0]
    assert [line.amplitude for line in lines] == pytest.approx([2.0, 1.0], rel=0.1)


@pytest.mark.parametrize("kind", ["noise", "multisine", "steps", "sweep", "prbs"])
def test_torques_of_the_motion_are_no_disturbance(kind: str) -> None:
    found = 0
    for seed in range(8):
        u = excitation.INPUTS[kind](N, Ts, seed=seed) if kind != "sweep" else excitation.sweep(N, Ts)
        x = dry_friction(u) + 0.1 * coloured(np.random.default_rng(seed))
        found += len(periodic_torques(x, u, Ts))
    assert found <= 1


def test_three_periods_are_enough_for_an_input_to_repeat_itself() -> None:
    """A sine as input has one line, while friction under it has lines at its odd multiples too."""
    u = np.sin(2 * np.pi * 3 * np.arange(N) / N)
    x = -np.sign(np.cos(2 * np.pi * 3 * np.arange(N) / N)) + 0.1 * coloured(np.random.default_rng(2))
    assert periodic_torques(x, u, Ts) == ()


def test_an_input_that_repeats_itself_makes_lines_of_its_own() -> None:
    """Friction under a periodic input has lines at all multiples of its frequency; they are not reported."""
    u = np.tile(excitation.multisine(N // 8, Ts, seed=3), 8)
    x = dry_friction(u) + 0.3 * np.sin(2 * np.pi * 13.3 * T) + 0.05 * coloured(np.random.default_rng(3))
    lines = periodic_torques(x, u, Ts)
    assert [round(line.frequency, 1) for line in lines] == [13.3]


def test_false_lines_and_drifts_are_rare() -> None:
    lines = drifts = 0
    for seed in range(100):
        rng = np.random.default_rng(seed)
        x = coloured(rng)
        lines += len(periodic_torques(x, excitation.noise(N, Ts, seed=seed), Ts)) > 0
        drifts += drift(x, Ts) is not None
    assert lines <= 2 and drifts <= 2  # each has a chance of one in a thousand


def test_a_drift_has_its_slope() -> None:
    x = coloured(np.random.default_rng(0), 0.9) + 0.3 * T
    found = drift(x, Ts)
    assert found is not None
    low, high = found.interval
    assert low < 0.3 < high and high - low < 0.1
    assert found.change == pytest.approx(0.3 * N * Ts, rel=0.1)
    assert drift(x[:40], Ts) is None and periodic_torques(x[:100], x[:100], Ts) == ()


def test_a_shaken_arm_is_read_from_a_recording() -> None:
    """An unmeasured sinusoidal torque at the arm, from the independent simulator."""
    shaken = {("shaking", "arm"): {"amplitude": 0.02, "frequency": 1.7}}
    made = make_record(shaken, seed=5, seconds=10.0, fs=200.0, perturb=0.0)
    recording = rf.Recording(u=made["u"], y=made["y"], Ts=made["Ts"])
    joint = rf.joints.paper(joint_damping=0.003, hub_damping=0.004)
    found = rf.latent_torque(joint, recording, ports=["arm", "hub"])
    line = found.periodic("arm")[0]
    assert line.frequency == pytest.approx(1.7, abs=0.02)
    assert line.amplitude == pytest.approx(0.02, rel=0.3)
    assert any("1.7 Hz" in sentence and "arm" in sentence for sentence in found.in_time())
    assert "1.7 Hz" in str(found) and "1.7 Hz" in found._repr_html_()
    labels = [text.get_text() for ax in rf_time_axes(found) for text in ax.texts]
    assert "1.7 Hz" in labels
    # A torque by which the likelihood gains too little is not analysed.
    silent = dataclasses.replace(found, gain_nats=dict.fromkeys(found.ports, ASKED_FOR - 1))
    assert silent.in_time() == []


def rf_time_axes(found: LatentTorque) -> list:
    from rotflex_jax.latent.figure import latent_time

    return latent_time(found).axes
