"""A search while it runs: the staircase of held-out errors grows in the notebook with every effect added."""

import sys
import time
from typing import Any

from rotflex_jax.discover.checkpoint import Milestone, TimeLeft
from rotflex_jax.text.markup import card, paragraph, picture
from rotflex_jax.text.svg import staircase

# Redrawing more often than this [s] only makes a notebook flicker; a milestone is drawn at once.
REDRAW_PAUSE = 0.2


def in_notebook() -> bool:
    """Whether this process is the kernel of a notebook; nothing is loaded to find out."""
    shell = sys.modules.get("IPython")
    here = shell.get_ipython() if shell is not None else None
    return here is not None and getattr(here, "kernel", None) is not None


class Live:
    """Follows a search, as its `progress`.

    Attributes:
        labels: One per model that was found so far.
        errors: Channel with its unit -> held-out error of each model.
        floor: The same channel -> noise of its sensor.
    """

    def __init__(self, title: str, handle: Any = None) -> None:
        self.title = title
        self.labels: list[str] = []
        self.errors: dict[str, list[float]] = {}
        self.floor: dict[str, float] = {}
        self._line = ""
        self._handle = handle
        self._shown = 0.0
        self._time_left = TimeLeft()

    def __call__(self, line: str) -> None:
        """Show a line of progress."""
        self._time_left.follow(line)
        new = isinstance(line, Milestone)
        if isinstance(line, Milestone):
            self.labels.append(line.label)
            for channel, unit in line.units.items():
                name, factor = f"{channel} [{unit}]", line.factors[channel]
                self.errors.setdefault(name, []).append(factor * line.errors[channel])
                self.floor[name] = factor * line.floor[channel]
        self._line = str(line).strip()
        now = time.perf_counter()
        if self._handle is not None and (new or now - self._shown > REDRAW_PAUSE):
            self._shown = now
            self._handle.update(self)

    def _repr_html_(self) -> str:
        svg = staircase(self.labels, self.errors, self.floor)
        return card(
            self.title,
            paragraph(f"{self._line or 'starting'} ({self._time_left.words()})"),
            picture(svg, "Held-out error of each model so far, with the noise of the sensor."),
        )

    def __repr__(self) -> str:
        return f"{self.title}: {self._line or 'starting'}"


def live(title: str = "Looking for what is missing") -> Live:
    """Progress of a search for a notebook: `rf.discover(joint, train, test, progress=rf.live())`.

    In a notebook one line says what is being done, above the staircase of held-out errors so far. Anywhere
    else it is silent and costs nothing.

    Args:
        title: Shown above it.

    >>> follow = live()
    >>> follow("round 1: scoring 40 candidates")  # outside a notebook nothing is shown
    """
    if not in_notebook():
        return Live(title)
    from IPython.display import display  # only where it is loaded already

    follow = Live(title)
    follow._handle = display(follow, display_id=True)
    return follow
