"""The presets against the values of their sources."""

import inspect
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rotflex_jax import Recording, fit, joints
from rotflex_jax.arena.simulator.records import COUNT, JITTER, make_record
from rotflex_jax.checks import known_arguments
from rotflex_jax.effects import Coulomb, Motor
from rotflex_jax.errors import InputError
from rotflex_jax.joints.rotary_flexible import ARM_ANCHORS, HUB_ANCHORS, SIDE, SPRINGS
from rotflex_jax.mechanism import linearise
from rotflex_jax.runtime.xla import double_precision

# Stiffness [N m/rad] by the maker's 2010 formula (config_rotflex.m) at spring, hub anchor A B C
# and arm anchor 1 2 3, rounded to 4 decimals.
TABLE = {
    1: {
        "A": (1.0582, 0.9413, 0.8395),
        "B": (0.8656, 0.7701, 0.6842),
        "C": (0.6705, 0.5988, 0.5331),
    },
    2: {
        "A": (1.6911, 1.5136, 1.3694),
        "B": (1.3949, 1.2485, 1.1234),
        "C": (1.0931, 0.9832, 0.8865),
    },
    3: {
        "A": (3.0323, 2.7168, 2.4641),
        "B": (2.5047, 2.2442, 2.0237),
        "C": (1.9668, 1.7712, 1.6004),
    },
}


def test_the_27_stiffnesses():
    settings = joints.spring_settings()
    assert len(settings) == 27
    for (spring, hub, arm), stiffness in settings.items():
        assert stiffness == pytest.approx(TABLE[spring][hub][arm - 1], abs=1e-4)
    assert (min(settings, key=settings.get), max(settings, key=settings.get)) == (
        (1, "C", 3),
        (3, "A", 1),
    )


@pytest.mark.parametrize(("spring", "hub", "arm"), joints.spring_settings())
def test_stiffness_is_the_curvature_of_the_springs_energy(spring, hub, arm):
    kit, d, R = SPRINGS[spring], HUB_ANCHORS[hub], ARM_ANCHORS[arm]

    def energy(alpha):
        total = 0.0
        for side in (SIDE, -SIDE):
            length = jnp.hypot(R * jnp.cos(alpha) - d, R * jnp.sin(alpha) - side)
            stretch = length - kit.length
            total = total + kit.preload * stretch + kit.rate / 2 * stretch**2
        return total

    with double_precision():
        slope = jax.grad(energy)(0.0)
        curvature = jax.grad(jax.grad(energy))(0.0)
    assert abs(float(slope)) < 1e-12  # the two springs balance
    assert float(curvature) == pytest.approx(joints.spring_stiffness(spring, hub, arm), rel=1e-12)


def test_the_older_stiffness_formula():
    """0.509 to 2.247 N m/rad over the settings, 1.0142 at the default."""
    old = [joints.spring_stiffness(*s, preload_only=True) for s in joints.spring_settings()]
    assert joints.spring_stiffness(preload_only=True) == pytest.approx(1.0142, abs=5e-5)
    assert min(old) == pytest.approx(0.509, abs=5e-4)
    assert max(old) == pytest.approx(2.247, abs=5e-4)


@pytest.mark.parametrize(
    ("setting", "said"),
    [((4, "A", 1), "spring was given 4"), ((1, "D", 1), "hub_anchor"), ((1, "A", 0), "arm_anchor")],
)
def test_a_setting_the_kit_lacks(setting, said):
    with pytest.raises(InputError, match=said):
        joints.spring_stiffness(*setting)


def test_inertias_of_the_maker():
    arms = [joints.arm_inertia(i) for i in range(4)]
    np.testing.assert_allclose(arms, [0.0019002, 0.0035260, 0.0038938, 0.0043002], atol=5e-8)
    # Servo alone 0.00208418 and 0.00177276 without tachometer; the joint's body adds 0.0005.
    assert joints.hub_inertia() == pytest.approx(0.00258418, abs=5e-9)
    assert joints.hub_inertia(tachometer=False) == pytest.approx(0.00227276, abs=5e-9)
    with pytest.raises(InputError, match="arm was given 5"):
        joints.quanser_2010(arm=5)


