"""Recordings with a known truth: `make_record` computes `u` and `y` for the names of hidden effects."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import asdict, fields, replace
from typing import Any

import numpy as np
from jaxtyping import Float

from rotflex_jax.arena.simulator.excite import INPUTS, voltage
from rotflex_jax.arena.simulator.hidden import ABSORBED, DEFAULTS, EQUIVALENT, OUTSIDE, UNSEEN, parameters
from rotflex_jax.arena.simulator.laws import Place, laws
from rotflex_jax.arena.simulator.plant import Plant, simulate
from rotflex_jax.arena.simulator.sensors import read

__all__ = [
    "ABSORBED",
    "COUNT",
    "DEFAULTS",
    "EQUIVALENT",
    "INPUTS",
    "JITTER",
    "OUTSIDE",
    "UNSEEN",
    "make_record",
    "perturbed",
]

COUNT = 2 * np.pi / 4096
"""One count of the encoders [rad]."""

JITTER = 3e-4
"""Standard deviation of the noise of the angles before quantisation [rad]."""

TRUSTED = {"J_arm", "R_m", "k_m", "K_g", "eta"}
"""Constants that a user knows; `k_t` stands for the unknown torque gain, so `eta` keeps its value."""


def perturbed(rng: np.random.Generator, spread: float, nominal: Plant | None = None) -> Plant:
    """A plant whose unknown constants are uniform within ``1 +- spread`` of the nominal ones."""
    nominal = nominal or Plant()
    factors = rng.uniform(1 - spread, 1 + spread, len(fields(Plant)))
    return replace(
        nominal,
        **{
            name: value * factor
            for (name, value), factor in zip(asdict(nominal).items(), factors, strict=True)
            if name not in TRUSTED
        },
    )


def _measured(angles: Float[np.ndarray, "N 2"], rng: np.random.Generator) -> Float[np.ndarray, "N 2"]:
    """Readings of an encoder: angles with noise, rounded to whole counts."""
    counts = np.round((angles + JITTER * rng.standard_normal(angles.shape)) / COUNT)
    return COUNT * (counts + 0.0)  # no minus zero


def make_record(
    effects: Mapping[Place, Mapping[str, float] | float] | Iterable[Place] = (),
    kind: str = "noise",
    seed: int = 0,
    size: float = 1.0,
    seconds: float = 20.0,
    fs: float = 500.0,
    perturb: float = 0.2,
    rms: float = 1.0,
    nominal: Plant | None = None,
    played: Float[np.ndarray, " N"] | None = None,
) -> dict[str, Any]:
    """A recording of a perturbed joint with hidden effects, started from rest at zero.

    Input, plant and noise have separate random streams: the same seed with other effects gives the same
    experiment on the same hardware.

    Args:
        effects: names and ports; a mapping also gives parameters, or a factor on `size`, for every effect.
        kind: input, a key of `INPUTS`.
        seed: seed of the whole record.
        size: strength of the effects relative to `DEFAULTS`.
        seconds: length [s].
        fs: sampling rate [Hz].
        perturb: largest relative error of the unknown constants of the nominal plant.
        rms: expected root mean square of the input [V].
        nominal: plant before perturbation; the paper's joint if omitted.
        played: voltage [V] ``(N,)`` instead of one of the `INPUTS`, with its own length and size.

    Returns:
        `u` [V] ``(N,)``; `y` [rad] ``(N, 2)``, readings of the encoders (theta, alpha); `Ts` [s]; `clean`,
        the readings without noise and quantisation; `state`, the true ``(theta, alpha, theta', alpha')``;
        and `truth`, a dictionary that can be written as JSON.

    Raises:
        ValueError: if an effect, one of its parameters or the input is unknown.
    """
    streams = np.random.SeedSequence(seed).spawn(3)
    of_input, of_plant, of_noise = (np.random.default_rng(s) for s in streams)
    if not isinstance(effects, Mapping):
        effects = dict.fromkeys(effects, 1.0)
    hidden: dict[Place, dict[str, float]] = {}
    for place, given in effects.items():
        if isinstance(given, Mapping):
            hidden[place] = parameters(place, size)
            unknown = set(given) - set(hidden[place])
            if unknown:
                raise ValueError(
                    f"{place[0]} has no {', '.join(sorted(unknown))}; "
                    f"its parameters are {', '.join(hidden[place])}."
                )
            hidden[place].update(given)
        else:
            hidden[place] = parameters(place, size * given)
    joint, tables = perturbed(of_plant, perturb, nominal), laws(hidden)
    u = voltage(kind, round(seconds * fs), fs, of_input, rms) if played is None else np.round(played, 6)
    state = simulate(joint, tables, u, 1 / fs)
    clean = read(state[:, :2], tables.sensors)
    return {
        "u": u,
        "y": _measured(clean, of_noise),
        "Ts": 1 / fs,
        "clean": clean,
        "state": state,
        "truth": {
            "effects": [
                {"effect": effect, "port": port, "parameters": values}
                for (effect, port), values in hidden.items()
            ],
            "plant": asdict(joint),
            "input": kind if played is None else "played",
            "seed": seed,
            "size": size,
            "perturb": perturb,
            "encoder_count": COUNT,
            "encoder_jitter": JITTER,
        },
    }
