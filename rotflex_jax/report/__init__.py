"""What a person reads of a search: one self-contained HTML page, its figures, and tables for a terminal."""

from pathlib import Path
from typing import TYPE_CHECKING

from rotflex_jax.report.tables import parameter_table, summary_table

if TYPE_CHECKING:
    from rotflex_jax.discover.explanation import Explanation
    from rotflex_jax.discover.result import SearchResult

__all__ = ["parameter_table", "summary_table", "write_report"]


def write_report(
    discovery: "SearchResult", folder: str | Path, explanation: "Explanation | None" = None
) -> Path:
    """Write `report.html` (self-contained) and `result.json` into a folder, which is created.

    Args:
        discovery: What was found.
        folder: Where to write; files of these names are replaced.
        explanation: What else is shown, from `Discovery.explanation`; a learned torque goes into
            `learned_torque.json` too.

    Returns:
        Path of the HTML page.

    Raises:
        InputError: The folder is a file, or cannot be written to.
    """
    from rotflex_jax.report.page import write  # matplotlib is loaded only where it draws

    return write(discovery, Path(folder), explanation)
