"""What one turn of the loop finds: models with their errors, effects that were added, places of failure."""

import dataclasses
import math
from typing import Any

import numpy as np

from rotflex_jax.model import Model
from rotflex_jax.parameters import Estimate


@dataclasses.dataclass(frozen=True)
class Stage:
    """One model of the loop, fitted and scored on recordings it never saw.

    Attributes:
        model: Fitted model.
        estimates: Parameters with intervals; calibrations (offset, bias) among them.
        held_out_rmse: Channel -> error of one free run over the held-out recordings.
        held_out_rmse_windows: Channel -> error of free runs that start anew every `window_seconds`.
        simulated: Free run over each held-out recording (N, C).
        windowed: The same, started anew every `window_seconds`.
        window_seconds: [s].
        process_noise: Port -> intensity of the process torque that the data ask for [(N m)^2 s]; small
            where the model is right.
        process_noise_nats: Log-likelihood that the process torque gains; near zero where the model is right.
        log_likelihood: Of the held-out recordings [nat].
    """

    model: Model
    estimates: tuple[Estimate, ...]
    held_out_rmse: dict[str, float]
    held_out_rmse_windows: dict[str, float]
    simulated: tuple[np.ndarray, ...]
    windowed: tuple[np.ndarray, ...]
    window_seconds: float
    process_noise: dict[str, float]
    process_noise_nats: float
    log_likelihood: float

    def errors(self) -> dict[str, Any]:
        """The two held-out errors as plain JSON."""
        return {
            "held_out_rmse": plain(self.held_out_rmse),
            "held_out_rmse_windows": {
                "seconds": self.window_seconds,
                **plain(self.held_out_rmse_windows),
            },
        }


@dataclasses.dataclass(frozen=True)
class Round:
    """One turn of the loop: an effect that was added.

    Attributes:
        effect: Name of the effect.
        port: Where it acts.
        equivalent: Other (effect, port) that these recordings cannot tell from it.
        parameters: Its own estimates, by short name.
        stage: The model with it, refitted and scored.
        score: Penalised score that put it forward [nat].
        held_out_gain_nats: Gain in held-out log-likelihood [nat].
        sentence: What was found, in words.
        equation: Its law.
    """

    effect: str
    port: str
    equivalent: tuple[tuple[str, str], ...]
    parameters: dict[str, Estimate]
    stage: Stage
    score: float
    held_out_gain_nats: float
    sentence: str
    equation: str

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON types."""
        return {
            "effect": self.effect,
            "port": self.port,
            "equivalent": [{"effect": e, "port": p} for e, p in self.equivalent],
            "parameters": {n: e.to_dict() for n, e in self.parameters.items()},
            **self.stage.errors(),
            "evidence": {
                "score": _number(self.score),
                "held_out_gain_nats": _number(self.held_out_gain_nats),
            },
            "sentence": self.sentence,
            "equation": self.equation,
        }


@dataclasses.dataclass(frozen=True)
class Ranked:
    """One candidate as the score test of the baseline saw it.

    Attributes:
        effect: Name of the effect.
        port: Where it would act.
        score: Penalised score [nat]; negative where the data speak against it.
        excited: False where this recording could not have shown an effect of a plausible size.
        unconfounded: Share of its trace in the outputs that the baseline cannot imitate, 0 to 1.
        smallest: Factor of a plausible size that would just have been seen.
    """

    effect: str
    port: str
    score: float
    excited: bool
    unconfounded: float
    smallest: float

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON types."""
        return {
            "effect": self.effect,
            "port": self.port,
            "score": _number(self.score),
            "excited": self.excited,
            "unconfounded": _number(self.unconfounded),
        }


@dataclasses.dataclass(frozen=True)
class Where:
    """One statement of where the model fails.

    Attributes:
        statement: A plain sentence.
        share: Share of the squared error that it speaks of.
        p_value: Chance of such a share if the error were spread evenly.
        kind: time, frequency, speed, deflection or reversal.
        channel: Whose error.
        edges: Bin edges [unit].
        profile: Share of the squared error in each bin.
        expected: Share of the samples (for frequency: of the noise) in each bin.
        unit: Of the edges.
    """

    statement: str
    share: float
    p_value: float
    kind: str
    channel: str
    edges: np.ndarray
    profile: np.ndarray
    expected: np.ndarray
    unit: str

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON types."""
        return {
            "statement": self.statement,
            "share": _number(self.share),
            "p_value": _number(self.p_value),
            "kind": self.kind,
            "channel": self.channel,
        }


def _number(value: float) -> float | None:
    """A float that JSON can carry."""
    return float(value) if math.isfinite(value) else None


def plain(values: dict[str, float]) -> dict[str, float | None]:
    """Floats that JSON can carry."""
    return {k: _number(v) for k, v in values.items()}
