"""A model under sliders: switch effects, move a number, and see what it does to the run and to its error."""

import dataclasses
from collections.abc import Callable, Iterable, Sequence
from typing import Any

from rotflex_jax.discover.result import Discovery
from rotflex_jax.display.markup import card, paragraph, table
from rotflex_jax.display.overlay import overlay
from rotflex_jax.effects.kinds import Effect, Linear
from rotflex_jax.errors import InputError, optional
from rotflex_jax.fit.fitted import Fit
from rotflex_jax.mechanism import Mechanism
from rotflex_jax.metrics import windowed_rmse
from rotflex_jax.model import Model
from rotflex_jax.recording import Recording
from rotflex_jax.report.wording import effect_label, plain_number, readable, unit_text

# A slider moves a number by up to this power of ten, either way.
REACH = 1.0


class Explorer:
    """A model, recordings, and widgets that change the one and show what it does to the other.

    Every state of the widgets runs through one compilation: switches are gates, numbers are values.

    Attributes:
        model: As it stands under the widgets.
        errors: Channel -> root mean square error of short free runs over `test` [unit].
        given: The same of the model as it was given.
        switches: Effect, as "coulomb at hub" -> its checkbox.
        parameter: Which number the slider moves.
        factor: Slider: the number as a multiple of what it was.
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
            test: Recordings whose error is told; the same ones if None.
            candidates: Effects with their numbers that can be switched on; they begin switched off.
            window_seconds: Free runs start anew after so long [s].
        """
        widgets = optional("ipywidgets", "Exploring a model")
        bare = model if isinstance(model, Mechanism) else _model(model).mechanism
        offered = [c for c in candidates if (c.name, c.at) not in {(e.name, e.at) for e in bare.effects}]
        for effect in offered:
            bare = bare + effect
        solver = {} if isinstance(model, Mechanism) else {"solver": _model(model).solver}
        off = {(e.name, e.at) for e in offered}
        gates = tuple(0.0 if (e.name, e.at) in off else 1.0 for e in bare.effects)
        self._begun = Model(bare, gates=gates, **solver)
        self._drawn = _listed(recordings)[0]
        self._test = _listed(recordings if test is None else test)
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
        self.parameter = widgets.Dropdown(options=list(self._unit), description="number")
        self.factor = widgets.FloatLogSlider(
            value=1.0, min=-REACH, max=REACH, step=0.01, description="times", continuous_update=False
        )
        self._text, self._image = widgets.HTML(), widgets.Image(format="png")
        self._kept = dict(zip(bare.parameter_names, bare.values.tolist(), strict=True))
        self._moved: dict[str, float] = {}
        self._held = False
        self.model = self._begun
        self.given = self.errors = self._errors(self._begun)
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
        self._moved = {}
        self._silently(lambda: [setattr(b, "value", on[label]) for label, b in self.switches.items()])
        self._silently(lambda: setattr(self.factor, "value", 1.0))
        self._changed(None)

    def _pairs(self) -> list[tuple[Effect, float]]:
        gates = self._begun.gates or ()
        return list(zip(self._begun.mechanism.effects, gates, strict=True))

    def _silently(self, change: Callable[[], Any]) -> None:
        """Changes widgets without a simulation for each."""
        self._held = True
        try:
            change()
        finally:
            self._held = False

    def _chosen(self, change: Any) -> None:
        """Another number: the slider shows where that one stands."""
        name = self.parameter.value
        self._silently(lambda: setattr(self.factor, "value", self._moved.get(name, 1.0)))
        self._show()

    def _changed(self, change: Any) -> None:
        if self._held:
            return
        if self.factor.value != self._moved.get(self.parameter.value, 1.0):
            self._moved[self.parameter.value] = self.factor.value
        gates = tuple(
            float(self.switches[label].value) if (label := effect_label(e.name, e.at)) in self.switches else g
            for e, g in self._pairs()
        )
        moved = {name: factor * self._kept[name] for name, factor in self._moved.items()}
        self.model = dataclasses.replace(
            self._begun, mechanism=self._begun.mechanism.with_values(moved), gates=gates
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
        value = self._moved.get(name, 1.0) * self._kept[name]
        self._text.value = card(
            f"Error of free runs of {self._seconds:g} s",
            table(("channel", "unit", "as given", "now", "change"), rows, words=2),
            paragraph(f"{name} = {value:.4g} {self._unit[name]}".rstrip()),
        )
        given, now = (m.simulate_windows(self._drawn, self._seconds) for m in (self._begun, self.model))
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


def _listed(recordings: Recording | Sequence[Recording]) -> tuple[Recording, ...]:
    found = (recordings,) if isinstance(recordings, Recording) else tuple(recordings)
    if not found:
        raise InputError("No recording was given, but there must be one to compare with; give one.")
    return found


def _can_be_off(effect: Effect) -> bool:
    """Without inertia, spring or motor there is no machine; everything else can be left out."""
    return not isinstance(effect, Linear) or effect.name.startswith("viscous")
