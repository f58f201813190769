"""A model under sliders: switch effects, change a parameter, and see what it does to the run."""

import dataclasses
import io
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import scipy
from jaxtyping import Float
from matplotlib.figure import Figure

from rotflex_jax.discover.discovery import Discovery
from rotflex_jax.effects.base import Effect
from rotflex_jax.effects.labels import effect_label
from rotflex_jax.errors import InputError, optional
from rotflex_jax.fit.result import Fit
from rotflex_jax.mechanism import Mechanism
from rotflex_jax.metrics import windowed_rmse
from rotflex_jax.models.model import Model
from rotflex_jax.recording import Recording
from rotflex_jax.recording.listing import listed
from rotflex_jax.text.colours import BASELINE, FINAL, MEASURED, NO_DATA
from rotflex_jax.text.markup import card, paragraph, table
from rotflex_jax.text.numbers import plain_number, readable, unit_text
from rotflex_jax.text.plotting import blank, legend_above, styled, thinned

# Cells of the map of errors along each axis, and samples without which one stays blank.
ERROR_MAP_CELLS, ERROR_MAP_MIN_SAMPLES = 15, 5
# Half width of the window in which a speed is taken from positions [s].
SPEED_HALF_WINDOW = 0.03


def _cells(
    error: np.ndarray, seen: np.ndarray, over: tuple[np.ndarray, np.ndarray], edges: list[np.ndarray]
) -> np.ma.MaskedArray:
    """Root mean square of an error in cells that have been visited often enough."""
    total = np.histogram2d(*over, edges, weights=error**2)[0]
    return np.ma.masked_where(seen < ERROR_MAP_MIN_SAMPLES, np.sqrt(total / np.maximum(seen, 1)))


@styled
def _figure(
    recording: Recording, y: np.ndarray, given: np.ndarray, now: np.ndarray, units: Mapping[str, str]
) -> Figure:
    """Runs to the left, the error of the last one to the right."""
    count = len(units)
    figure = blank(10.0, 1.9 * count + 0.5)
    axes = figure.subplots(count, 2, width_ratios=(1.9, 1.0), squeeze=False)
    scale, read = zip(*(readable(1.0, unit) for unit in units.values()), strict=True)
    window = 2 * max(2, round(SPEED_HALF_WINDOW / recording.Ts)) + 1
    speed = scale[0] * scipy.signal.savgol_filter(y[:, 0], window, 2, deriv=1, delta=recording.Ts)
    against = scale[-1] * y[:, -1] if count > 1 else recording.t
    names = list(units)
    over = f"{names[-1]} [{read[-1]}]" if count > 1 else "time [s]"
    for c, channel in enumerate(units):
        left, right = axes[c]
        for run, colour, style, label, width in (
            (y, MEASURED, "-", "measured", 2.5),
            (given, BASELINE, "--", "as given", 1.0),
            (now, FINAL, "-", "now", 1.0),
        ):
            left.plot(
                *thinned(recording.t, scale[c] * run[:, c]), color=colour, ls=style, lw=width, label=label
            )
        left.set_ylabel(f"{channel} [{read[c]}]")
        left.set_xlabel("time [s]")
        edges = [
            np.linspace(np.quantile(x, 0.005), np.quantile(x, 0.995), ERROR_MAP_CELLS + 1)
            for x in (speed, against)
        ]
        seen = np.histogram2d(speed, against, edges)[0]
        now_rms, given_rms = (
            _cells(scale[c] * (y[:, c] - run[:, c]), seen, (speed, against), edges) for run in (now, given)
        )
        # The scale holds the model as given, so that a better one looks paler.
        worst = max(float(np.ma.max(m)) if m.count() else 0.0 for m in (now_rms, given_rms)) or 1.0
        mesh = right.pcolormesh(*edges, now_rms.T, cmap="YlOrRd", vmin=0.0, vmax=worst)
        right.set_facecolor(NO_DATA)
        right.grid(False)
        right.set_xlabel(f"speed of {names[0]} [{read[0]}/s]")
        right.set_ylabel(over)
        figure.colorbar(mesh, ax=right, label=f"rms error of {channel} [{read[c]}]")
    legend_above(figure, axes[:, 0])
    return figure


