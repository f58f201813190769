"""The explorer without a browser: values of its widgets are set, and what the widgets show is checked."""

import io
import sys

import numpy as np
import pytest
from matplotlib.image import imread

import rotflex_jax as rf
from rotflex_jax.errors import InputError
from rotflex_jax.models.model import _free_many
from rotflex_jax.notebook.explorer import Explorer

pytest.importorskip("ipywidgets")

FRICTION, SPRING = "Coulomb friction at hub", "cubic spring at joint"


@pytest.fixture(scope="module")
def truth() -> rf.Mechanism:
    return rf.joints.paper() + rf.effects.Coulomb(at="hub", level=0.05)


@pytest.fixture(scope="module")
def recording(truth: rf.Mechanism) -> rf.Recording:
    u = rf.data.excitation.noise(600, 0.01, rms=2.0, seed=4)
    noise = 5e-4 * np.random.default_rng(6).standard_normal((600, 2))
    return rf.Recording(u, rf.simulate(truth, u, 0.01) + noise, 0.01, accept="units")


@pytest.fixture
def explorer(truth: rf.Mechanism, recording: rf.Recording) -> Explorer:
    spring = rf.effects.CubicSpring(at="joint", stiffness=30.0)
    return rf.explore(rf.Model(truth), recording, candidates=[spring])


def test_it_begins_with_the_model_as_given(explorer: Explorer) -> None:
    assert explorer.switches[FRICTION].value and not explorer.switches[SPRING].value
    assert "joint spring" not in " ".join(explorer.switches) and "viscous damping at hub" in explorer.switches
    assert explorer.errors == explorer.given
    # Errors of the true model are near the sensor noise of 5e-4 rad: a candidate that is off has no effect.
    assert max(explorer.errors.values()) < 1.5e-3


def test_a_linear_candidate_is_off_at_first_too(truth: rf.Mechanism, recording: rf.Recording) -> None:
    """Linear effects of the model have no switch, since without an inertia nothing moves."""
    spring = rf.effects.Spring(at="hub", stiffness=3.0)
    given, offered = (rf.explore(truth, recording, candidates=c) for c in ((), [spring]))
    assert offered.errors == pytest.approx(given.errors)
    offered.switches["linear spring at hub"].value = True
    assert offered.errors["theta"] > 5 * given.errors["theta"]


def test_switching_an_effect_off_and_on_shows_at_once(explorer: Explorer) -> None:
    before, picture = dict(explorer.errors), explorer._image.value
    explorer.switches[FRICTION].value = False
    assert explorer.errors["theta"] > 5 * before["theta"]
    assert explorer._image.value != picture
    assert "+" in explorer._text.value and "%" in explorer._text.value
    explorer.switches[FRICTION].value = True
    assert explorer.errors == pytest.approx(before)


def test_a_moved_number_is_that_of_the_model(explorer: Explorer, recording: rf.Recording) -> None:
    explorer.parameter.value = "joint.spring.stiffness"
    explorer.factor.value = 1.3
    assert "joint.spring.stiffness = 2.093 N m/rad" in explorer._text.value
    by_hand = rf.Model(
        explorer.model.mechanism.with_values({"joint.spring.stiffness": 1.3 * 1.61}),
        gates=explorer.model.gates,
    )
    np.testing.assert_allclose(
        explorer.model.simulate_windows(recording), by_hand.simulate_windows(recording), atol=1e-12
    )
    # A second parameter is changed; the slider keeps the factor of each parameter.
    explorer.parameter.value = "hub.coulomb.level"
    assert explorer.factor.value == 1.0
    explorer.factor.value = 0.5
    explorer.parameter.value = "joint.spring.stiffness"
    assert explorer.factor.value == pytest.approx(1.3)
    explorer.reset()
    assert explorer.errors == pytest.approx(explorer.given) and explorer.factor.value == 1.0


def test_nothing_is_compiled_again(explorer: Explorer) -> None:
    explorer.switches[SPRING].value = True
    compiled = _free_many.programs_made
    explorer.switches[FRICTION].value = False
    explorer.parameter.value = "hub.inertia.inertia"
    explorer.factor.value = 0.8
    assert _free_many.programs_made == compiled


def test_any_effect_of_the_catalogue_is_added_and_taken_back(explorer: Explorer) -> None:
    before, labels = dict(explorer.errors), list(explorer.switches)
    offered = dict(explorer.addable.options)
    assert ("coulomb", "hub") not in offered.values() and ("coulomb", "joint") in offered.values()
    explorer.add("coulomb", "joint")
    assert [*labels, "Coulomb friction at joint"] == list(explorer.switches)
    assert explorer.errors["alpha"] > 2 * before["alpha"]  # the true model has no friction there
    assert ("coulomb", "joint") not in dict(explorer.addable.options).values()
    explorer.add("gravity", "hub")  # its default amplitudes are zero, so it gets a typical value
    assert explorer.model.mechanism.effect("gravity", "hub").sine == 0.02
    explorer.undo()
    explorer.undo()
    assert list(explorer.switches) == labels and explorer.errors == pytest.approx(before)
    explorer.undo()  # nothing is left to undo
    assert explorer.errors == pytest.approx(before)
    with pytest.raises(InputError, match="in the model already"):
        explorer.add("coulomb", "hub")


def test_several_sliders_a_refit_and_undo(explorer: Explorer) -> None:
    level, stiffness = "hub.coulomb.level", "joint.spring.stiffness"
    best = dict(explorer.errors)
    for name, factor in ((level, 0.4), (stiffness, 1.2)):
        explorer.keep_slider(name)
        explorer.sliders[name].value = factor
    values = explorer.model.mechanism.named_values
    assert (values[level], values[stiffness]) == pytest.approx((0.4 * 0.05, 1.2 * 1.61))
    assert f"{level} = 0.02 N m" in explorer._text.value and explorer.errors["theta"] > 3 * best["theta"]
    worse = dict(explorer.errors)
    explorer.refit()  # from these values back to the true ones
    assert explorer.errors["theta"] < 1.2 * best["theta"] and explorer.sliders[level].value == 1.0
    assert "refitted: converged" in explorer._text.value
    explorer.undo()
    assert explorer.errors == pytest.approx(worse) and explorer.sliders[level].value == 0.4
    explorer.undo()  # the second slider
    assert explorer.sliders[stiffness].value == 1.0 and explorer.sliders[level].value == 0.4
    explorer.parameter.value, explorer.factor.value = level, 0.7  # the other way to move it
    assert explorer.sliders[level].value == 0.7


def test_the_picture_is_one(explorer: Explorer) -> None:
    pixels = imread(io.BytesIO(explorer._image.value))
    assert pixels.shape[1] == 900 and pixels.std() > 0.05


def test_what_cannot_be_explored_is_refused(
    recording: rf.Recording, truth: rf.Mechanism, monkeypatch
) -> None:
    with pytest.raises(InputError, match="give a Fit"):
        rf.explore(3, recording)
    with pytest.raises(InputError, match="No recording"):
        rf.explore(truth, [])
    monkeypatch.setitem(sys.modules, "ipywidgets", None)
    with pytest.raises(InputError, match="ipywidgets"):
        rf.explore(truth, recording)
