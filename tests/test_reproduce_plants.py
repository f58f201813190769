"""Plants with known nonlinear effects, against independent integrators and exact properties."""

import json
from pathlib import Path

import numpy as np
import pytest

from rotflex_jax.effects import VoltageOffset
from rotflex_jax.errors import InputError
from rotflex_jax.reproduce.plants import SCENARIOS, plant, response, spring_series

NUMBERS = json.loads(Path(__file__).with_name("paper_numbers.json").read_text())


def volts(N: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).standard_normal(N)


def test_pulse_response_with_friction_is_that_of_an_independent_integrator() -> None:
    # Reference: implicit integration with a step of 5e-6 s; keys are seconds since the start of the pulse.
    u = np.zeros(201)
    u[:100] = 2.0
    y = response(plant("S1"), u, 0.01, step=1e-4)
    for time, (theta, alpha, *_) in NUMBERS["pulse_S1_h5e-6"].items():
        k = round(float(time) / 0.01)
        assert y[k, 1] == pytest.approx(alpha, abs=1e-4), time
        assert y[k, 0] == pytest.approx(theta, abs=5e-4), time


def test_linear_plant_has_the_tabulated_impulse_response() -> None:
    u = np.zeros(12)
    u[0] = 1.0
    np.testing.assert_allclose(response(plant("S0"), u, 0.1)[:, 1], NUMBERS["impulse_alpha_0.1"], atol=1e-12)


@pytest.mark.parametrize("name", [n for n, s in SCENARIOS.items() if s.odd])
def test_symmetric_plants_are_odd_to_the_last_digit(name: str) -> None:
    u = volts(300)
    np.testing.assert_array_equal(response(plant(name), -u, 0.02), -response(plant(name), u, 0.02))


@pytest.mark.parametrize("name", [n for n, s in SCENARIOS.items() if not s.odd])
def test_the_other_plants_are_not(name: str) -> None:
    u = volts(300)
    y = response(plant(name), u, 0.02)
    assert np.max(np.abs(y + response(plant(name), -u, 0.02))) > 1e-3


def test_unequal_hub_friction_is_equal_friction_and_a_voltage() -> None:
    # Levels 0.045 and 0.015 are 0.03 in both directions and a torque of -0.015 N m, equivalent to a voltage.
    motor = plant("S0").effect("motor", "hub").values
    shift = 0.015 * motor["resistance"] / (motor["torque_constant"] * motor["gear_ratio"])
    # Without the dead zone, which would act on the voltage too.
    equal = plant("S1").without("dead_zone", "input") + VoltageOffset(offset=-shift)
    u = volts(400)
    unequal = response(plant("S3").without("dead_zone", "input"), u, 0.02)
    np.testing.assert_allclose(unequal, response(equal, u, 0.02), atol=1e-8)


def test_where_the_arm_rubs_matters_a_little() -> None:
    u = volts(2000)
    joint, arm = (response(plant("S1", port), u, 0.01)[:, 1] for port in ("joint", "arm"))
    nmse = np.sum((joint - arm) ** 2) / np.sum((joint - joint.mean()) ** 2)
    assert nmse == pytest.approx(4.0e-3, rel=0.3)


def test_series_of_unlike_springs() -> None:
    # Reference: the derivative of the energy, and a polynomial fitted to it.
    d, R = 0.75 * 0.0254, 3 * 0.0254

    def energy(a: np.ndarray) -> np.ndarray:
        total = np.zeros_like(a)
        for preload, rate, side in ((1.78, 565.25, 1), (1.33, 312.8, -1)):
            stretch = np.hypot(R * np.cos(a) - d, R * np.sin(a) - side * 1.25 * 0.0254) - 1.25 * 0.0254
            total += preload * stretch + rate * stretch**2 / 2
        return total

    def torque(a: np.ndarray) -> np.ndarray:
        return (energy(a + 1e-5) - energy(a - 1e-5)) / 2e-5

    alpha0, *terms = spring_series(3, 2, "C", 3)
    assert alpha0 == pytest.approx(0.265, abs=5e-4)
    assert torque(np.array([alpha0]))[0] == pytest.approx(0.0, abs=1e-8)
    a = np.linspace(-0.05, 0.05, 41)
    fitted = np.polynomial.Polynomial.fit(a, torque(alpha0 + a), 7).convert().coef[1:4]
    np.testing.assert_allclose(terms, fitted, rtol=1e-4)
    np.testing.assert_allclose(terms, (1.2184, -0.2646, -0.579), rtol=1e-3)


def test_the_mechanism_carries_the_springs() -> None:
    _, K, K2, K3 = spring_series(3, 2, "C", 3)
    mechanism = plant("S5p")
    values = mechanism.named_values
    assert values["joint.spring.stiffness"] == K
    assert values["joint.quadratic_spring.stiffness"] == K2
    assert values["joint.cubic_spring.stiffness"] == K3


def test_shorter_steps_change_little() -> None:
    u = volts(1000)
    coarse, fine = (response(plant("S1"), u, 0.05, step=step)[:, 1] for step in (2.5e-4, 5e-5))
    assert np.sum((coarse - fine) ** 2) < 1e-4 * np.sum(fine**2)


@pytest.mark.parametrize(("arguments", "word"), [(("S9",), "S5p"), (("S1", "hub"), "table")])
def test_bad_names_are_refused_with_the_choices(arguments: tuple[str, ...], word: str) -> None:
    with pytest.raises(InputError, match=word):
        plant(*arguments)
