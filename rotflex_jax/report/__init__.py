"""Reports of a search: one self-contained HTML page, its figures, and tables for a terminal."""

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
    """Writes `report.html` (self-contained) and `result.json` into a folder, which is created if needed.

    Args:
        discovery: Result of a search.
        folder: Folder for the files; files with these names are replaced.
        explanation: Further results that the report shows, from `Discovery.explanation`. A learned torque is
            also written to `learned_torque.json`.

    Returns:
        Path of the HTML page.

    Raises:
        InputError: The folder is a file, or cannot be written to.
    """
    from rotflex_jax.report.page import write  # loads matplotlib, so only on request

    return write(discovery, Path(folder), explanation)
