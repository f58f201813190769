"""What a notebook shows: results as tables with small plots, a search while it runs, a model under sliders.

Nothing here is loaded before a notebook asks for it, and none of it needs matplotlib but `explore`.
"""

from typing import TYPE_CHECKING, Any

from rotflex_jax.notebook.live import Live, live

if TYPE_CHECKING:
    from rotflex_jax.notebook.explorer import Explorer

__all__ = ["Live", "explore", "live"]


def explore(model: Any, recordings: Any, test: Any = None, **settings: Any) -> "Explorer":
    """A model under sliders: effects on and off, one parameter moved, and the error that follows.

    Not for finding parameters: a slider changes one parameter at a time, a fit all of them. It needs
    ipywidgets (`pip install "rotflex_jax[notebook]"`).

    Args:
        model: Fit, Model, Mechanism or Discovery.
        recordings: Recording that is drawn, or several, of which the first is drawn.
        test: Recordings whose error is shown; the same ones if None.
        settings: Other arguments of `Explorer`, such as `candidates` and `window_seconds`.

    Returns:
        Explorer; the last line of a cell shows it.

    Raises:
        InputError: ipywidgets is missing, or the model does not fit the recording.
    """
    from rotflex_jax.notebook.explorer import Explorer  # widgets and matplotlib only where they are wanted

    return Explorer(model, recordings, test, **settings)
