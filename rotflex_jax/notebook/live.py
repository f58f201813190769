"""Display of a running search in a notebook: the held-out errors after each effect that was added."""

import sys
import time
from typing import Any

from rotflex_jax.discover.checkpoint import Milestone, TimeLeft
from rotflex_jax.text.markup import card, paragraph, picture
from rotflex_jax.text.svg import staircase

# Least time between two drawings [s], so that the notebook does not flicker; a milestone is drawn at once.
REDRAW_PAUSE = 0.2


def in_notebook() -> bool:
    """Whether this process is the kernel of a notebook; the check imports nothing."""
    shell = sys.modules.get("IPython")
    here = shell.get_ipython() if shell is not None else None
    return here is not None and getattr(here, "kernel", None) is not None


class Live:
    """Callable for the argument `progress` of a search, which displays its held-out errors so far.

    Attributes:
        labels: Label of each model found so far.
        errors: Channel with its unit -> held-out error of each model.
        floor: Channel with its unit -> noise of the sensor.
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
        """Shows a line of progress."""
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

    In a notebook it shows the present step of the search, and below it a plot of the held-out errors so far.
    Outside a notebook it shows nothing.

    Args:
        title: Title of the display.

    >>> follow = live()
    >>> follow("round 1: scoring 40 candidates")  # outside a notebook nothing is shown
    """
    if not in_notebook():
        return Live(title)
    from IPython.display import display  # in a notebook it is loaded already

    follow = Live(title)
    follow._handle = display(follow, display_id=True)
    return follow
