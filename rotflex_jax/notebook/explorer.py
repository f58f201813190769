"""Widgets for a model: switches of effects and sliders of parameters, with the resulting run and error."""

import io
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import scipy
from jaxtyping import Float
from matplotlib.figure import Figure

from rotflex_jax.discover.discovery import Discovery
from rotflex_jax.effects import CATALOG
from rotflex_jax.effects.base import Effect
from rotflex_jax.effects.labels import effect_label
from rotflex_jax.errors import InputError, optional
from rotflex_jax.fit.greybox import fit
from rotflex_jax.fit.result import Fit
from rotflex_jax.joints.by_name import choose
from rotflex_jax.mechanism import Mechanism
from rotflex_jax.mechanism.roles import search_places
from rotflex_jax.metrics import windowed_rmse
from rotflex_jax.models.model import Model
from rotflex_jax.parameters import specifications
from rotflex_jax.recording import Recording
from rotflex_jax.recording.recording import listed
from rotflex_jax.text.colours import BASELINE, FINAL, MEASURED, NO_DATA
from rotflex_jax.text.markup import card, paragraph, table
from rotflex_jax.text.numbers import plain_number, readable, unit_text
from rotflex_jax.text.plotting import blank, legend_above, styled, thinned

# Number of cells of the map of errors along each axis, and least number of samples of a cell that is drawn.
ERROR_MAP_CELLS, ERROR_MAP_MIN_SAMPLES = 15, 5
# Half width of the window in which a speed is computed from positions [s].
SPEED_HALF_WINDOW = 0.03


def _cells(
    error: np.ndarray, seen: np.ndarray, over: tuple[np.ndarray, np.ndarray], edges: list[np.ndarray]
) -> np.ma.MaskedArray:
    """Root mean square of an error in the cells that contain enough samples."""
    total = np.histogram2d(*over, edges, weights=error**2)[0]
    return np.ma.masked_where(seen < ERROR_MAP_MIN_SAMPLES, np.sqrt(total / np.maximum(seen, 1)))


@styled
def _figure(
    recording: Recording, y: np.ndarray, given: np.ndarray, now: np.ndarray, units: Mapping[str, str]
) -> Figure:
    """Figure of the runs (left) and of the error of the last run (right)."""
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
        # The scale includes the error of the given model, so that a better model looks paler.
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
    """A PNG of measured and simulated outputs over time, and of the error over speed and deflection.

    Args:
        recording: Recording that is drawn.
        y: Measured channels in the order of the model (N, C).
        given: Run of the model as it was given (N, C).
        now: Run of the model as it is set by the widgets (N, C).
        units: Channel -> its unit.
    """
    buffer = io.BytesIO()
    _figure(recording, y, given, now, units).savefig(buffer, format="png", dpi=90)
    return buffer.getvalue()


# A slider changes a parameter by a factor between 10^-SLIDER_DECADES and 10^SLIDER_DECADES.
SLIDER_DECADES = 1.0


class _State(NamedTuple):
    """State of the widgets, stored for undo.

    Attributes:
        base: The mechanism with the values that the sliders multiply.
        on: Label of an effect -> whether its switch is on.
        factors: Parameter -> its factor; parameters without an entry have the factor 1.
        sliders: Parameters with a slider of their own.
    """

    base: Mechanism
    on: dict[str, bool]
    factors: dict[str, float]
    sliders: tuple[str, ...]


