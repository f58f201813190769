"""The Electro-Mechanical Positioning System: a carriage on a screw, driven by a motor on a current loop."""

from rotflex_jax.effects import CurrentDrive, Inertia, Viscous
from rotflex_jax.mechanism import Mechanism
from rotflex_jax.mechanism.units import Units

FORCE_PER_VOLT = 35.15065188248547
"""Force on the carriage per volt of command [N/V], as the recordings give it."""


def emps(mass: float = 80.0, *, damping: float = 100.0, gain: float = FORCE_PER_VOLT) -> Mechanism:
    """A linear axis: mass, viscous damping and a drive in proportion to the voltage, one output.

        mass x'' = gain v - damping x'

    The gain is trusted, mass and damping are free. What friction the axis has is for a search to find.

    Args:
        mass: Of carriage, screw and rotor together, as the carriage feels it [kg].
        damping: [N s/m].
        gain: Force per volt [N/V].

    Returns:
        Mechanism with the output `position` [m] and the port `axis`.

    Source: Janot, Gautier and Brunot 2019, Data set and reference models of EMPS, equation 1 less
        friction and offset.

    >>> emps().free_names
    ('axis.inertia.inertia', 'axis.viscous.coefficient')
    >>> [s.unit for s in emps().parameter_specifications]
    ['kg', 'N/V', 'N s/m']
    """
    return Mechanism(
        coordinates=("position",),
        ports={"axis": (1.0,)},
        effects=(
            Inertia(at="axis", inertia=mass),
            CurrentDrive(at="axis", gain=gain),
            Viscous(at="axis", coefficient=damping),
        ),
        outputs={"position": "axis"},
        trusted=("axis.current_drive.gain",),
        units=Units("m", "N", motion_size=0.1, effort_size=1000.0),
    )
