"""Displays for notebooks: a search while it runs, and a model with sliders for its parameters.

Nothing here is loaded before a notebook needs it, and only `explore` needs matplotlib.
"""

from typing import TYPE_CHECKING, Any

from rotflex_jax.notebook.live import Live, live

if TYPE_CHECKING:
    from rotflex_jax.notebook.explorer import Explorer

__all__ = ["Live", "explore", "live"]


def explore(model: Any, recordings: Any, test: Any = None, **settings: Any) -> "Explorer":
    """Widgets that switch effects, change parameters, and show the resulting error of the model.

    Not for the estimation of parameters: a slider changes one parameter at a time, a fit changes all of them.
    It needs ipywidgets (`pip install "rotflex_jax[notebook]"`).

    Args:
        model: Fit, Model, Mechanism or Discovery.
        recordings: One or several recordings; the first is drawn.
        test: Recordings whose error is shown; `recordings` if None.
        settings: Other arguments of `Explorer`, such as `candidates` and `window_seconds`.

    Returns:
        Explorer; a notebook displays it if it is the last line of a cell.

    Raises:
        InputError: ipywidgets is missing, or the model does not fit the recording.
    """
    from rotflex_jax.notebook.explorer import Explorer  # loads matplotlib, so only on request

    return Explorer(model, recordings, test, **settings)
