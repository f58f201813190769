"""What an output measures at its port, and the units of rotary and other machines.

Effects are written for a port that turns: angles in rad, torques in N m. The ports of a machine may have
other units, such as metres and newtons, or volts and volts. Every other unit then follows by dimensions, and
sentences speak of forces.

A reading that is no linear combination of positions and speeds has a row of zeros here. The current of a
motor and the duty of a servo are states of effects that show them (`Memory.shows`); another reading would
have its equation in `mechanism/simulate.py`. An acceleration cannot be a reading: it depends on the torques,
which no reading receives.
"""

import enum
import re
from typing import NamedTuple

from rotflex_jax.effects.base import Effect

_UNIT = re.compile(
    r"kg m\^2|\(N m\)\^2|N m\b(?: s(?:\^\d)?(?![a-z]))?(?:/(?:rad|s|A|V)(?:\^\d)?)*|rad\b(?:/s(?:\^\d)?)?"
)
_VOLTS = re.compile(r"\b(m?)V\b")
_ANGLE_TOO = re.compile(r" \([-+]?[\d.e+-]+ degrees\)")
_WORDS = (
    ("moment of inertia", "mass"),
    ("torque", "force"),
    ("turning", "moving"),
    ("turns", "moves"),
    ("turned", "moved"),
)


def input_word(unit: str) -> str:
    """`voltage`, or `input` where it has another unit, such as a goal or a current."""
    return "voltage" if unit == "V" else "input"


class Units(NamedTuple):
    """Units of the ports of a machine.

    Attributes:
        motion: Unit of a port's position.
        effort: Unit of the force or torque.
        motion_size: Typical size of a position in its unit, relative to the radians of a small joint.
        effort_size: Typical size of a force or torque in its unit, relative to newton metres.
        input: Unit of the input: V for a voltage, otherwise the unit of a goal angle or of a current.
    """

    motion: str = "rad"
    effort: str = "N m"
    motion_size: float = 1.0
    effort_size: float = 1.0
    input: str = "V"

    def unit(self, declared: str, of_input: bool = False, per: str = "") -> str:
        """The unit of this machine for a unit that an effect declares.

        Args:
            declared: Unit that the effect declares.
            of_input: Whether the volts in it stand for the unit of the input.
            per: Unit of the signal by which the unit is divided; the same for any machine.

        >>> Units("m", "N").unit("N m s/rad"), Units("m", "N").unit("kg m^2")
        ('N s/m', 'kg')
        >>> Units(input="A").unit("N m/V", of_input=True), Units(input="rad").unit("V")
        ('N m/A', 'V')
        >>> Units("m", "N").unit("N m", per="rad/s^2")
        'N/(rad/s^2)'
        """
        if per:
            own = self.unit(declared, of_input)
            return f"{own}/({per})" if any(c in per for c in "/* ") else f"{own}/{per}"
        driven = of_input and self.input != "V"
        if (self.motion, self.effort) == ("rad", "N m") and not driven:
            return declared
        powers = _powers(declared)
        if driven and "V" in powers:
            volts = powers.pop("V")
            powers[self.input] = powers.get(self.input, 0) + volts
        Q, E = powers.pop("rad", 0), powers.pop("N m", 0)
        if (self.motion, self.effort, powers.get("s", 0), E, Q) == ("m", "N", 2, 1, -1):
            powers, E, Q = {"kg": 1} | {k: v for k, v in powers.items() if k != "s"}, 0, 0
        whole: dict[str, int] = {}
        moved = [(name, power * Q) for name, power in _powers(self.motion).items()]  # `rad/s` of a sensor
        for name, power in ((self.effort, E), *powers.items(), *moved):
            whole[name] = whole.get(name, 0) + power
        return _written(whole)

    def of(self, effect: Effect, declared: str) -> str:
        """The unit of this machine for the declared unit of a parameter of an effect."""
        return self.unit(declared, effect.volts_of_input, effect.signal_unit)

    def size(self, declared: str) -> float:
        """Factor for this machine on a typical size that an effect declares in this unit."""
        powers = _powers(declared)
        return self.effort_size ** powers.get("N m", 0) * self.motion_size ** powers.get("rad", 0)

    def sentence(self, text: str, of_input: bool = False) -> str:
        """The sentence of an effect, in the units and words of this machine.

        Args:
            text: Sentence of the effect.
            of_input: Whether the volts in it stand for the unit of the input.

        >>> Units("m", "N").sentence("the axis has a torque of 20 N m and turns by 0.1 rad (6 degrees)")
        'the axis has a force of 20 N and moves by 0.1 m'
        >>> Units(input="rad").sentence("voltages between -0.1 V and 0.2 V have no effect", of_input=True)
        'inputs between -0.1 rad and 0.2 rad have no effect'
        """
        if of_input and self.input != "V":
            text = _VOLTS.sub(lambda found: found.group(1) + self.input, text).replace("voltage", "input")
        if self.motion == "rad":
            return text
        text = _ANGLE_TOO.sub("", text)
        text = _UNIT.sub(lambda found: self.unit(found.group()), text)
        for word, instead in _WORDS:
            text = text.replace(word, instead)
        return text


