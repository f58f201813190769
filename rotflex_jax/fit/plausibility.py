"""Physical plausibility: ranges of parameters, signs of channels, sizes that the recordings reach."""

import itertools
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from rotflex_jax.effects.base import HALF_A_PERIOD, Effect, Linear
from rotflex_jax.errors import InputError
from rotflex_jax.mechanism import Mechanism, linearise
from rotflex_jax.mechanism.assembly import Layout
from rotflex_jax.models.model import Model
from rotflex_jax.parameters import Estimate, Transform, specifications
from rotflex_jax.recording import Recording
from rotflex_jax.recording.smoothing import smoothed

# Length over which measured outputs are smoothed [s].
SMOOTHED_SECONDS = 0.03


def motion(
    mechanism: Mechanism, y: Float[np.ndarray, "N C"], Ts: float
) -> dict[str, tuple[Float[np.ndarray, " N"], Float[np.ndarray, " N"]]]:
    """Port -> (position, speed) by smoothing measured outputs over `SMOOTHED_SECONDS`.

    Ports that the measured positions do not determine are left out.
    """
    layout = Layout.of(mechanism.structure)
    rows = np.array(layout.output_rows)
    is_position = np.array([q.is_position for q in mechanism.quantities])
    if not is_position.any():
        return {}
    width = max(2 * round(SMOOTHED_SECONDS / Ts / 2) + 1, 5)
    width = min(width, len(y) - 1 + len(y) % 2)
    C = rows[is_position, : layout.n]
    position, speed = (
        np.stack([smoothed(column, width, 3, order, Ts) for column in y[:, is_position].T], axis=1)
        for order in (0, 1)
    )
    back, out = np.linalg.pinv(C), {}
    for port, vector in mechanism.port_vectors.items():
        p = np.array(vector) @ back
        if np.allclose(p @ C, vector):
            out[port] = (position @ p, speed @ p)
    return out


_DAMPING = "N m s/rad"


def physical_ranges(m: Mechanism) -> tuple[Float[np.ndarray, " P"], Float[np.ndarray, " P"]]:
    """Least and largest unconstrained value of each parameter.

    They are the physical ranges that effects declare. A damping coefficient may fall below its own range by
    the damping of other effects at the same port. Then it corrects them, for instance a trusted back-EMF
    constant that is too large. The total damping remains physical as long as the other effects keep the
    damping that they have at the start. If a start is outside of a range, the range is widened.

    Args:
        m: Mechanism with the values at the start.
    """
    low, high = [], []
    for effect in m.effects:
        others = sum(e.stamp().static().damping for e in m.linear_effects(effect.at) if e is not effect)
        for spec in specifications(effect).values():
            corrects = isinstance(effect, Linear) and spec.unit == _DAMPING
            low.append(spec.physical[0] - (max(others, 0.0) if corrects else 0.0))
            high.append(spec.physical[1])
    values, transform = m.values, Transform.of(m.parameter_specifications)
    low, high = np.minimum(low, values), np.maximum(high, values)
    # An end beyond a declared bound is never reached. A coordinate increases with its parameter unless the
    # parameter has only an upper bound, which no effect declares.
    ends = (low > transform.lower, low, -np.inf), (high < transform.upper, high, np.inf)
    lowest, highest = (
        np.where(inside, transform.unconstrain(np.where(inside, end, values)), none)
        for inside, end, none in ends
    )
    return lowest, highest


# Changes over each of these shares of a recording are compared; largest number of samples of it that are
# used.
MOVE_SHARES, MAX_SIGN_SAMPLES = (0.001, 0.003, 0.01, 0.03), 20_000
# Number of samples in a block of the linear run.
LINEAR_RUN_BLOCK = 64
# A channel moves against the model if the correlation is below this at all shares.
OPPOSED_CORRELATION = -0.6