def test_paper_holds_its_table_and_takes_other_values():
    joint = joints.paper()
    values = joint.named_values
    assert values == {
        "hub.inertia.inertia": 0.0021,
        "arm.inertia.inertia": 0.0059,
        "joint.spring.stiffness": 1.61,
        "hub.motor.torque_constant": 0.00767,
        "hub.motor.back_emf": 0.00767,
        "hub.motor.resistance": 2.6,
        "hub.motor.gear_ratio": 70.0,
        "hub.motor.efficiency": 1.0,
        "hub.viscous.coefficient": 0.0,
        "joint.viscous.coefficient": 0.0,
    }
    other = joints.paper(stiffness=1.5, hub_damping=0.004, efficiency=0.621, inductance=0.18e-3)
    changed = other.named_values
    assert set(changed) - set(values) == {"hub.motor.inductance"}
    assert {n for n in values if changed[n] != values[n]} == {
        "joint.spring.stiffness",
        "hub.viscous.coefficient",
        "hub.motor.efficiency",
    }


@pytest.mark.parametrize(
    "joint",
    [joints.paper(), joints.paper(inductance=1e-4), joints.quanser_2002(), joints.quanser_2010()],
)
def test_what_a_fit_moves(joint):
    assert joint.free_names == (
        "hub.inertia.inertia",
        "joint.spring.stiffness",
        "hub.motor.torque_constant",
        "hub.viscous.coefficient",
        "joint.viscous.coefficient",
    )
    assert joint.channels == ("theta", "alpha")
    assert set(joint.port_vectors) == {"hub", "joint", "arm"}


def test_the_makers_presets():
    old, new = joints.quanser_2002(), joints.quanser_2010(arm=3, spring=3, hub_anchor="C")
    assert old.effect("spring", "joint").stiffness == pytest.approx(1.0142, abs=5e-5)
    assert old.effect("viscous", "hub").coefficient == 0.004
    assert new.effect("spring", "joint").stiffness == pytest.approx(1.7712, abs=5e-5)
    assert new.effect("viscous", "hub").coefficient == 0.015
    assert new.effect("inertia", "arm").inertia == joints.arm_inertia(3)
    motor = new.effect("motor", "hub")
    assert motor.efficiency == pytest.approx(0.621)
    assert (motor.torque_constant, motor.back_emf) == pytest.approx((7.68e-3, 7.68e-3), abs=5e-6)
    assert joints.quanser_2010(inductance=1.8e-4).effect("motor", "hub").inductance == 1.8e-4


def test_single_inertia_answers_like_a_first_order_lag():
    """The speed has the rate (drive km Kg + damping) / J and the acceleration drive / J per volt."""
    servo = joints.single_inertia(0.0021, damping=0.01)
    space = linearise(servo)
    drive, damping = 0.2065, 0.2065 * 0.00767 * 70 + 0.01
    np.testing.assert_allclose(space.A, [[0, 1], [0, -damping / 0.0021]], rtol=1e-12)
    np.testing.assert_allclose(space.B, [0, drive / 0.0021], rtol=1e-12)
    assert servo.channels == ("theta",)
    assert servo.free_names == ("hub.inertia.inertia", "hub.viscous.coefficient")


def test_single_inertia_stands_for_a_linear_axis():
    drive = Motor(torque_constant=35.15, back_emf=0.0, resistance=1.0, gear_ratio=1.0)
    axis = joints.single_inertia(95.1, motor=drive, damping=203.5, channel="q", port="axis")
    space = linearise(axis)
    np.testing.assert_allclose(space.A[1, 1], -203.5 / 95.1, rtol=1e-12)
    np.testing.assert_allclose(space.B[1], 35.15 / 95.1, rtol=1e-12)
    assert axis.channels == ("q",) and axis.effect("motor", "axis").at == "axis"


@pytest.mark.parametrize("preset", ["paper", "quanser_2002", "quanser_2010"])
@pytest.mark.parametrize(
    ("sensors", "row"), [("theta", 0), ("alpha", 1), ("speed", 2), (["alpha", "speed"], 1)]
)
def test_sensors_of_a_joint(preset: str, sensors: str | list[str], row: int) -> None:
    """The equations are those with both sensors, and the output is the state that the sensor measures."""
    both, some = getattr(joints, preset)(), getattr(joints, preset)(sensors=sensors)
    assert some.channels == ((sensors,) if isinstance(sensors, str) else tuple(sensors))
    a, b = linearise(both), linearise(some)
    np.testing.assert_allclose(b.A, a.A)
    np.testing.assert_allclose(b.C[0], np.eye(4)[row])


