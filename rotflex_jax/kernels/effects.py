"""Contribution of each effect to the kernels: those with all effects less those with one switched off."""

import dataclasses
from typing import Any

import numpy as np
from jaxtyping import Real

from rotflex_jax.effects.base import Effect
from rotflex_jax.kernels.average import AveragingRun, BlockKernels, block_kernels, kernels_of
from rotflex_jax.kernels.result import Kernels, linear_size, quadratic_size, root_mean_square
from rotflex_jax.kernels.sensitivities import Modelled, lags_of, output_model
from rotflex_jax.mechanism.mechanism import Mechanism
from rotflex_jax.recording import Recording

DETECTED_STANDARD_ERRORS = 2.0
"""A smaller change (rms over the kernel) is reported as nothing; chance gives about one."""
ROUNDING_SHARE = 1e-9
"""Changes and errors below this share of the linear kernel are rounding."""


@dataclasses.dataclass(frozen=True, eq=False)
class EffectShare:
    """Contribution of one effect to the kernels.

    Attributes:
        effect: The effect, with its parameter values.
        change: Kernels with it less kernels without it; standard errors of the difference.
        linear: Size of the change of `h1` as a share of the linear response, less its expected noise.
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
    data: Recording | Real[np.ndarray, " N"],
    channel: str,
    memory: int,
    *,
    Ts: float | None = None,
    reach: int | None = None,
    blocks: int = 20,
    mirrored: bool = False,
    autocovariance: Real[np.ndarray, " _"] | None = None,
) -> EffectKernels:
    """Average kernels of a model, and their change when one effect at a time is switched off.

    Effects that every joint has (inertia, spring, motor) are not switched off, nor those that are inactive
    already. Changes need not add up: a dead zone changes more where friction acts too.

    Args:
        model: As in `average_kernels`, and so is what follows.
        data: Recording or voltage [V]; the same input is used throughout, so most of the noise cancels in
            the differences.
        channel: Output.
        memory: Number of lags.
        Ts: Sampling period [s], where `data` is a voltage.
        reach: Lags of the output derivatives.
        blocks: Blocks that standard errors come from.
        mirrored: Average over the voltage and the same with opposite sign.
        autocovariance: Of the input, where known [V^2].

    Returns:
        Kernels of the whole and one row per effect.

    Raises:
        InputError: As `average_kernels`.
    """
    s, memory = output_model(model, channel), lags_of(memory)
    run = AveragingRun.of(s, data, Ts, memory, reach, blocks, mirrored)
    all_on = block_kernels(s, run, autocovariance)
    whole = kernels_of(run, all_on, channel)
    shares = []
    for i, effect in enumerate(s.mechanism.effects):
        if not _switchable(effect) or s.gates[i] == 0:
            continue
        gates = s.gates.copy()
        gates[i] = 0.0
        without = block_kernels(s._replace(gates=gates), run, autocovariance)
        change = (a - b for a, b in zip(all_on[:3], without[:3], strict=True))
        shares.append(_share(effect, run, BlockKernels(*change, R=all_on.R), whole))
    return EffectKernels(whole, tuple(shares))


def _switchable(effect: Effect) -> bool:
    if effect.is_linear and not effect.searched:
        return False
    sizes = [float(effect.values[name]) for name in effect.amplitudes]
    return not sizes or any(sizes)


def _share(effect: Effect, run: AveragingRun, difference: BlockKernels, whole: Kernels) -> EffectShare:
    change = kernels_of(run, difference, whole.channel)
    R, reference = whole.spread, whole.sizes[0] or 1.0
    first, second = change.errors
    linear = _size_without_noise(difference.h1, lambda h: linear_size(h, R)) / reference
    quadratic = _size_without_noise(difference.h2, lambda h: quadratic_size(h, R)) / reference
    z = (_standardised_change(change.h1, first, whole.h1), _standardised_change(change.h2, second, whole.h1))
    return EffectShare(
        effect=effect,
        change=change,
        linear=linear if z[0] else 0.0,
        quadratic=quadratic if z[1] else 0.0,
        z=z,
    )


def _standardised_change(change: np.ndarray, std: np.ndarray, reference: np.ndarray) -> float:
    """Root mean square of a change in standard errors; zero or infinite where only rounding scatters."""
    rounding = ROUNDING_SHARE * (np.max(np.abs(reference)) or 1.0)
    if np.max(np.abs(change)) < rounding:
        return 0.0
    seen = std > 1e-6 * np.max(std)
    return root_mean_square(change[seen] / std[seen]) if np.max(std) > rounding else np.inf


def _size_without_noise(blocks: np.ndarray, size: Any) -> float:
    """Size of the mean less what the scatter of the blocks adds to it, both squared."""
    mean = np.mean(blocks, axis=0)
    scatter = np.mean([size(block - mean) ** 2 for block in blocks]) / (len(blocks) - 1)
    return float(np.sqrt(max(size(mean) ** 2 - scatter, 0.0)))


def _words(share: float, z: float, unit: str = "") -> str:
    """A share with its change in standard errors; chance alone is reported as nothing."""
    if z == 0:
        return "exactly nothing"
    if z < DETECTED_STANDARD_ERRORS:
        return f"nothing ({z:.1f}{unit})"
    if np.isinf(z):
        return f"{100 * share:.2g} % (exact)"
    return f"{100 * share:.2g} % ({z:.0f}{unit})"