def check_signs(model: Model, recordings: Sequence[Recording]) -> None:
    """Refuse recordings whose channels move against the model.

    The linear part of the model is run with its parameters under the recorded input. Rough values are enough,
    since only the direction of each change counts. A resonance that the model has on the wrong side of all
    excited frequencies reverses a channel as well; then values nearer to the machine help. Recordings with
    signals are not checked, since a signal may move the machine more than the input does.

    Args:
        model: The model before any fit.
        recordings: Recordings that are to be fitted.

    Raises:
        InputError: If channels move in the opposite direction.
    """
    against: set[str] = set()
    there: dict[int, str] = {}  # number of a recording -> its name, where a channel moves against the model
    compared, worst = 0, 0.0
    for k, recording in enumerate(recordings):
        if recording.signals:
            continue
        linear = linearise(model.at(recording).mechanism)
        r = recording.slice(0, min(recording.N, MAX_SIGN_SAMPLES))
        y, would = model.measured(r).astype(float), _response(linear.discretise(r.Ts), linear.C, r.u)
        if not np.all(np.isfinite(would)):
            continue
        compared += 1
        for channel, a, b in zip(model.mechanism.channels, y.T, would.T, strict=True):
            found = [_correlation(a, b, max(round(share * r.N), 1)) for share in MOVE_SHARES]
            if max(found) < OPPOSED_CORRELATION:
                against.add(channel)
                there[k] = recording.source or f"recording {k + 1} of {len(recordings)}"
                worst = min(worst, *found)
    if not against:
        return
    where = "" if len(there) == compared else f" in {' and '.join(dict.fromkeys(there.values()))}"
    every = against == set(model.mechanism.channels)
    names = " and ".join(c for c in model.mechanism.channels if c in against)
    what = ("the input" if every else f"the column of {names}") + (" there" if where else "")
    verb = "moves" if len(against) == 1 else "move"
    raise InputError(
        f"{names} {verb} against what the model would do under this input{where} (correlation {worst:.2f}), "
        f"as with a sign turned round; negate {what} if that is so, or give starting values nearer to the "
        "machine, such as model.with_values({...})."
    )


