"""A user's own machine, described by its parts, and a user's own effect.

The machine has three ports, an encoder and a speed sensor whose output is rectified. Its recordings come from
an independent simulator (`turntable.py`).
"""

import dataclasses
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest
from spindle import SPINDLE, spun
from turntable import FOR_THE_NOTEBOOK, Truth, record, write

import rotflex_jax as rf
from rotflex_jax.discover.supermodel import build
from rotflex_jax.effects import (
    CATALOG,
    Coulomb,
    Force,
    Inertia,
    Motor,
    Rectifier,
    Spring,
    Viscous,
    register,
)
from rotflex_jax.effects.base import Scale
from rotflex_jax.errors import InputError
from rotflex_jax.mechanism.initial_state import rough_states
from rotflex_jax.mechanism.roles import calibrations, search_places
from rotflex_jax.models.model import Model
from rotflex_jax.notebook import Live
from rotflex_jax.parameters import parameter
from rotflex_jax.text.numbers import as_read

MOTOR = ("torque_constant", "back_emf", "resistance", "gear_ratio", "efficiency")

# Parameters as in a data sheet, which differ from the true ones by up to a quarter.
turntable = rf.Mechanism(
    coordinates=["phi", "psi"],
    ports={"motor": (1, 0), "belt": (-1, 1), "platter": (0, 1)},
    effects=[
        Motor(at="motor", torque_constant=0.03, back_emf=0.03, resistance=2.0, gear_ratio=5.0),
        Inertia(at="motor", inertia=0.0025),
        Viscous(at="motor"),
        Spring(at="belt", stiffness=5.0),
        Viscous(at="belt"),
        Inertia(at="platter", inertia=0.005),
        Viscous(at="platter"),
        Rectifier(at="tacho", loss=2.0),
    ],
    outputs={"encoder": "motor", "tacho": ("platter", "speed")},
    trusted=["tacho.rectifier.loss", *(f"motor.motor.{name}" for name in MOTOR)],
)


def recording(truth: Truth, seed: int = 1) -> rf.Recording:
    u, y = record(seed, truth)
    return rf.Recording(u=u, y=y, Ts=0.004, channels=("encoder", "tacho"), units=("rad", "rad/s"))


@pytest.fixture
def magnetic_brake():
    """A user's own effect, in the catalogue for the duration of a test."""

    @register
    @dataclasses.dataclass(frozen=True)
    class MagneticBrake(Force):
        name: ClassVar[str] = "magnetic_brake"
        title: ClassVar[str] = "magnetic brake"
        equation: ClassVar[str] = "tau = -coefficient * speed / (1 + (speed / knee)**2)"
        amplitudes: ClassVar[tuple[str, ...]] = ("coefficient",)
        searched: ClassVar[tuple[str, ...]] = ("hub", "arm")

        coefficient: float = parameter(0.01, unit="N m s/rad", lower=0.0)
        knee: float = parameter(5.0, unit="rad/s", lower=1e-2)

        def force(self, position, speed, voltage):
            return -self.coefficient * speed / (1 + (speed / self.knee) ** 2)

        @classmethod
        def probes(cls, scale):
            coefficient = 0.1 * scale.torque / scale.speed
            return [[{"coefficient": coefficient, "knee": k * scale.speed}] for k in (0.5, 1.0, 2.0)]

    yield MagneticBrake
    CATALOG.pop("magnetic_brake")


def places_of(name: str) -> list[str]:
    return [place for cls, place in search_places(turntable) if cls.name == name]


def test_effects_are_searched_where_they_belong_on_a_machine_with_other_names():
    assert places_of("coulomb") == ["motor", "belt", "platter"]
    assert places_of("cubic_spring") == ["belt"]  # a spring is there
    assert places_of("heating") == ["motor"]  # the motor is there
    assert places_of("gravity") == ["motor", "platter"]
    assert places_of("dead_zone") == ["input"]
    assert places_of("sensor_gain") == ["tacho"]  # relative to the encoder
    assert places_of("sensor_cubic") == ["encoder", "tacho"]
    assert calibrations(turntable) == [("voltage_offset", "input"), ("sensor_bias", "tacho")]


