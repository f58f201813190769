"""Which effect a kernel encodes: kernels with all effects, less those with one of them switched off."""

import dataclasses
from typing import Any

import numpy as np

from rotflex_jax.effects.kinds import Effect, Linear
from rotflex_jax.kernels.average import Parts, kernels_of, parts
from rotflex_jax.kernels.result import Kernels, linear_size, quadratic_size, root_mean_square
from rotflex_jax.kernels.stretches import Stretches
from rotflex_jax.kernels.subject import Modelled, lags_of, subject
from rotflex_jax.mechanism.mechanism import Mechanism
from rotflex_jax.recording import Recording

# A change below so many standard errors (rms over the kernel) is called nothing; chance gives about one.
NOTICED = 2.0
# Changes and errors below this share of the linear kernel are rounding.
ROUNDING = 1e-9


@dataclasses.dataclass(frozen=True, eq=False)
class EffectShare:
    """What one effect does to the kernels.

    Attributes:
        effect: The effect, with its numbers.
        change: Kernels with it less kernels without it; standard errors of the difference.
        linear: Size of the change of `h1` as a share of the linear response, freed of its expected noise.
        quadratic: Size of the change of `h2` as a share of the linear response, likewise.
        z: Root mean square of both changes in standard errors; chance alone gives about one. Zero where
            nothing changed at all, infinite where the change is the same everywhere, as a linear effect's.
    """

    effect: Effect
    change: Kernels
    linear: float
    quadratic: float
    z: tuple[float, float]

    @property
    def name(self) -> str:
        """For instance "coulomb at hub"."""
        return f"{self.effect.name} at {self.effect.at}"

    def __str__(self) -> str:
        unit = " standard errors"
        first = _words(self.linear, self.z[0], unit)
        second = _words(self.quadratic, self.z[1], unit)
        return f"{self.effect.title} ({self.name}): changes h1 by {first}, h2 by {second}"


@dataclasses.dataclass(frozen=True, eq=False)
class EffectKernels:
    """Kernels of a model and the share that each of its effects has in them.

    Attributes:
        whole: Kernels with all effects.
        shares: One per effect, in the order of the mechanism.
    """

    whole: Kernels
    shares: tuple[EffectShare, ...]

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers and lists, for JSON."""
        rows = [
            {
                "effect": s.effect.name,
                "port": s.effect.at,
                "parameters": {k: float(v) for k, v in s.effect.values.items()},
                "linear": s.linear,
                "quadratic": s.quadratic,
                "standard_errors": [z if np.isfinite(z) else None for z in s.z],
                "statement": str(s),
            }
            for s in self.shares
        ]
        return {"whole": self.whole.to_dict(), "effects": rows}

    def __str__(self) -> str:
        width = max((len(s.name) for s in self.shares), default=6)
        head = f"{'effect':{width}}  {'h1 changes by':>16}  {'h2 changes by':>16}"
        rows = [
            f"{s.name:{width}}  {_words(s.linear, s.z[0]):>16}  {_words(s.quadratic, s.z[1]):>16}"
            for s in self.shares
        ]
        note = "As shares of the linear response; in brackets in standard errors (rms; chance gives 1)."
        return "\n".join([str(self.whole), head, *rows, note])


def effect_kernels(
    model: Mechanism | Modelled,
    data: Recording | np.ndarray,
    channel: str,
    memory: int,
    *,
    Ts: float | None = None,
    reach: int | None = None,
    blocks: int = 20,
    mirrored: bool = False,
    autocovariance: np.ndarray | None = None,
) -> EffectKernels:
    """Average kernels of a model, and their change when one effect at a time is switched off.

    Effects that every joint has (inertia, spring, motor) stay, and so do those whose amplitudes are
    zero or whose gate is. Changes need not add up: a dead zone matters more where friction is.

    Args:
        model: As in `average_kernels`, and so is what follows.
        data: Recording or voltage (N,) [V]; the same motion of the voltage is used throughout, so most of
            the noise cancels in the differences.
        channel: Output.
        memory: Number of lags.
        Ts: Sampling period [s], where `data` is a voltage.
        reach: Lags over which slopes are formed.
        blocks: Stretches that standard errors come from.
        mirrored: Average over the voltage and the same with opposite sign.
        autocovariance: Of the input, where known [V^2].

    Returns:
        Kernels of the whole and one row per effect.

    Raises:
        InputError: As `average_kernels`.
    """
    s, memory = subject(model, channel), lags_of(memory)
    run = Stretches.of(s, data, Ts, memory, reach, blocks, mirrored)
    all_on = parts(s, run, autocovariance)
    whole = kernels_of(run, all_on, channel)
    shares = []
    for i, effect in enumerate(s.mechanism.effects):
        if not _switchable(effect) or s.gates[i] == 0:
            continue
        gates = s.gates.copy()
        gates[i] = 0.0
        without = parts(s._replace(gates=gates), run, autocovariance)
        change = (a - b for a, b in zip(all_on[:3], without[:3], strict=True))
        shares.append(_share(effect, run, Parts(*change, R=all_on.R), whole))
    return EffectKernels(whole, tuple(shares))


def _switchable(effect: Effect) -> bool:
    if isinstance(effect, Linear) and not effect.searched:
        return False
    sizes = [float(effect.values[name]) for name in effect.amplitudes]
    return not sizes or any(sizes)


def _share(effect: Effect, run: Stretches, difference: Parts, whole: Kernels) -> EffectShare:
    change = kernels_of(run, difference, whole.channel)
    R, reference = whole.spread, whole.sizes[0] or 1.0
    first, second = change.errors
    linear = _beyond_chance(difference.h1, lambda h: linear_size(h, R)) / reference
    quadratic = _beyond_chance(difference.h2, lambda h: quadratic_size(h, R)) / reference
    z = (_surprise(change.h1, first, whole.h1), _surprise(change.h2, second, whole.h1))
    return EffectShare(
        effect=effect,
        change=change,
        linear=linear if z[0] else 0.0,
        quadratic=quadratic if z[1] else 0.0,
        z=z,
    )


def _surprise(change: np.ndarray, std: np.ndarray, reference: np.ndarray) -> float:
    """Root mean square of a change in standard errors, with rounding told from chance."""
    rounding = ROUNDING * (np.max(np.abs(reference)) or 1.0)
    if np.max(np.abs(change)) < rounding:
        return 0.0
    seen = std > 1e-6 * np.max(std)
    return root_mean_square(change[seen] / std[seen]) if np.max(std) > rounding else np.inf


def _beyond_chance(stretches: np.ndarray, size: Any) -> float:
    """Size of the mean less what the scatter of the stretches adds to it, both squared."""
    mean = np.mean(stretches, axis=0)
    scatter = np.mean([size(part - mean) ** 2 for part in stretches]) / (len(stretches) - 1)
    return float(np.sqrt(max(size(mean) ** 2 - scatter, 0.0)))


def _words(share: float, z: float, unit: str = "") -> str:
    """A share with its change in standard errors; chance alone is called nothing."""
    if z == 0:
        return "exactly nothing"
    if z < NOTICED:
        return f"nothing ({z:.1f}{unit})"
    if np.isinf(z):
        return f"{100 * share:.2g} % (exact)"
    return f"{100 * share:.2g} % ({z:.0f}{unit})"