def _response(discrete: tuple[np.ndarray, np.ndarray], C: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Outputs (N, C) of a linear system from rest, a block of samples at a time."""
    A, B = discrete
    with np.errstate(all="ignore"):
        powers = np.array([*itertools.accumulate([A] * LINEAR_RUN_BLOCK, np.matmul, initial=np.eye(len(A)))])
        left, pushed = (
            C @ powers[:-1],
            powers[:-1] @ B,
        )  # later effect of a state (L, C, n) and of an input (L, n)
        lag = np.subtract.outer(np.arange(LINEAR_RUN_BLOCK), np.arange(LINEAR_RUN_BLOCK)) - 1
        kernel = np.where(lag[..., None] >= 0, (pushed @ C.T)[lag], 0.0)  # (L, L, C)
        blocks = np.pad(u, (0, -len(u) % LINEAR_RUN_BLOCK)).reshape(-1, LINEAR_RUN_BLOCK)
        adds = blocks @ pushed[::-1]
        states = np.array(
            [*itertools.accumulate(adds[:-1], lambda x, new: powers[-1] @ x + new, initial=0 * B)]
        )
        y = np.tensordot(blocks, kernel, (1, 1)) + np.tensordot(states, left, (1, 2))
    return y.reshape(-1, len(C))[: len(u)]


def _correlation(a: np.ndarray, b: np.ndarray, step: int) -> float:
    """Correlation of the changes of two signals over a number of samples; zero if one does not change."""
    moves = [x[step:] - x[:-step] for x in (a, b)]
    if min(np.ptp(m) for m in moves) == 0:
        return 0.0
    return float(np.corrcoef(moves[0], moves[1])[0, 1])


# A size is beyond the recordings if it is more than this many times the largest signal in them.
BEYOND = 3.0
BEYOND_RECORDINGS = "beyond the recordings"
"""Kind of a remark on such a size."""


class Reach(NamedTuple):
    """Ranges of the signals of some recordings.

    Attributes:
        input: Largest |u| [unit of the input].
        position: Port -> half of the range of its position; channel -> largest |reading|.
        speed: Port -> largest |speed|.
        seconds: Length of the longest recording [s].
    """

    input: float
    position: dict[str, float]
    speed: dict[str, float]
    seconds: float

    @classmethod
    def of(cls, model: Model, recordings: Sequence[Recording]) -> "Reach":
        """The ranges of recordings, at the ports whose motion their channels determine."""
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
        """Largest value in the recordings of the signal that a parameter is compared with, and its name."""
        if unit == "V" and effect.at == "input":
            return self.input, "the input"
        if unit == "s" and effect.acts_on in ("input", "channel"):
            return self.seconds / BEYOND, "a third of the recording"
        if unit == "rad" and effect.at in self.position:
            return self.position[effect.at], f"the motion of {effect.at}"
        if unit == "rad/s" and effect.at in self.speed:
            return self.speed[effect.at], f"the speed of {effect.at}"
        return None


class Remark(NamedTuple):
    """A remark for the reader on one parameter.

    Attributes:
        parameter: Full name.
        kind: `BEYOND_RECORDINGS`, "at a bound", or `discretisation_bias.COARSE_STEP`.
        sentence: The remark in words, with numbers.
    """

    parameter: str
    kind: str
    sentence: str

    def to_dict(self) -> dict[str, str]:
        """Plain JSON types."""
        return self._asdict()


def beyond_recordings(m: Mechanism, reach: Reach, effects: Iterable[Effect] | None = None) -> list[Remark]:
    """Remarks on free parameters of sizes that the recordings do not reach.

    There are two cases. A parameter is a size of a signal and more than three times as large as the signal in
    the recordings: these cannot distinguish such sizes, and an effect with such a threshold is inactive. Or
    it is the number of periods per turn of a law, and the motion covers less than half a period: there the
    law is a spring or a constant torque.

    Args:
        m: Mechanism with the values in question.
        reach: Ranges of the recordings to which they were fitted.
        effects: Effects that are checked; all of them if None.
    """
    found = []
    for effect in m.effects if effects is None else effects:
        for name, spec in specifications(effect).items():
            full, value = effect.full_name(name), float(getattr(effect, name))
            if full in m.trusted:
                continue
            unit, limit = m.unit_of(effect, spec.unit), reach.limit(effect, spec.unit)
            if limit is not None and abs(value) > BEYOND * limit[0]:
                why = (
                    f"is far beyond what these recordings reach ({limit[1]}: {limit[0]:.3g} {unit}), so that "
                    "they do not determine it"
                )
            elif name == effect.repeats and value * reach.position.get(effect.at, np.inf) < HALF_A_PERIOD:
                travel = math.degrees(2 * reach.position[effect.at])
                why = (
                    f"is less than half a period within the motion of {effect.at} ({travel:.3g} "
                    "degrees), where the law is a spring or a constant torque"
                )
            else:
                continue
            sentence = f"{full} = {value:.3g} {unit}".rstrip() + f" {why}"
            found.append(Remark(full, BEYOND_RECORDINGS, sentence))
    return found


def at_bounds(estimates: Iterable[Estimate]) -> list[Remark]:
    """Remarks on free parameters at an end of their range."""
    return [
        Remark(e.name, "at a bound", f"{e.name} = {e.value:.3g} {e.unit}".rstrip() + f" is {_bound(e.note)}")
        for e in estimates
        if e.free and _bound(e.note)
    ]


def _bound(note: str) -> str:
    return next((part for part in note.split("; ") if part in AT_BOUND.values()), "")


AT_BOUND: Mapping[str, str] = {"lower": "at its lower bound", "upper": "at its upper bound"}
