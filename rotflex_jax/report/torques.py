"""The latent and the learned torque in words."""

from typing import Any

from rotflex_jax.discover.learned_result import LearnedTorqueResult
from rotflex_jax.discover.photographs import Photographs
from rotflex_jax.discover.result import Discovery
from rotflex_jax.latent import LatentTorque
from rotflex_jax.report.wording import equation, plain_number, readable, together, units


def told_latent(lacking: Photographs) -> list[str]:
    """How large the torques are that the models lack, in words."""
    lines = []
    for port in lacking.before.ports:
        before, after = (None if x is None else x.size(port) for x in (lacking.before, lacking.after))
        line = f"At the {port} the baseline lacks {_size(before, lacking.before)}"
        lines.append(line + ("." if after is None else f", the final model {_size(after, lacking.before)}."))
    return lines


def told_learned(discovery: Discovery, learned: LearnedTorqueResult) -> dict[str, Any]:
    """A learned torque in words: what it is worth and how it reads."""
    falls, unit = [], learned.model.mechanism.units.unit
    for channel, read_in in units(discovery).items():
        old, read = readable(learned.before.held_out_rmse_windows[channel], read_in)
        new, _ = readable(learned.after.held_out_rmse_windows[channel], read_in)
        falls.append(f"{channel} {plain_number(old)} → {plain_number(new)} {read}")
    return {
        "port": learned.at,
        "kept": learned.kept,
        "falls": ", ".join(falls),
        "gain": plain_number(learned.held_out_gain_nats) + "\xa0nat",
        "formula": together(equation(f"tau = {learned.reading}")) if learned.formula.terms else "",
        "terms": [
            (
                equation(t.name) if t.name != "1" else "constant",
                f"{plain_number(t.coefficient)} ± {plain_number(1.96 * t.std, 2)} {together(unit(t.unit))}",
                f"{100 * t.share:.0f}\xa0%",
            )
            for t in learned.formula.terms
        ],
    }


def _size(size: float | None, torque: LatentTorque) -> str:
    if size is None or size < 1e-3 * torque.scale:
        return "nothing that could be seen"
    return (
        together(f"{plain_number(size, 2)} {torque.effort}")
        + f" rms, {plain_number(100 * size / torque.scale, 2)} % of the motor's torque"
    )