def test_from_the_deflection_alone_a_linear_joint_has_four_numbers() -> None:
    """Four coefficients between voltage and deflection, for five free parameters.

        alpha / V = -c3 s / (s^3 + c2 s^2 + c1 s + c0)

    Only with a nonlinear effect is the fifth parameter, the torque constant, identifiable too.
    """
    alone = joints.paper(sensors="alpha", hub_damping=0.004, joint_damping=0.003)
    names = alone.free_names
    assert names == joints.paper().free_names and "hub.motor.torque_constant" in names

    def coefficients(mechanism) -> np.ndarray:
        linear = linearise(mechanism)
        # The deflection does not depend on the angle itself.
        A, B, C = linear.A[1:, 1:], linear.B[1:], linear.C[:, 1:]
        s = 1j * np.array([2.0, 11.0, 40.0])
        return np.concatenate([[*(C @ np.linalg.solve(x * np.eye(3) - A, B)).ravel()] for x in s])

    def rank(free) -> int:
        values = alone.named_values
        columns = []
        for name in free:
            up, down = (coefficients(alone.with_values({name: values[name] * f})) for f in (1.001, 0.999))
            slope = (up - down) / 0.002
            columns.append(np.concatenate([slope.real, slope.imag]))
        J = np.array(columns)
        return int(np.linalg.matrix_rank(J / np.linalg.norm(J, axis=1, keepdims=True), tol=1e-6))

    assert (rank(names), len(names)) == (4, 5)
    assert rank([n for n in names if n != "hub.motor.torque_constant"]) == 4


def test_friction_at_the_hub_tells_the_torque_constant_to_the_deflection() -> None:
    """With friction the torque constant is identifiable from the deflection alone.

    If it is trusted at a wrong value, residuals are several times the noise, and a search would find effects
    that do not exist.
    """
    made = make_record([("coulomb", "hub")], kind="noise", seed=2, rms=2.0, seconds=6.0)
    angle = Recording(u=made["u"], y=made["y"][:, 1], Ts=made["Ts"], channels="alpha", accept=("units",))
    joint, constant = (
        joints.paper(sensors="alpha") + Coulomb(at="hub", level=0.02),
        "hub.motor.torque_constant",
    )
    true = made["truth"]["plant"]["k_t"]
    assert abs(true / 0.00767 - 1) > 0.15  # the value of the preset is wrong
    found = fit(joint, angle)
    assert found.noise["alpha"] < 1.2 * np.hypot(JITTER, COUNT / np.sqrt(12))
    assert found[constant].value == pytest.approx(true, abs=4 * found[constant].std)
    assert found["hub.coulomb.level"].value == pytest.approx(0.03, rel=0.02)
    assert fit(joint.trust(constant), angle).noise["alpha"] > 3 * found.noise["alpha"]


@pytest.mark.parametrize("name", [n for n in joints.__all__ if inspect.isfunction(getattr(joints, n))])
def test_a_misspelt_argument_of_a_preset_is_refused(name: str) -> None:
    preset = getattr(joints, name)
    accepted = list(inspect.signature(preset).parameters)
    wrong = f"{accepted[0]}s" if accepted else "stiffness"
    with pytest.raises(InputError) as refused:
        preset(**{wrong: 2})
    hint = f"did you mean {accepted[0]}?" if accepted else "leave it out."
    listed = ", ".join(accepted) or "no argument"
    assert str(refused.value) == f"{name} was given {wrong}=2, but accepts {listed}; {hint}"


@pytest.mark.parametrize(
    ("call", "said"),
    [
        (lambda: joints.paper(2.0), "paper was given 2.0 without a name, but accepts hub_inertia, "),
        (lambda: joints.paper(colour="red"), "paper was given colour='red', but accepts hub_inertia, "),
        (lambda: joints.flexible_joint(hub_inertia=1e-3), "flexible_joint was given no arm_inertia"),
        (lambda: joints.quanser_2002(1, arm=2), "quanser_2002 was given arm twice"),
    ],
)
def test_arguments_that_do_not_fit_a_preset_are_refused(call, said) -> None:
    with pytest.raises(InputError, match=f"^{re.escape(said)}"):
        call()


def test_a_type_error_within_a_function_is_no_wrong_argument() -> None:
    with pytest.raises(TypeError) as failed:
        known_arguments(lambda: len(3))()  # type: ignore[arg-type]
    assert not isinstance(failed.value, InputError)


@pytest.mark.parametrize("preset", [joints.flexible_link, joints.xl330_pendulum])
def test_a_preset_passes_through_a_gradient(preset) -> None:
    """Everything in these two is linear in the mass."""
    slope = jax.jit(jax.grad(lambda mass: sum(jax.tree.leaves(preset(mass=mass)))))(0.2)
    low, high = (preset(mass=mass).values.sum() for mass in (0.2, 0.3))
    assert float(slope) == pytest.approx((high - low) / 0.1, rel=1e-4)