class Explorer:
    """Widgets that change a model and show its runs and errors on recordings.

    All states of switches and sliders share one compiled program: switches are gates, parameters are values.
    Only an added effect needs another compilation.

    Attributes:
        model: The model as it is set by the widgets.
        errors: Channel -> root mean square error of short free runs over `test` [unit].
        given: Channel -> the error of the model as it was given [unit].
        switches: Label of an effect, such as "coulomb at hub" -> its checkbox.
        parameter: Menu that selects the parameter for `factor`.
        factor: Slider for the selected parameter, as a multiple of its given or refitted value.
        sliders: Parameter -> its own slider, in addition to `factor`.
        addable: Menu of the effects of the catalogue that can be added.
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
        """Builds the widgets and shows the given model.

        Args:
            model: The model.
            recordings: One or several recordings; the first is drawn, and `refit` fits to all.
            test: Recordings whose error is shown; `recordings` if None.
            candidates: Effects with their parameters that can be switched on; at first they are off.
            window_seconds: Length of the windows in which free runs are started again [s].
        """
        widgets = self._widgets = optional("ipywidgets", "Exploring a model")
        bare = model if isinstance(model, Mechanism) else _model(model).mechanism
        offered = [c for c in candidates if (c.name, c.at) not in {(e.name, e.at) for e in bare.effects}]
        for effect in offered:
            bare = bare + effect
        self._solver: dict[str, Any] = {}
        if not isinstance(model, Mechanism):
            self._solver["solver"] = _model(model).solver
        off = self._offered = {effect_label(e.name, e.at) for e in offered}
        self._train = listed(recordings)
        self._drawn = self._train[0]
        self._test = listed(recordings if test is None else test)
        self._seconds = window_seconds
        self._units = {c: self._drawn.unit(c) for c in bare.channels}
        self._base, self._factors, self._silent = bare, {}, False
        self._said, self._earlier = "", []
        self.switches: dict[str, Any] = {}
        self.sliders: dict[str, Any] = {}
        self.parameter = widgets.Dropdown(description="parameter")
        self.factor = self._slider("times")
        self.addable = widgets.Dropdown(description="effect")
        self._text, self._image = widgets.HTML(), widgets.Image(format="png")
        self._left = widgets.VBox()
        self._silently(lambda: self._build({label: label not in off for label in self._labels(bare)}, ()))
        self._given = self._state()
        self._given_model = self.model = self._stands()
        self.given = self.errors = self._errors(self.model)
        self.factor.observe(self._changed, "value")
        self.parameter.observe(self._chosen, "value")
        self._buttons = widgets.HBox(
            [
                self._button("own slider", lambda: self.keep_slider(self.parameter.value)),
                self._button("refit", self.refit),
                self._button("undo", self.undo),
                self._button("reset", self.reset),
            ]
        )
        adding = widgets.HBox([self.addable, self._button("add", lambda: self.add(*self.addable.value))])
        side = widgets.VBox([self._left, self.parameter, self.factor, self._buttons, adding])
        self.box = widgets.VBox([widgets.HBox([side, self._text]), self._image])
        self._show()

    def _button(self, name: str, act: Callable[[], None]) -> Any:
        button = self._widgets.Button(description=name, layout={"width": "auto"})

        def clicked(_: Any) -> None:
            try:
                act()
            except InputError as error:  # a notebook would not show an exception in a callback
                self._said = str(error)
                self._show()

        button.on_click(clicked)
        return button

    def _slider(self, name: str, value: float = 1.0) -> Any:
        return self._widgets.FloatLogSlider(
            value=value,
            min=-SLIDER_DECADES,
            max=SLIDER_DECADES,
            step=0.01,
            description=name,
            continuous_update=False,
            style={"description_width": "initial"},
        )

    # -- actions of the user ---------------------------------------------------------------------------

    def add(self, effect: str, at: str) -> None:
        """Adds an effect of the catalogue and switches it on.

        The effect has its default parameters. If all its amplitudes are zero, the first gets a typical value.

        Args:
            effect: Name of the effect, such as `"coulomb"`.
            at: Port, `input` or channel.

        Raises:
            InputError: There is no such effect, the model has it already, or it cannot act at `at`.
        """
        cls = CATALOG[choose(effect, CATALOG, "effect")]
        if (effect, at) in {(e.name, e.at) for e in self._base.effects}:
            raise InputError(
                f"{effect_label(effect, at)} is in the model already; switch it on or off there."
            )
        added = cls(at=at)
        if cls.amplitudes and not any(getattr(added, name) for name in cls.amplitudes):
            first = cls.amplitudes[0]  # an amplitude of zero has no effect, and no factor changes it
            added = added.replace(**{first: specifications(added)[first].typical})
        extended = self._base + added
        self._remember()
        self._base = extended
        on = {label: box.value for label, box in self.switches.items()}
        self._silently(lambda: self._build(on | {effect_label(effect, at): True}, tuple(self.sliders)))
        self._changed(None)

    def keep_slider(self, parameter: str) -> None:
        """Gives a parameter its own slider, so that several parameters can be moved in turn.

        Args:
            parameter: Full name of the parameter.

        Raises:
            InputError: The model has no such parameter.
        """
        choose(parameter, self._base.parameter_names, "parameter")
        if parameter in self.sliders:
            return
        on = {label: box.value for label, box in self.switches.items()}
        self._silently(lambda: self._build(on, (*self.sliders, parameter)))
        self._show()

    def refit(self) -> None:
        """Fits the free parameters of all effects that are on; sliders then multiply the fitted values."""
        on = self._stands()
        how = {"window_seconds": self._seconds, "progress": self._meanwhile}
        fitted = fit(on, self._train, **how)
        self._remember()
        self._base, self._factors = on.mechanism.with_values(fitted.model.mechanism.named_values), {}
        self._said = f"refitted: {fitted.ending}"
        self._silently(self._set_sliders)
        self._changed(None)

    def _meanwhile(self, line: str) -> None:
        """Shows the progress of a fit in the place of the errors."""
        self._text.value = card("Refitting", paragraph(line))

    def undo(self) -> None:
        """Takes the last change back, if there is one."""
        if self._earlier:
            self._restore(self._earlier.pop())

    def reset(self) -> None:
        """Restores the model as it was given."""
        self._remember()
        self._restore(self._given)

    # -- state -----------------------------------------------------------------------------------------

    def _state(self) -> _State:
        on = {label: bool(box.value) for label, box in self.switches.items()}
        return _State(self._base, on, dict(self._factors), tuple(self.sliders))

    def _remember(self) -> None:
        """Stores the state that is shown for `undo`, unless it is stored already."""
        if not self._earlier or self._earlier[-1] != self._shown_state:
            self._earlier.append(self._shown_state)

    def _restore(self, state: _State) -> None:
        self._base, self._factors = state.base, dict(state.factors)
        self._silently(lambda: self._build(state.on, state.sliders))
        self._update()

    def _build(self, on: Mapping[str, bool], sliders: Sequence[str]) -> None:
        """Builds the widgets for the present effects and parameters."""
        m, widgets = self._base, self._widgets
        self.switches = {
            label: widgets.Checkbox(value=on.get(label, True), description=label, indent=False)
            for label in self._labels(m)
        }
        self._unit = {
            n: unit_text(spec.unit)
            for n, spec in zip(m.parameter_names, m.parameter_specifications, strict=True)
            if n not in m.followers
        }
        self.sliders = {n: self._slider(n, self._factors.get(n, 1.0)) for n in sliders if n in self._unit}
        for box in self.switches.values():
            box.observe(self._changed, "value")
        for name, slider in self.sliders.items():
            slider.observe(lambda change, name=name: self._moved(name, change["new"]), "value")
        chosen = self.parameter.value
        self.parameter.options = list(self._unit)
        self.parameter.value = chosen if chosen in self._unit else next(iter(self._unit))
        self.factor.value = self._factors.get(self.parameter.value, 1.0)
        present = {(e.name, e.at) for e in m.effects}
        places = [p for p in ((cls.name, at) for cls, at in search_places(m)) if p not in present]
        self.addable.options = [(effect_label(*p), p) for p in places if m.accepts(CATALOG[p[0]], p[1])]
        self._left.children = (*self.switches.values(), *self.sliders.values())

    def _labels(self, m: Mechanism) -> list[str]:
        """Labels of the effects that have a switch, in the order of the mechanism; candidates always do."""
        labels = {effect_label(e.name, e.at): _can_be_off(e) for e in m.effects}
        return [label for label, can_be_off in labels.items() if can_be_off or label in self._offered]

    def _set_sliders(self) -> None:
        for name, slider in self.sliders.items():
            slider.value = self._factors.get(name, 1.0)
        self.factor.value = self._factors.get(self.parameter.value, 1.0)

    def _silently(self, change: Callable[[], Any]) -> None:
        """Changes widgets without a simulation after each change."""
        self._silent = True
        try:
            change()
        finally:
            self._silent = False

    def _chosen(self, change: Any) -> None:
        """Another parameter was chosen: the slider shows its factor."""
        if self._silent:
            return
        self._silently(self._set_sliders)
        self._show()

    def _moved(self, name: str, factor: float) -> None:
        """A slider was moved."""
        if self._silent:
            return
        self._remember()
        self._factors[name] = factor
        self._silently(self._set_sliders)
        self._update()

    def _changed(self, change: Any) -> None:
        if self._silent:
            return
        if change is not None:
            self._remember()
        if self.factor.value != self._factors.get(self.parameter.value, 1.0):
            self._factors[self.parameter.value] = self.factor.value
            self._silently(self._set_sliders)
        self._update()

    def _stands(self) -> Model:
        """The model as it is set by the widgets."""
        labels = [effect_label(e.name, e.at) for e in self._base.effects]
        gates = tuple(float(self.switches[x].value) if x in self.switches else 1.0 for x in labels)
        values = self._base.named_values
        changed = {name: factor * values[name] for name, factor in self._factors.items()}
        return Model(self._base.with_values(changed), gates=gates, **self._solver)

    def _update(self) -> None:
        self.model = self._stands()
        self.errors = self._errors(self.model)
        self._show()

    def _errors(self, model: Model) -> dict[str, float]:
        """Root mean square error of short free runs, without the samples from which each run starts."""
        measured = [model.measured(r) for r in self._test]
        runs = [model.simulate_windows(r, self._seconds) for r in self._test]
        rms = windowed_rmse(self._test, measured, runs, self._seconds)
        return dict(zip(model.mechanism.channels, rms.tolist(), strict=True))

    def _show(self) -> None:
        self._shown_state = self._state()
        rows = []
        for channel, now in self.errors.items():
            before = self.given[channel]
            change = f"{100 * (now / before - 1):+.1f} %".replace("-", "−") if before > 0 else ""
            read = readable(1.0, self._units[channel])
            rows.append((channel, read[1], *(plain_number(read[0] * e) for e in (before, now)), change))
        m, named = self.model.mechanism, dict.fromkeys((*self.sliders, self.parameter.value))
        values = m.named_values
        lines = [f"{name} = {values[name]:.4g} {self._unit[name]}".rstrip() for name in named]
        self._text.value = card(
            f"Error of free runs of {self._seconds:g} s",
            table(("channel", "unit", "as given", "now", "change"), rows, words=2),
            *(paragraph(line) for line in lines),
            *([paragraph(self._said)] if self._said else []),
        )
        self._said = ""
        given, now = (m.simulate_windows(self._drawn, self._seconds) for m in (self._given_model, self.model))
        measured = self.model.measured(self._drawn)
        self._image.value = overlay(self._drawn, measured, given, now, self._units)

    def _ipython_display_(self) -> None:
        from IPython.display import display  # IPython calls this method, so it is installed

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
    """Whether an effect can be switched off: all except linear ones such as inertia, spring and motor."""
    return not effect.is_linear or effect.name.startswith("viscous")