def overlay(
    recording: Recording,
    y: Float[np.ndarray, "N C"],
    given: Float[np.ndarray, "N C"],
    now: Float[np.ndarray, "N C"],
    units: Mapping[str, str],
) -> bytes:
    """A PNG of three runs over time, and of the error over speed and deflection.

    Args:
        recording: What is drawn.
        y: Its measured channels in the order of the model (N, C).
        given: Run of the model as it was given (N, C).
        now: Run of the model as it stands (N, C).
        units: Channel -> its unit.
    """
    buffer = io.BytesIO()
    _figure(recording, y, given, now, units).savefig(buffer, format="png", dpi=90)
    return buffer.getvalue()


# A slider changes a parameter by up to this power of ten, either way.
SLIDER_DECADES = 1.0


class Explorer:
    """A model, recordings, and widgets that change the one and show what it does to the other.

    Every state of the widgets runs through one compilation: switches are gates, parameters are values.

    Attributes:
        model: As it stands under the widgets.
        errors: Channel -> root mean square error of short free runs over `test` [unit].
        given: The same of the model as it was given.
        switches: Effect, as "coulomb at hub" -> its checkbox.
        parameter: Which parameter the slider changes.
        factor: Slider: the parameter as a multiple of its given value.
    """

    def __init__(
        self,
        model: Fit | Model | Mechanism | Discovery,
        recordings: Recording | Sequence[Recording],
        test: Recording | Sequence[Recording] | None = None,
        *,
        candidates: Iterable[Effect] = (),
        window_seconds: float = 2.0,
    ) -> None:
        """Builds the widgets and shows the model as it is.

        Args:
            model: What is explored.
            recordings: Recording that is drawn, or several, of which the first is drawn.
            test: Recordings whose error is shown; the same ones if None.
            candidates: Effects with their parameters that can be switched on; at first they are off.
            window_seconds: Free runs are restarted after so long [s].
        """
        widgets = optional("ipywidgets", "Exploring a model")
        bare = model if isinstance(model, Mechanism) else _model(model).mechanism
        offered = [c for c in candidates if (c.name, c.at) not in {(e.name, e.at) for e in bare.effects}]
        for effect in offered:
            bare = bare + effect
        solver = {} if isinstance(model, Mechanism) else {"solver": _model(model).solver}
        off = {(e.name, e.at) for e in offered}
        gates = tuple(0.0 if (e.name, e.at) in off else 1.0 for e in bare.effects)
        self._given_model = Model(bare, gates=gates, **solver)
        self._drawn = listed(recordings)[0]
        self._test = listed(recordings if test is None else test)
        self._seconds = window_seconds
        self._units = {c: self._drawn.units[self._drawn.channels.index(c)] for c in bare.channels}
        self.switches = {
            effect_label(e.name, e.at): widgets.Checkbox(
                value=(e.name, e.at) not in off, description=effect_label(e.name, e.at), indent=False
            )
            for e in bare.effects
            if _can_be_off(e)
        }
        specs = zip(bare.parameter_names, bare.parameter_specifications, strict=True)
        self._unit = {name: unit_text(spec.unit) for name, spec in specs}
        self.parameter = widgets.Dropdown(options=list(self._unit), description="parameter")
        self.factor = widgets.FloatLogSlider(
            value=1.0,
            min=-SLIDER_DECADES,
            max=SLIDER_DECADES,
            step=0.01,
            description="times",
            continuous_update=False,
        )
        self._text, self._image = widgets.HTML(), widgets.Image(format="png")
        self._given_values = dict(zip(bare.parameter_names, bare.values.tolist(), strict=True))
        self._factors: dict[str, float] = {}
        self._silent = False
        self.model = self._given_model
        self.given = self.errors = self._errors(self._given_model)
        for box in self.switches.values():
            box.observe(self._changed, "value")
        self.factor.observe(self._changed, "value")
        self.parameter.observe(self._chosen, "value")
        left = widgets.VBox([*self.switches.values(), self.parameter, self.factor])
        self.box = widgets.VBox([widgets.HBox([left, self._text]), self._image])
        self._show()

    def reset(self) -> None:
        """Everything as it was given."""
        on = {effect_label(e.name, e.at): g > 0 for e, g in self._pairs()}
        self._factors = {}
        self._silently(lambda: [setattr(b, "value", on[label]) for label, b in self.switches.items()])
        self._silently(lambda: setattr(self.factor, "value", 1.0))
        self._changed(None)

    def _pairs(self) -> list[tuple[Effect, float]]:
        gates = self._given_model.gates or ()
        return list(zip(self._given_model.mechanism.effects, gates, strict=True))

    def _silently(self, change: Callable[[], Any]) -> None:
        """Changes widgets without a simulation for each."""
        self._silent = True
        try:
            change()
        finally:
            self._silent = False

    def _chosen(self, change: Any) -> None:
        """Another parameter was chosen: the slider shows its factor."""
        name = self.parameter.value
        self._silently(lambda: setattr(self.factor, "value", self._factors.get(name, 1.0)))
        self._show()

    def _changed(self, change: Any) -> None:
        if self._silent:
            return
        if self.factor.value != self._factors.get(self.parameter.value, 1.0):
            self._factors[self.parameter.value] = self.factor.value
        gates = tuple(
            float(self.switches[label].value) if (label := effect_label(e.name, e.at)) in self.switches else g
            for e, g in self._pairs()
        )
        changed = {name: factor * self._given_values[name] for name, factor in self._factors.items()}
        self.model = dataclasses.replace(
            self._given_model, mechanism=self._given_model.mechanism.with_values(changed), gates=gates
        )
        self.errors = self._errors(self.model)
        self._show()

    def _errors(self, model: Model) -> dict[str, float]:
        """Root mean square error of short free runs, what a run may see not counted."""
        measured = [model.measured(r) for r in self._test]
        runs = [model.simulate_windows(r, self._seconds) for r in self._test]
        rms = windowed_rmse(self._test, measured, runs, self._seconds)
        return dict(zip(model.mechanism.channels, rms.tolist(), strict=True))

    def _show(self) -> None:
        rows = []
        for channel, now in self.errors.items():
            before = self.given[channel]
            change = f"{100 * (now / before - 1):+.1f} %".replace("-", "−") if before > 0 else ""
            read = readable(1.0, self._units[channel])
            rows.append((channel, read[1], *(plain_number(read[0] * e) for e in (before, now)), change))
        name = self.parameter.value
        value = self._factors.get(name, 1.0) * self._given_values[name]
        self._text.value = card(
            f"Error of free runs of {self._seconds:g} s",
            table(("channel", "unit", "as given", "now", "change"), rows, words=2),
            paragraph(f"{name} = {value:.4g} {self._unit[name]}".rstrip()),
        )
        given, now = (m.simulate_windows(self._drawn, self._seconds) for m in (self._given_model, self.model))
        measured = self.model.measured(self._drawn)
        self._image.value = overlay(self._drawn, measured, given, now, self._units)

    def _ipython_display_(self) -> None:
        from IPython.display import display  # a notebook asks, so it is there

        display(self.box)


def _model(given: Any) -> Model:
    if isinstance(given, Model):
        return given
    if isinstance(given, (Fit, Discovery)):
        return given.model
    raise InputError(
        f"A model was expected, but a {type(given).__name__} was given; give a Fit, Model, Mechanism or "
        "Discovery."
    )


def _can_be_off(effect: Effect) -> bool:
    """Without inertia, spring or motor there is no machine; everything else can be left out."""
    return not effect.is_linear or effect.name.startswith("viscous")