TURNING = Units()


def _powers(unit: str) -> dict[str, int]:
    """Factors of a unit and their powers; an inertia is a torque per angular acceleration.

    >>> _powers("N m s^2/rad^2"), _powers("kg m^2")
    ({'N m': 1, 's': 2, 'rad': -2}, {'N m': 1, 's': 2, 'rad': -1})
    """
    text = unit.replace("kg m^2", "N m s^2/rad").replace("(N m)^2", "Nm^2").replace("N m", "Nm")
    powers: dict[str, int] = {}
    for k, part in enumerate(text.split("/")):
        for factor in part.split():
            name, _, power = factor.strip("()").partition("^")
            if name != "1":
                name = "N m" if name == "Nm" else name
                powers[name] = powers.get(name, 0) + (1 if k == 0 else -1) * int(power or 1)
    return powers


def _written(powers: dict[str, int]) -> str:
    raised = lambda name, power: name if power == 1 else f"{name}^{power}"  # noqa: E731
    above = " ".join(raised(n, p) for n, p in powers.items() if p > 0)
    below = "".join("/" + raised(n, -p) for n, p in powers.items() if p < 0)
    return (above or ("1" if below else "")) + below


class Quantity(enum.Enum):
    """A measured quantity of a port; its value is the name by which an output gives it.

    Attributes:
        derivative: Order of the time derivative of the port's position; for a reading of the motor 2, as for
            a torque.

    >>> Quantity("speed").derivative, Quantity("speed").unit(Units("m", "N"))
    (1, 'm/s')
    """

    derivative: int

    POSITION = "position", 0
    SPEED = "speed", 1
    CURRENT = "current", 2
    DUTY = "duty", 2

    def __new__(cls, name: str, derivative: int) -> "Quantity":
        """A member whose value is the name alone."""
        member = object.__new__(cls)
        member._value_, member.derivative = name, derivative
        return member

    @classmethod
    def names(cls) -> tuple[str, ...]:
        """All names."""
        return tuple(q.value for q in cls)

    @property
    def is_position(self) -> bool:
        """Whether the quantity is the position itself."""
        return self.derivative == 0

    @property
    def of_motion(self) -> bool:
        """Whether the quantity is a linear function of positions and speeds."""
        return self.derivative <= 1

    def unit(self, units: Units) -> str:
        """Unit of the reading for a machine with these units."""
        if not self.of_motion:
            return "A" if self is Quantity.CURRENT else ""
        return units.motion + ("", "/s")[self.derivative]

    def row(self, port: tuple[float, ...]) -> tuple[float, ...]:
        """Coefficients of the reading over positions and speeds (2 n,) for a port vector (n,)."""
        zeros = (0.0,) * len(port)
        if not self.of_motion:
            return zeros + zeros
        return port + zeros if self.is_position else zeros + port
