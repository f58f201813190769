"""Parameters whose size the recordings cannot speak for: at a bound, or far beyond what was recorded."""

from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from rotflex_jax.effects.base import Effect, Sensing
from rotflex_jax.fit.motion import motion
from rotflex_jax.mechanism import Mechanism
from rotflex_jax.models.model import Model
from rotflex_jax.parameters import Estimate, specifications
from rotflex_jax.recording import Recording

# A size is beyond the recordings where they reach less than this share of it.
BEYOND = 3.0


class Reach(NamedTuple):
    """How far the signals of some recordings go.

    Attributes:
        input: Largest |u| [unit of the input].
        position: Port or channel -> largest distance from the middle of its travel.
        speed: Port -> largest speed.
        seconds: The longest recording [s].
    """

    input: float
    position: dict[str, float]
    speed: dict[str, float]
    seconds: float

    @classmethod
    def of(cls, model: Model, recordings: Sequence[Recording]) -> "Reach":
        """That of recordings, at the ports that their channels determine."""
        position: dict[str, float] = {}
        speed: dict[str, float] = {}
        for r in recordings:
            y = model.measured(r).astype(float)
            largest = dict(zip(model.mechanism.channels, np.abs(y).max(axis=0).tolist(), strict=True))
            for port, (q, dq) in motion(model.mechanism, y, r.Ts).items():
                largest[port] = float(np.ptp(q)) / 2
                speed[port] = max(speed.get(port, 0.0), float(np.abs(dq).max()))
            for name, size in largest.items():
                position[name] = max(position.get(name, 0.0), size)
        voltage = max(float(np.abs(r.u).max()) for r in recordings)
        return cls(voltage, position, speed, max(r.N * r.Ts for r in recordings))

    def limit(self, effect: Effect, unit: str) -> tuple[float, str] | None:
        """The most that the recordings reach of what a parameter is a size of, and what that is."""
        if unit == "V" and effect.at == "input":
            return self.input, "the input"
        if unit == "s" and (effect.at == "input" or isinstance(effect, Sensing)):
            return self.seconds / BEYOND, "a third of the recording"
        if unit == "rad" and effect.at in self.position:
            return self.position[effect.at], f"the motion of {effect.at}"
        if unit == "rad/s" and effect.at in self.speed:
            return self.speed[effect.at], f"the speed of {effect.at}"
        return None


class Remark(NamedTuple):
    """What a reader must know of one parameter.

    Attributes:
        parameter: Full name.
        kind: `beyond the recordings` or `at a bound`.
        sentence: In words, with numbers.
    """

    parameter: str
    kind: str
    sentence: str

    def to_dict(self) -> dict[str, str]:
        """Plain JSON types."""
        return self._asdict()


def beyond_recordings(m: Mechanism, reach: Reach, effects: Iterable[Effect] | None = None) -> list[Remark]:
    """Free parameters that are sizes of a signal and more than three times as large as it ever was.

    There the recordings cannot tell one size from another, and an effect with such a threshold is inactive.

    Args:
        m: With the values that are judged.
        reach: Of the recordings that they were fitted to.
        effects: Those that are looked at; all of them if None.
    """
    found = []
    for effect in m.effects if effects is None else effects:
        for name, spec in specifications(effect).items():
            full, value = f"{effect.at}.{effect.name}.{name}", float(getattr(effect, name))
            limit = None if full in m.trusted else reach.limit(effect, spec.unit)
            if limit is None or abs(value) <= BEYOND * limit[0]:
                continue
            unit = m.units.unit(spec.unit, effect.volts_of_input)
            sentence = (
                f"{full} = {value:.3g} {unit} is far beyond what these recordings reach ({limit[1]}: "
                f"{limit[0]:.3g} {unit}), so that they do not determine it"
            )
            found.append(Remark(full, "beyond the recordings", sentence))
    return found


def at_bounds(estimates: Iterable[Estimate]) -> list[Remark]:
    """Free parameters at an end of their range."""
    return [
        Remark(e.name, "at a bound", f"{e.name} = {e.value:.3g} {e.unit}".rstrip() + f" is {_bound(e.note)}")
        for e in estimates
        if e.free and _bound(e.note)
    ]


def _bound(note: str) -> str:
    return next((part for part in note.split("; ") if part in AT_BOUND.values()), "")


AT_BOUND: Mapping[str, str] = {"lower": "at its lower bound", "upper": "at its upper bound"}