def test_the_joint_is_searched_as_it_says_itself():
    joint = rf.joints.paper()
    named = {(cls.name, port) for cls, port in search_places(joint)}
    known = {*joint.port_vectors, *joint.channels, "input"}
    assert named == {(c.name, p) for c in CATALOG.values() for p in c.searched if p in known}


def test_a_lone_tacho_has_no_bias_of_its_own():
    """Without another sensor the bias could not be distinguished from an offset of the voltage."""
    alone = dataclasses.replace(
        turntable,
        outputs={"tacho": ("platter", "speed")},
        effects=[e for e in turntable.effects if e.name != "rectifier"],
        trusted=(),
    )
    assert calibrations(alone) == [("voltage_offset", "input")]


def test_own_effect_is_searched_where_its_words_say(magnetic_brake):
    assert places_of("magnetic_brake") == ["motor", "platter"]


def test_an_effect_that_was_not_registered_is_named():
    class Unknown(Coulomb):
        name = "unknown"

    scales = {p: Scale(1.0, 1.0, 1.0, 1.0) for p in turntable.port_vectors}
    with pytest.raises(InputError, match=r"Unknown is to be tried, but is not in the catalogue.*@register"):
        build(turntable, [(Unknown, "platter")], scales)


def test_first_guess_of_the_state_uses_springs_where_sensors_are_silent():
    """The platter's angle and the sign of its speed are not measured: both follow from a relaxed belt."""
    t = np.arange(25) * 0.004
    for way in (1.0, -1.0):
        y = np.column_stack([12.0 + 3.0 * way * t, np.full(25, 3.0)])
        state = rough_states(turntable.structure, y[None], 0.004)[0]
        np.testing.assert_allclose(state, [12.0, 12.0, 3.0 * way, 3.0 * way], atol=1e-9)


def test_a_rectified_sensor_corrects_the_state_the_right_way_round():
    """With the gain of a sensor that is not rectified, corrections get the wrong sign in reverse motion."""
    run = recording(Truth())
    true = Model(
        turntable.with_values(
            {
                "motor.inertia.inertia": 0.002,
                "platter.inertia.inertia": 0.006,
                "belt.spring.stiffness": 6.0,
                "belt.viscous.coefficient": 0.004,
                "motor.viscous.coefficient": 0.002,
            }
        )
    )
    noise = np.array([2e-3, 0.03])
    y_hat = true.predict(run, {"motor": 1e-4, "platter": 1e-4}, noise)
    error = np.sqrt(np.mean((run.y - y_hat)[run.n_init :] ** 2, axis=0))
    assert np.mean(np.diff(run.y[:, 0]) < 0) > 0.2  # it turns backwards too
    assert np.all(error < 2 * noise), error


def test_fit_of_ones_own_machine_recovers_its_numbers():
    train, test = recording(Truth(friction=0.03)).split(0.7)
    fit = rf.fit(turntable + Coulomb(at="platter", level=0.01), train)
    for name, value in (
        ("motor.inertia.inertia", 0.002),
        ("platter.inertia.inertia", 0.006),
        ("belt.spring.stiffness", 6.0),
        ("platter.coulomb.level", 0.03),
    ):
        assert fit[name].value == pytest.approx(value, rel=0.02), name
    error = rf.metrics.rmse(test.y, fit.model.simulate(test), test.n_init)
    assert np.all(error < 2 * np.array([2 * np.pi / 1000 / np.sqrt(12), 0.03]))  # near the sensors' noise


@pytest.mark.slow
@pytest.mark.usefixtures("without_final_fit")
def test_discovery_finds_what_is_hidden_in_ones_own_machine(magnetic_brake):
    """The first round finds a user's own effect at the right port, before the friction at the same port.

    Candidates are laws of the speed at motor and platter. Notebook 02 finds both effects, with parameters.
    """
    train, test = recording(FOR_THE_NOTEBOOK).split(0.7)
    follow = Live("search")
    laws = {"magnetic_brake", "coulomb", "coulomb_asymmetric", "stribeck", "quadratic_drag"}
    pairs = [(cls, at) for cls, at in search_places(turntable) if cls.name in laws and at != "belt"]
    assert len(pairs) == 2 * len(laws)
    result = rf.discover(turntable, train, test, candidates=pairs, rounds=1, progress=follow)
    # The tacho does not measure the direction, so a fit may end in another local minimum: effect, port and
    # smaller errors are certain, but not every parameter.
    assert (result.rounds[0].effect, result.rounds[0].port) == ("magnetic_brake", "platter")
    before, after = result.baseline.held_out_rmse_windows, result.final.held_out_rmse_windows
    assert all(after[c] < before[c] / 3 for c in before)
    # What was shown while the search ran, in the units of displays.
    assert follow.labels[:2] == ["as it is", "+ magnetic brake at platter"]
    units = [as_read(1.0, unit)[1] for unit in test.units]
    shown = [follow.errors[f"{channel} [{unit}]"] for channel, unit in zip(before, units, strict=True)]
    assert np.prod([errors[1] / errors[0] for errors in shown]) < 1


