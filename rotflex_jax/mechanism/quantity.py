"""What an output measures at its port: which time derivative of the position, in which unit.

A reading that is no linear combination of positions and speeds has a row of zeros here and its equation in
`mechanism/simulate.py`. An acceleration is more: it depends on the torques, which no reading receives.
"""

import enum

from rotflex_jax.mechanism.units import Units


class Quantity(enum.Enum):
    """A measured quantity of a port; its value is the name that outputs are given with.

    Attributes:
        derivative: Order of the time derivative of the port's position.

    >>> Quantity("speed").derivative, Quantity("speed").unit(Units("m", "N"))
    (1, 'm/s')
    """

    derivative: int

    POSITION = "position", 0
    SPEED = "speed", 1

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
        """Whether it is the position itself."""
        return self.derivative == 0

    def unit(self, units: Units) -> str:
        """Unit of the reading for a machine that moves in these units."""
        return units.motion + ("", "/s")[self.derivative]

    def row(self, port: tuple[float, ...]) -> tuple[float, ...]:
        """Coefficients of the reading over positions and speeds (2 n,) for a port vector (n,)."""
        zeros = (0.0,) * len(port)
        return port + zeros if self.is_position else zeros + port
