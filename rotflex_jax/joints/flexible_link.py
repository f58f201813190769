"""A rotary flexible link: a servo turns a hub with a clamped beam, and a strain gauge measures its bending.

A clamped beam acts on the hub like separate inertias on springs, one for each mode. A share of
`12 / (beta L)^4` of the moment of inertia of a uniform beam belongs to a mode: 97.07 % to the first and
2.47 % to the second. The deflection of a mode is an angle `eta` of its inertia relative to the hub. The
curvature of the beam at the clamp is `4 / L` times the sum of these angles, whatever the mode.
"""

import math

from rotflex_jax.checks import instance, known_arguments
from rotflex_jax.effects import Inertia, Motor, SensorGain, Spring, Viscous
from rotflex_jax.joints.arguments import known_number
from rotflex_jax.joints.rotary_flexible import hub_inertia, srv02_motor
from rotflex_jax.mechanism import Mechanism

# Roots of cosh(b) cos(b) = -1: b is the wave number of a clamped beam times its length.
WAVE_NUMBERS = (1.8751040687, 4.6940911330)
# Share of the beam's moment of inertia about the clamp that belongs to each mode.
SHARES = tuple(12 / b**4 for b in WAVE_NUMBERS)
# A gauge that was calibrated with a load at the tip reads tip / L where the curvature at the clamp is
# 3 tip / L^2. The modes have the curvature 4 / L times the sum of their angles, so it reads 4/3 of this sum.
GAUGE_GAIN = 4 / 3

PORTS = {
    "hub": (1.0, 0.0, 0.0),
    "joint": (0.0, 1.0, 0.0),
    "arm": (1.0, 1.0, 0.0),
    "second": (0.0, 0.0, 1.0),
    "second_arm": (1.0, 0.0, 1.0),
    "gauge": (0.0, 1.0, 1.0),
}


@known_arguments
def flexible_link(
    *,
    mass: float = 0.065,
    length: float = 0.419,
    frequency: float = 3.0,
    damping_ratio: float = 0.01,
    hub: float | None = None,
    hub_damping: float = 0.004,
    gauge_gain: float = GAUGE_GAIN,
    motor: Motor | None = None,
) -> Mechanism:
    """A beam on a servo with its first two modes; `alpha` is the reading of a strain gauge at the clamp.

        J theta'' + J_1 (theta'' + eta_1'') + J_2 (theta'' + eta_2'') = motor - hub_damping theta'
        J_i (theta'' + eta_i'') = -k_i eta_i - d_i eta_i',   alpha = gain (eta_1 + eta_2)

    Searches try effects at `hub`, `joint` (the first mode) and `arm`. The inertias of both modes are trusted,
    and all parameters of the motor except its torque constant. The hub inertia, the stiffnesses, the dampers,
    the torque constant and the gain of the gauge (`alpha.sensor_gain.error`, the gain less one) are free. Not
    for a tip that carries a load, which changes the shares of the modes.

    Args:
        mass: Mass of the beam [kg].
        length: Distance from the axis of the hub to the tip [m].
        frequency: Frequency of the first mode while the hub is held [Hz]; the second is 6.27 times as high.
        damping_ratio: Damping ratio of both modes.
        hub: Inertia of the servo, reflected to the hub [kg m^2]; None for the SRV02.
        hub_damping: Viscous damping in addition to that of the motor [N m s/rad].
        gauge_gain: Reading of the gauge divided by the sum of the modes' angles; 4/3 if the gauge was
            calibrated by the deflection of the tip, as `deflection / length`.
        motor: Motor with its gear; None for the SRV02.

    Returns:
        Mechanism with the outputs `theta` and `alpha`.

    Raises:
        InputError: A mass, a length, a frequency or the gain of the gauge is no positive number, a damping
            ratio is negative, or the motor is none.

    Source: L. Meirovitch, Fundamentals of Vibrations, 2001, section 8.3 (clamped beam); Quanser, Rotary
        Flexible Link, user manual, 2011 (mass, length, calibration of the gauge). The frequency is typical of
        that link.

    >>> link = flexible_link()
    >>> link.channels, "alpha.sensor_gain.error" in link.free_names
    (('theta', 'alpha'), True)
    """
    mass = known_number(mass, "mass", above=0, unit="kg", example="0.065")
    length = known_number(length, "length", above=0, unit="m", example="0.419")
    frequency = known_number(frequency, "frequency", above=0, unit="Hz", example="3.0")
    damping_ratio = known_number(damping_ratio, "damping_ratio", least=0, example="0.01")
    gauge_gain = known_number(gauge_gain, "gauge_gain", above=0, example="4 / 3")
    if hub is not None:
        hub = known_number(hub, "hub", least=0, unit="kg m^2", example="0.002")
    if motor is not None:
        instance(motor, Motor, "motor", "give rotflex_jax.effects.Motor('hub', ...)")
    whole = mass * length**2 / 3
    inertias = [share * whole for share in SHARES]
    angular = [2 * math.pi * frequency * (b / WAVE_NUMBERS[0]) ** 2 for b in WAVE_NUMBERS]
    motor = motor or srv02_motor()
    # The inertia of modes above the second moves with the hub.
    own = (hub_inertia(body=0.0) if hub is None else hub) + whole - sum(inertias)
    modes = []
    for at, carried, J, W in zip(("joint", "second"), ("arm", "second_arm"), inertias, angular, strict=True):
        modes += [
            Inertia(at=carried, inertia=J),
            Spring(at=at, stiffness=J * W**2),
            Viscous(at=at, coefficient=2 * damping_ratio * J * W),
        ]
    return Mechanism(
        coordinates=("theta", "eta_1", "eta_2"),
        ports=PORTS,
        effects=(
            Inertia(at="hub", inertia=own),
            motor,
            Viscous(at="hub", coefficient=hub_damping),
            *modes,
            SensorGain(at="alpha", error=gauge_gain - 1.0),
        ),
        outputs={"theta": "hub", "alpha": "gauge"},
        trusted=(
            "arm.inertia.inertia",
            "second_arm.inertia.inertia",
            *(f"hub.motor.{name}" for name in motor.values if name != "torque_constant"),
        ),
    )