@pytest.mark.slow
def test_a_machine_of_which_only_speeds_are_measured(tmp_path):
    """No sensor measures a position; the search finds the hidden friction, its level and the inertia."""
    pairs = [(CATALOG[name], "shaft") for name in ("coulomb", "quadratic_drag", "cogging")]
    result = rf.discover(SPINDLE, *spun(inner=20).split(0.7), candidates=pairs)
    assert result.verdict == "found"
    (turn,) = result.rounds
    assert (turn.effect, turn.port) == ("coulomb", "shaft")
    assert turn.parameters["level"].value == pytest.approx(0.03, rel=0.03)
    found = {e.name: e.value for e in result.final.estimates}
    assert found["shaft.inertia.inertia"] == pytest.approx(0.02, rel=0.02)
    assert result.final.held_out_rmse_windows["tacho"] < 1.2 * 0.01
    assert result.report(tmp_path).stat().st_size > 10_000


def test_recording_of_the_notebook_is_what_the_simulator_makes(tmp_path):
    write(str(tmp_path / "again.csv"))
    here = Path(__file__).resolve().parent.parent / "notebooks" / "turntable.csv"
    again, kept = (np.loadtxt(f, delimiter=",", skiprows=1) for f in (tmp_path / "again.csv", here))
    np.testing.assert_allclose(again, kept, atol=1e-6)


def machine(**changes):
    given = {
        "coordinates": ["phi"],
        "ports": {"shaft": (1,)},
        "effects": [Motor(at="shaft"), Inertia(at="shaft")],
        "outputs": {"angle": "shaft"},
    }
    return rf.Mechanism(**(given | changes))


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"coordinates": "phi"}, r"`coordinates` must be a list of names, but is 'phi'; write \['phi'\]"),
        ({"ports": ["shaft"]}, "ports were given as .* names with one number per coordinate"),
        ({"ports": {"shaft": 1}}, "ports were given as .* names with one number per coordinate"),
        ({"ports": {"shaft": (1, 0)}}, "Port 'shaft' was given 2 entries, but the mechanism has the 1 coord"),
        ({"effects": Motor(at="shaft")}, r"one Motor, but a list is needed; write \[Motor\(...\)\]"),
        ({"effects": [Motor]}, r"Motor was given as an effect, .* write Motor\(at=\"...\"\)"),
        ({"effects": [Motor(at="shaf")]}, "Motor was put at 'shaf', but this mechanism has 'shaft'"),
        ({"outputs": ["shaft"]}, "outputs were given as .* channels with the port that each measures"),
        ({"outputs": {"angle": ("shaft", "sped")}}, "'position' or 'speed'"),
        ({"outputs": {"angle": ("shaft", "speed", 1)}}, "needs a port, or a port and 'speed'"),
        ({"outputs": {"angle": "wheel"}}, r"needs one of the ports \('shaft',\)"),
        ({"trusted": "shaft.inertia.inertia"}, "`trusted` must be a list of names, but is 'shaft"),
        ({"trusted": ["shaft.inertia"]}, "this mechanism has .*shaft.inertia.inertia"),
    ],
)
def test_mistakes_of_a_beginner_are_told_in_one_sentence(changes, sentence):
    with pytest.raises(InputError, match=sentence) as error:
        machine(**changes)
    assert "\n" not in str(error.value)


def test_a_coordinate_without_inertia_is_named_before_anything_runs():
    light = dataclasses.replace(
        turntable, effects=[e for e in turntable.effects if (e.name, e.at) != ("inertia", "platter")]
    )
    with pytest.raises(InputError, match=r"Nothing gives psi an inertia, .* \(belt, platter\)"):
        Model(light)
