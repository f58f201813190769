"""The report of a search as one HTML page."""

import json
from pathlib import Path
from typing import Any

from rotflex_jax.discover.learned_result import LearnedTorqueResult
from rotflex_jax.discover.photographs import Photographs
from rotflex_jax.discover.result import Discovery
from rotflex_jax.errors import InputError
from rotflex_jax.report.content import content
from rotflex_jax.report.page import save, template


def write(discovery: Discovery, folder: Path, learned: bool | None = None) -> Path:
    """Write `report.html` and `result.json`; returns the path of the page.

    Args:
        discovery: What was found.
        folder: Where to write.
        learned: Whether to learn a torque for what is left; where the verdict is `unexplained` if None.
    """
    save(folder, {"result.json": _json(discovery.to_dict())})
    lacking, taught = discovery.latent_torque(), None
    if discovery.verdict == "unexplained" if learned is None else learned:
        taught = _taught(discovery, lacking)
    if taught is not None:
        save(folder, {"learned_torque.json": _json(taught.to_dict())})
    save(folder, {"report.html": render(discovery, lacking, taught)})
    return folder / "report.html"


def render(
    discovery: Discovery, lacking: Photographs | None = None, learned: LearnedTorqueResult | None = None
) -> str:
    """The page as text, with the latent torques and the learned torque where they are given."""
    return template("report.html.j2").render(content(discovery, lacking, learned))


def _taught(discovery: Discovery, lacking: Photographs) -> LearnedTorqueResult | None:
    """A torque learned where most is left; None where no sensor tells how that port moves."""
    gains = (lacking.after or lacking.before).gain_nats
    try:
        return discovery.learned_torque(max(gains, key=lambda port: gains[port]))
    except InputError:
        return None


def _json(values: dict[str, Any]) -> str:
    return json.dumps(values, indent=2, ensure_ascii=False) + "\n"
