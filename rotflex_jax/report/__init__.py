"""What a person reads: one self-contained HTML page, its figures, and tables for a terminal."""

from pathlib import Path
from typing import TYPE_CHECKING

from rotflex_jax.report.tables import parameter_table, summary_table

if TYPE_CHECKING:
    from rotflex_jax.discover.result import Discovery

__all__ = ["parameter_table", "summary_table", "write_report"]


def write_report(discovery: "Discovery", folder: str | Path, *, learned: bool | None = None) -> Path:
    """Write `report.html` (self-contained) and `result.json` into a folder, which is created.

    Args:
        discovery: What was found.
        folder: Where to write; files of these names are replaced.
        learned: Whether to learn a torque for what is left, `learned_torque.json` beside the page; where
            the verdict is `unexplained` if None.

    Returns:
        Path of the HTML page.

    Raises:
        InputError: The folder is a file, or cannot be written to.
    """
    from rotflex_jax.report.html import write  # matplotlib is loaded only where it draws

    return write(discovery, Path(folder), learned)
