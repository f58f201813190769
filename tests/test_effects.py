"""Properties of every effect, and the law of each one against a closed form."""

import ast
import contextlib
import dataclasses
import inspect
import json
import math
import re
from pathlib import Path
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
import scipy.signal

import rotflex_jax.effects as effects
from rotflex_jax.effects import (
    CATALOG,
    Actuation,
    AmplifierSaturation,
    BoucWen,
    Cogging,
    Coulomb,
    CoulombAsymmetric,
    CubicSpring,
    Dahl,
    DeadZone,
    Delay,
    DryFriction,
    Effect,
    Force,
    Gear,
    Gravity,
    Heating,
    Inertia,
    JointPlay,
    Lag,
    Linear,
    LuGre,
    Memory,
    Motor,
    QuadraticDrag,
    QuadraticSpring,
    Rectifier,
    Saturation,
    Scale,
    SecondMode,
    Sensing,
    SensorBias,
    SensorCubic,
    SensorGain,
    Spring,
    Stribeck,
    TorqueSaturation,
    Viscous,
    ViscousAsymmetric,
    VoltageOffset,
    register,
)
from rotflex_jax.errors import InputError
from rotflex_jax.joints import paper
from rotflex_jax.mechanism.roles import search_places
from rotflex_jax.parameters import specifications
from rotflex_jax.runtime.xla import double_precision

CLASSES = [CATALOG[name] for name in sorted(CATALOG)]
SCALES = [
    Scale(voltage=5.0, speed=2.0, position=0.05, torque=0.2, stiffness=1.6, inertia=0.006),
    Scale(voltage=0.1, speed=40.0, position=10.0, torque=1e-3, stiffness=1e-3, inertia=1e-6),
    Scale(voltage=24.0, speed=1e-3, position=1e-4, torque=50.0, stiffness=1e5, inertia=3.0),
]
PASSIVE = {
    "viscous",
    "motor",
    "current_drive",
    "position_servo",
    "pid_servo",
    "current_meter",
    "duty_meter",
    "coulomb",
    "coulomb_asymmetric",
    "stribeck",
    "load_friction",
    "gear_friction",
    "quadratic_drag",
    "dahl",
    "lugre",
    "bouc_wen",
    "second_mode",
    "heating",
    "torque_saturation",
}
CONSERVATIVE = {
    "inertia",
    "spring",
    "cubic_spring",
    "quadratic_spring",
    "gravity",
    "cogging",
    "joint_play",
}
# Typical values at a kink: a delay of whole samples of 2 ms has different derivatives on both sides.
BESIDE_THE_KINK = {"delay": {"time": 0.0033}}

every_effect = pytest.mark.parametrize("cls", CLASSES, ids=lambda c: c.name)


@pytest.fixture(autouse=True)
def _strict_double():
    strict = jax.numpy_dtype_promotion("strict"), jax.numpy_rank_promotion("raise")
    with double_precision(), strict[0], strict[1]:
        yield


def example(cls: type[Effect]) -> Effect:
    """An instance with a different ordinary value for each parameter."""
    given = {}
    for i, (name, spec) in enumerate(cls.declared().items()):
        if getattr(cls, name) is not None:
            given[name] = spec.typical * (1 + 0.3 * i)
    return cls(at=cls.ports[0], **given)


def law(effect: Effect, numbers, position, speed, voltage, z):
    """All outputs of an effect of any kind at one point, as one vector."""
    effect = effect.replace(**dict(zip(effect.values, numbers, strict=True)))
    if isinstance(effect, Linear):
        said = entries(effect)
        if isinstance(effect, Force):  # torque that a limit removes
            said.append(effect.force(position, speed, voltage))
        elif isinstance(effect, Memory):
            signals = (z, position, speed, voltage)
            said += [effect.force(*signals), effect.flow(*signals)]
    elif isinstance(effect, Force):
        said = [effect.force(position, speed, voltage)]
    elif isinstance(effect, DryFriction):
        load = (voltage,) if effect.loaded else ()
        said = [effect.limit(position, jnp.abs(speed), way, *load) for way in (1.0, -1.0)]
    elif isinstance(effect, Memory):
        said = [
            effect.force(z, position, speed, voltage),
            effect.flow(z, position, speed, voltage),
        ]
    elif isinstance(effect, Gear):  # without play the rotor does not count
        said = [effect.stops(), effect.stops() * effect.rotor(), *(effect.teeth() or ())]
    elif isinstance(effect, Actuation):
        voltages = voltage * jnp.array([1.0, -1.0, 0.3], voltage.dtype)
        return effect.drive(voltages, 0.002)
    else:
        assert isinstance(effect, Sensing)
        said = [effect.measure(position, *beside(effect, speed, z))]
        said += entries(effect) if effect.order else []
    return jnp.stack([jnp.asarray(s, position.dtype) for s in said])


def by_its_equation(effect: Effect, known: dict[str, float]) -> dict[str, float]:
    """What the text `equation` of an effect defines, evaluated by Python with the values in `known`."""
    text = re.sub(r"\|([^|]+)\|", r"abs(\1)", effect.equation.replace("^", "**").replace("dz/dt", "flow"))
    # Parts are separated by commas that are in no parentheses; parts without a sign are words.
    parts = [re.split(" (?:=|->) ", part) for part in re.split(r", (?![^()]*\))", text)]
    formulas = [(part[0], part[1]) for part in parts if len(part) == 2]
    functions = {"min": min, "max": max, "abs": abs, "sign": np.sign}
    functions |= {name: getattr(np, name) for name in ("exp", "sin", "cos", "tanh")}
    found = known | effect.values
    # A formula may use what a later one defines.
    for symbol, formula in formulas * len(formulas):
        with contextlib.suppress(NameError):
            found[symbol] = eval(formula, functions | found)
    return found


# Effects whose equations are formulas throughout, without conditions in words.
WRITTEN_OUT = (
    "amplifier_saturation",
    "bouc_wen",
    "cogging",
    "cross_talk",
    "cubic_spring",
    "current_meter",
    "dahl",
    "eccentric_encoder",
    "gravity",
    "heating",
    "joint_play",
    "lugre",
    "pid_servo",
    "quadratic_drag",
    "quadratic_spring",
    "saturation",
    "sensor_bias",
    "sensor_cubic",
    "sensor_gain",
    "torque_saturation",
    "viscous_asymmetric",
)


@pytest.mark.parametrize("name", WRITTEN_OUT)
def test_the_equation_that_is_shown_is_the_law(name):
    effect = example(CATALOG[name])
    for sign in (1.0, -1.0):
        position, speed, other, z = 0.31 * sign, -0.27, 0.43 * sign, 0.19
        # The equations call the last argument of a law by different names.
        said = {"position": position, "speed": speed, "z": z, "value": position, "other": other}
        said |= dict.fromkeys(("v", "m", "i"), other)
        told = by_its_equation(effect, said)
        if isinstance(effect, Sensing):
            laws = {"y": effect.measure(position, *beside(effect, other, z))}
        elif isinstance(effect, Actuation):
            laws = {"v": effect.drive(jnp.array([other]), 0.002)[0]}
        elif isinstance(effect, Memory):
            laws = {"flow": effect.flow(z, position, speed, other)}
            if not isinstance(effect, Linear):
                laws["tau"] = effect.force(z, position, speed, other)
        else:
            assert isinstance(effect, Force)
            laws = {"tau": effect.force(position, speed, other)}
        for symbol, value in laws.items():
            assert told[symbol] == pytest.approx(float(value), rel=1e-12), symbol


def entries(effect: Linear | Sensing) -> list:
    """All entries of a stamp."""
    s = effect.stamp()
    lists = (*s.own, s.from_speed, s.from_voltage, s.torque)
    return [s.inertia, s.damping, s.stiffness, s.drive, *(c for row in lists for c in row)]


def beside(effect: Sensing, other, z) -> tuple:
    """Further arguments of a sensor: another channel; or its states and the derivative, here a speed."""
    return {"nothing": (), "other": (other,), "states": ((z, 2 * z), 1)}[effect.beside]


def nothing(effect: Effect, position, voltage):
    """The value of `law` without the effect."""
    if isinstance(effect, Actuation):
        return voltage * jnp.array([1.0, -1.0, 0.3])
    if isinstance(effect, Sensing):
        return position[None]
    return jnp.zeros(())


def scalars(*numbers: float, dtype=jnp.float64) -> list[jax.Array]:
    return [jnp.asarray(n, dtype) for n in numbers]


# -- conformance: every effect ------------------------------------------------------------------


@every_effect
@pytest.mark.parametrize("scale", SCALES)
def test_probes_are_valid_and_show(cls, scale):
    groups = cls.probes(scale)
    assert groups or not cls.searched
    for group in groups:
        moved = []
        for probe in group:
            assert set(probe) == set(example(cls).values)
            effect = cls(at=cls.ports[0], **probe)
            assert not cls.amplitudes or any(probe[a] != 0 for a in cls.amplitudes)
            shown = []
            for share in (-1.0, -0.4, 0.02, 0.4, 1.0):
                point = [share * s for s in (scale.position, scale.speed, scale.voltage)]
                x, w, v, z = scalars(*point, 0.5 * share)
                said = law(effect, list(effect.values.values()), x, w, v, z)
                assert np.isfinite(said).all()
                shown.append(np.ravel(said - nothing(effect, x, v)))
            moved.append(np.concatenate(shown))
        # Each probe has an effect, and the effects of a group are linearly independent.
        assert np.linalg.matrix_rank(np.array(moved), tol=1e-12) == len(group)


@pytest.mark.parametrize("name", ["backlash", "elastic_backlash"])
def test_gaps_that_are_tried_take_the_motor_3_to_34_ms(name):
    """From rest, a torque T on an inertia J crosses a play of two gaps in t: 2 gap = T / J t^2 / 2."""
    gaps = np.sort([group[0]["gap"] for group in CATALOG[name].probes(SCALES[0])])
    times = np.sqrt(4 * gaps * SCALES[0].inertia / SCALES[0].torque)
    assert times[[0, -1]] == pytest.approx([3e-3, 34e-3], rel=0.01)
    np.testing.assert_allclose(gaps[1:] / gaps[:-1], 2.0)


@pytest.mark.parametrize(
    ("position", "counts"), [(0.3, [6, 7, 8, 9, 10, 12, 14, 16, 18, 20, 24]), (0.07, [24]), (0.01, [24])]
)
def test_periods_that_are_tried_show_about_half_a_period(position, counts):
    """A motion of +-0.3 rad covers half a period (pi rad of phase) from 5.2 periods per turn."""
    groups = Cogging.probes(dataclasses.replace(SCALES[0], position=position))
    assert [group[0]["periods"] for group in groups] == counts
    assert {probe["sine"] + probe["cosine"] for group in groups for probe in group} == {
        0.1 * SCALES[0].torque
    }


def test_the_inertia_that_is_tried_takes_a_tenth_of_the_torque():
    """A sine of amplitude A has the speed A w and the acceleration A w^2."""
    A, w = 0.4, 7.0
    ((probe,),) = Inertia.probes(dataclasses.replace(SCALES[0], position=A, speed=A * w))
    assert probe["inertia"] * A * w**2 == pytest.approx(0.1 * SCALES[0].torque)


@every_effect
def test_ports_and_relations(cls):
    assert set(cls.searched) <= {*cls.ports, "loaded"}  # a role of the hub
    assert {*cls.amplitudes, *cls.vanishes_with} <= set(cls.declared())
    assert not set(cls.amplitudes) & set(cls.vanishes_with)
    assert set(cls.contains) <= set(CATALOG)
    # A special case is a law of the same thing.
    assert all(cls.law_of and CATALOG[name].law_of == cls.law_of for name in cls.contains)
    assert all(name in cls.equation for name in cls.declared())


@pytest.mark.parametrize("cls", [c for c in CLASSES if c.amplitudes], ids=lambda c: c.name)
def test_absent_at_zero_amplitude(cls):
    effect = example(cls).replace(**dict.fromkeys(cls.amplitudes, 0.0))
    for point in ((0.0, 0.0, 0.0, 0.0), (0.7, -1.3, 2.0, 0.4), (-0.2, 5.0, -0.1, -1.0)):
        x, w, v, z = scalars(*point)
        said = law(effect, list(effect.values.values()), x, w, v, z)
        if isinstance(effect, Memory):
            said = said[:1]  # the state may move, the torque may not
        if isinstance(effect, Linear) and effect.order:
            said = jnp.concatenate([said[:4], said[-effect.order :]])  # the same for its states
        assert np.abs(said - nothing(effect, x, v)).max() == 0


@every_effect
@pytest.mark.parametrize("dtype", [jnp.float64, jnp.float32], ids=["double", "single"])
def test_nothing_is_nan_at_rest_or_at_a_kink(cls, dtype):
    effect = example(cls)
    numbers = np.array(list(effect.values.values()))
    lowest = np.array([max(s.lower, 0.0) for s in specifications(effect).values()])
    edges = [0.0, *numbers]  # a voltage on the edge of a dead zone, and so on
    points = [(e, w, -e, 0.0) for e in edges for w in (0.0, e, -1e3)]
    cases = np.array([(*n, *p) for n in (numbers, lowest) for p in points])

    def flat(a):
        return law(effect, list(a[: len(numbers)]), *a[len(numbers) :])

    @jax.jit
    @jax.vmap
    def all_of(a):
        return flat(a), jax.jacfwd(flat)(a), jax.jacrev(flat)(a)

    said, *slopes = all_of(jnp.asarray(cases, dtype))
    assert said.dtype == dtype
    assert np.isfinite(said).all() and all(np.isfinite(s).all() for s in slopes)


@every_effect
def test_derivatives_equal_central_differences(cls):
    effect = example(cls).replace(**BESIDE_THE_KINK.get(cls.name, {}))
    numbers = np.array(list(effect.values.values()))
    point = np.array([0.31, -0.17, 3.7, 0.4])  # away from every kink of the example

    def flat(a):
        return law(effect, list(a[: len(numbers)]), *a[len(numbers) :])

    at = np.concatenate([numbers, point])
    flat_jit = jax.jit(flat)
    slopes = np.array(jax.jit(jax.jacfwd(flat))(jnp.asarray(at)))
    for i in range(len(at)):
        h = 1e-5 * max(abs(at[i]), 1e-3)
        up, down = (np.array(flat_jit(jnp.asarray(at + s * h * np.eye(len(at))[i]))) for s in (1, -1))
        np.testing.assert_allclose(slopes[:, i], (up - down) / (2 * h), rtol=1e-6, atol=1e-7)


@every_effect
def test_jit_vmap_and_arrays_agree_with_one_point(cls):
    effect = example(cls)
    numbers = [jnp.asarray(n) for n in effect.values.values()]
    grid = jnp.linspace(-2.0, 2.0, 7)
    one_by_one = jnp.stack([law(effect, numbers, g, 2 * g, 3 * g, g / 4) for g in grid])
    mapped = jax.jit(jax.vmap(lambda g: law(effect, numbers, g, 2 * g, 3 * g, g / 4)))(grid)
    np.testing.assert_allclose(mapped, one_by_one, rtol=1e-14, atol=1e-16)
    if isinstance(effect, Force):
        np.testing.assert_allclose(effect.force(grid, 2 * grid, 3 * grid), one_by_one[:, -1], rtol=1e-14)
    if isinstance(effect, Sensing):
        said = effect.measure(grid, *beside(effect, 2 * grid, grid / 4))
        np.testing.assert_allclose(said, one_by_one[:, 0], rtol=1e-14)


@pytest.mark.parametrize(
    "cls", [c for c in CLASSES if not issubclass(c, (Actuation, Sensing, Gear))], ids=lambda c: c.name
)
def test_gives_no_energy(cls):
    """A torque takes at least the energy that it stores, or is a function of the position alone."""
    if cls.name == "viscous_asymmetric":
        pytest.skip("a share of the damping beside it: passive together with it, not alone")
    if cls.acts_on == "signal":
        pytest.skip("what was measured outside of the machine drives it, as a motor does")
    assert (cls.name in PASSIVE) != (cls.name in CONSERVATIVE), "say which of the two it is"
    effect = example(cls)
    if cls.name == "viscous":
        effect = effect.replace(coefficient=0.01)
    numbers = [jnp.asarray(n) for n in effect.values.values()]
    rng = np.random.default_rng(0)
    for x, w, v, z in rng.normal(size=(50, 4)) * [1.0, 3.0, 5.0, 1.0]:
        if isinstance(effect, (LuGre, BoucWen, Heating, TorqueSaturation, SecondMode)):
            assert taken(effect, x, w, v, z) >= -1e-15
            continue
        said = np.array(law(effect, numbers, *scalars(x, w, v, np.tanh(z))))
        if isinstance(effect, Linear):
            assert (said[:3] >= 0).all()
        elif cls.name in CONSERVATIVE:
            other = law(effect, numbers, *scalars(x, -2 * w, v + 1, 0.0))
            assert said == other  # of the position alone, so it has a potential
        elif isinstance(effect, DryFriction):
            assert (said >= 0).all()
            elsewhere = law(effect, numbers, *scalars(x + 1, 3 * w, v, z))
            assert (elsewhere == said).all() or not effect.steady
        elif isinstance(effect, Force):
            assert said[0] * w <= 0
        elif isinstance(effect, Memory) and effect.shows:
            assert said[0] == 0  # an instrument
        else:
            assert isinstance(effect, Dahl)
            torque, rate = said
            storing = effect.level * effect.presliding * np.tanh(z) * rate
            assert torque * w + storing <= 1e-15


def taken(effect: Effect, x: float, w: float, v: float, z: float) -> float:
    """Power [W] that an effect takes from its port and does not store."""
    if isinstance(effect, SecondMode):  # `x` is the angle of the part from the port, `v` its own speed
        s, W = effect.stamp(), 2 * math.pi * effect.frequency
        turn, accelerate = (a * x + b * v + c * w for (a, b), c in zip(s.own, s.from_speed, strict=True))
        torque = s.torque[0] * x + s.torque[1] * v - s.damping * w
        stored = effect.inertia * (v * accelerate + W**2 * x * turn)
        lost = 2 * effect.damping * W * effect.inertia * (v - w) ** 2
        np.testing.assert_allclose(-torque * w - stored, lost, rtol=0, atol=1e-13 * abs(stored))
        return lost
    if isinstance(effect, Heating):  # `v` is the torque of the cold motor; what is lost is part of it
        loss = float(effect.force(*scalars(abs(z), x, w, v)))
        assert abs(loss) < abs(v)
        assert float(effect.flow(*scalars(0.0, x, w, v))) >= 0  # the temperature never falls below the start
        return -loss * v
    if isinstance(effect, TorqueSaturation):  # `v` is the torque of the linear motor
        loss = float(effect.force(*scalars(x, w, v)))
        assert abs(loss) < abs(v)
        return -loss * v
    if isinstance(effect, LuGre):  # passive as long as damping |speed| <= 4 level g
        z = (1 + effect.rise) * np.tanh(z)
        w = math.copysign(min(abs(w), 4 * effect.level / effect.damping), w)
        lever = effect.level * effect.presliding * z
    else:  # the energy that is returned on the way to zero torque
        assert isinstance(effect, BoucWen)
        z = np.tanh(z)
        lever = effect.level * effect.width * z / (1 - (1 - 2 * effect.beta) * abs(z))
    rate, torque = (float(f(*scalars(z, x, w, v))) for f in (effect.flow, effect.force))
    return -torque * w - lever * rate


@every_effect
def test_description_is_plain(cls):
    text = json.dumps(cls.describe())
    assert cls.name in text and cls.title in text
    assert all(name in text for name in cls.declared())
    assert cls.title == cls.title.strip(". ")


@every_effect
def test_sentence_is_for_people(cls):
    effect = example(cls)
    said = effect.sentence()
    assert any(c.isdigit() for c in said)
    assert not said.endswith(".") and "nan" not in said and "None" not in said
    if not isinstance(effect, Actuation):
        assert effect.port in said


def of_law(effect, position=0.0, speed=0.0, drive=0.0):
    """Torque of a law [N m]."""
    return float(effect.force(position, speed, drive))


def forwards_less_backwards(effect):
    """By how much more torque a motion of 1 rad/s is opposed forwards than backwards [N m]."""
    return -of_law(effect, speed=1.0) - of_law(effect, speed=-1.0)


def per_volt(motor):
    """Torque at rest [N m/V] and speed without a load [rad/s per V], from the equations of motion."""
    stamp = motor.stamp()
    return stamp.drive, stamp.drive / stamp.damping


def between_stops(gear):
    """Angle over which the rotor turns alone [deg]."""
    return math.degrees(2 * gear.stops())


MOTOR = Motor("hub", 0.01, 0.012, resistance=2.0, gear_ratio=50.0, efficiency=0.8)


@pytest.mark.parametrize(
    ("effect", "number", "says"),
    [
        (Viscous("hub", -0.013), lambda e: e.stamp().damping, "is damped less .* by {:.3g} N m s"),
        (ViscousAsymmetric("hub", 0.013), forwards_less_backwards, "{:.3g} N m s/rad stronger forwards"),
        (ViscousAsymmetric("hub", -0.013), forwards_less_backwards, "{:.3g} N m s/rad stronger backwards"),
        (QuadraticDrag("arm", 0.013), lambda e: of_law(e, speed=1.0), "{:.3g} N m at 1 rad/s"),
        (CubicSpring("joint", 13.0), lambda e: of_law(e, 0.1), "hardens .* by {:.3g} N m at 0.1 rad"),
        (CubicSpring("joint", -13.0), lambda e: of_law(e, 0.1), "softens .* by {:.3g} N m at 0.1 rad"),
        (QuadraticSpring("joint", 1.3), lambda e: of_law(e, 0.1), "positive .* by {:.3g} N m at 0.1 rad"),
        (QuadraticSpring("joint", -1.3), lambda e: of_law(e, -0.1), "negative .* by {:.3g} N m at 0.1 rad"),
        (MOTOR, lambda e: per_volt(e)[0], "{:.3g} N m per volt at rest"),
        (MOTOR, lambda e: per_volt(e)[1], "runs free at {:.3g} rad/s per volt"),
        (CATALOG["backlash"]("hub", 0.004), between_stops, "a play of {:.3g} deg"),
        (CATALOG["elastic_backlash"]("hub", 0.004), between_stops, "a play of {:.3g} deg"),
    ],
)
def test_numbers_of_a_sentence_are_those_of_the_law(effect, number, says):
    assert re.search(says.format(abs(number(effect))), effect.sentence())


def test_half_of_the_torque_is_lost_where_the_sentence_says():
    found = re.search(r"would give (\S+) N m", TorqueSaturation("hub", loss=0.4).sentence())
    torque = float(found[1])
    assert of_law(TorqueSaturation("hub", loss=0.4), drive=torque) == pytest.approx(-torque / 2)


@pytest.mark.parametrize(
    ("level", "damping", "says", "does_not_say"),
    [
        (0.02, 0.0, ["Coulomb level of 0.02 N m", "breakaway level of 0.03 N m"], "damping"),
        (0.02, 0.05, ["breakaway level of 0.03 N m", "damping 0.05 N m s/rad below 0.4 rad/s"], "without"),
        (1e-11, 0.05, ["without a Coulomb level", "damping 0.05 N m s/rad below 0.4 rad/s"], "breakaway"),
        (0.0, 0.0, ["Coulomb level of 0 N m"], "damping"),
    ],
)
def test_lugre_friction_speaks_of_what_it_does(level, damping, says, does_not_say):
    said = CATALOG["lugre"]("hub", level, rise=0.5, slow=0.4, presliding=0.003, damping=damping).sentence()
    assert all(part in said for part in [*says, "0.003 rad (0.17 degrees)"]) and does_not_say not in said


def test_a_level_is_named_where_the_rise_is_lost_beyond_all_speeds():
    """The torque of the bristles at `slow` is then no measure: the hub never turns so fast."""
    said = CATALOG["lugre"]("hub", 0.035, rise=0.0, slow=54.7, presliding=0.0013, damping=0.89).sentence()
    assert said == (
        "friction of the hub with a Coulomb level of 0.035 N m, which builds up over 0.0013 rad "
        "(0.074 degrees) after each reversal; presliding damping 0.89 N m s/rad below 55 rad/s"
    )


@pytest.mark.parametrize(
    ("beta", "says"),
    [
        (0.5, "the hub has a hysteretic torque of up to 0.07 N m"),
        (0.03, "; beta = 0.03: hardly any hysteresis"),
        (
            1e-11,
            "a spring at the hub that saturates at 0.07 N m over 0.43 rad (25 degrees); beta = 0: no hys",
        ),
    ],
)
def test_bouc_wen_without_a_hysteretic_part_is_called_a_spring(beta, says):
    assert says in CATALOG["bouc_wen"]("hub", 0.07, width=0.43, beta=beta).sentence()


@pytest.mark.parametrize(("offset", "says"), [(0.175, "0.175 V above"), (-0.02, "0.02 V below")])
def test_an_offset_says_on_which_side_of_the_command_the_voltage_is(offset, says):
    assert CATALOG["voltage_offset"]("input", offset).sentence() == f"the motor voltage is {says} the command"


@every_effect
def test_frozen_hashable_and_replaced_by_value(cls):
    effect = example(cls)
    assert effect == example(cls) and hash(effect) == hash(example(cls))
    name = next(iter(effect.values))
    with pytest.raises(dataclasses.FrozenInstanceError):
        setattr(effect, name, 1.0)
    changed = effect.replace(**{name: 2 * effect.values[name] + 0.5})
    assert changed != effect and changed.at == effect.at


@every_effect
def test_bad_parameters_are_named(cls):
    for name, spec in cls.declared().items():
        bad = [math.nan, math.inf, "1.0", np.float64(math.nan)]
        bad += [None] if getattr(cls, name) is not None else []
        bad += [spec.lower - 1.0] if math.isfinite(spec.lower) else []
        for value in bad:
            with pytest.raises(InputError, match=f"{cls.__name__} was given {name}="):
                cls(at=cls.ports[0], **{name: value})
    with pytest.raises(InputError, match="name of a port"):
        cls(at=0.3)


@pytest.mark.parametrize("cls", CATALOG.values(), ids=CATALOG)
def test_a_misspelt_parameter_is_refused(cls):
    accepted = list(inspect.signature(cls).parameters)
    assert {"at", *cls.declared()} <= set(accepted)
    last = accepted[-1]
    with pytest.raises(InputError) as refused:
        cls(**{"at": cls.ports[0], f"{last}s": 0.1})
    said = f"{cls.__name__} was given {last}s=0.1, but accepts {', '.join(accepted)}; did you mean {last}?"
    assert str(refused.value) == said


def test_what_may_be_negative():
    """Only signed quantities, and viscous damping, which is relative to the damping of the motor."""
    negative = {f"{c.name}.{n}" for c in CLASSES for n, s in c.declared().items() if s.lower < 0}
    assert negative == {
        "viscous.coefficient",
        "cubic_spring.stiffness",
        "quadratic_spring.stiffness",
        "gravity.sine",
        "gravity.cosine",
        "cogging.sine",
        "cogging.cosine",
        "voltage_offset.offset",
        "voltage_drift.rate",
        "periodic_disturbance.sine",
        "periodic_disturbance.cosine",
        "viscous_asymmetric.asymmetry",
        "sensor_bias.bias",
        "sensor_gain.error",
        "sensor_cubic.cubic",
        "rectifier.loss",
        "eccentric_encoder.cosine",
        "eccentric_encoder.sine",
        "cross_talk.share",
        "measured_disturbance.gain",
    }


def test_every_file_registers_and_knows_no_sibling():
    folder = Path(effects.__file__).parent
    apart = {"__init__", "base", "labels", "learned"}
    registered = {c.__module__.rpartition(".")[2] for c in CLASSES}
    assert {f.stem for f in folder.glob("*.py")} - apart == registered
    allowed = {"effects.base", "parameters", "checks", "errors"}
    for file in folder.glob("*.py"):
        if file.stem in apart:
            continue
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            module = node.module if isinstance(node, ast.ImportFrom) else ""
            if module and module.startswith("rotflex_jax."):
                assert module.removeprefix("rotflex_jax.") in allowed, f"{file.name}: {module}"
    exported = {name for name in effects.__all__ if isinstance(getattr(effects, name), type)}
    assert {c.__name__ for c in CLASSES} <= exported


@pytest.mark.parametrize(
    ("kind", "missing"),
    [
        (Linear, "stamp"),
        (Force, "force"),
        (DryFriction, "limit"),
        (Memory, "flow, force"),
        (Gear, "rotor, stops"),
        (Actuation, "drive"),
        (Sensing, "measure"),
        (Effect, "a kind that it derives from"),
    ],
)
def test_a_class_without_the_methods_of_its_kind_cannot_be_defined(kind, missing):
    declared = {"name": "half_done", "title": "half done", "equation": "tau = 0"}
    with pytest.raises(InputError, match=f"HalfDone was defined without {missing},"):
        type("HalfDone", (kind,), declared)


def test_a_class_that_a_search_tries_says_at_which_values():
    declared = {"title": "t", "equation": "tau = 0", "searched": ("hub",), "stamp": Spring.stamp}
    with pytest.raises(InputError, match="without probes"):
        type("Unprobed", (Linear,), {"name": "unprobed", **declared})
    type("Family", (Linear,), declared)  # a base class of several effects has no name yet


def test_a_name_is_taken_once():
    @dataclasses.dataclass(frozen=True)
    class Impostor(Coulomb):
        name: ClassVar[str] = "stribeck"

    with pytest.raises(InputError, match="'stribeck' is taken by Stribeck"):
        register(Impostor)
    assert CATALOG["stribeck"] is Stribeck


def test_a_users_own_effect_enters_the_catalogue_and_the_search():
    @dataclasses.dataclass(frozen=True)
    class Cog(Coulomb):
        name: ClassVar[str] = "cog_of_a_user"
        searched: ClassVar[tuple[str, ...]] = ("arm",)

    try:
        assert register(Cog) is Cog
        assert (Cog, "arm") in search_places(paper())
        register(Cog)  # as in a notebook cell that is run twice
    finally:
        del CATALOG["cog_of_a_user"]


def test_candidates_cover_the_first_family():
    found = search_places(paper())
    pairs = {(cls.name, port) for cls, port in found}
    assert len(pairs) == len(found)
    for name in ("coulomb", "coulomb_asymmetric", "stribeck", "quadratic_drag", "viscous"):
        assert {(name, p) for p in ("hub", "arm", "joint")} <= pairs
    assert {p for n, p in pairs if n == "gravity"} == {"hub", "arm"}
    assert ("cubic_spring", "joint") in pairs and ("cubic_spring", "hub") not in pairs
    assert {("lag", "input"), ("delay", "input"), ("heating", "hub"), ("cogging", "hub")} <= pairs
    assert {("joint_play", "joint"), ("bouc_wen", "joint"), ("second_mode", "arm")} <= pairs
    assert {(name, p) for name in ("dahl", "lugre") for p in ("hub", "joint")} <= pairs
    assert {("sensor_cubic", "alpha"), ("rectifier", "alpha"), ("cross_talk", "alpha")} <= pairs
    assert {("eccentric_encoder", "theta"), ("channel_delay", "theta"), ("channel_delay", "alpha")} <= pairs
    assert {("voltage_drift", "input"), ("periodic_disturbance", "input")} <= pairs
    # Effects that are equivalent to a simpler one on most recordings are tried on request only.
    assert not {"load_friction", "amplifier_saturation", "elastic_backlash"} & {n for n, _ in pairs}
    assert not {"gear_friction", "torque_saturation"} & {n for n, _ in pairs}  # no weight at the hub
    assert ("heating", "arm") not in pairs and ("heating", "joint") not in pairs  # no motor there
    assert ("sensor_bias", "alpha") in pairs and ("sensor_bias", "theta") not in pairs
    assert not {"inertia", "spring", "motor"} & {n for n, _ in pairs}


# -- the law of each one ------------------------------------------------------------------------


def test_linear_stamps():
    assert Inertia(at="arm", inertia=0.0059).stamp().inertia == 0.0059
    assert Spring(at="joint", stiffness=1.61).stamp().stiffness == 1.61
    assert Viscous(at="hub", coefficient=-0.01).stamp().damping == -0.01


def test_motor_by_the_papers_numbers():
    """g = 0.2065 N m/V, b = 0.110870 N m s/rad, 1.86254 rad/s/V running free."""
    stamp = Motor().stamp()
    np.testing.assert_allclose(stamp.drive, 0.2065, rtol=1e-12)
    np.testing.assert_allclose(stamp.damping, 0.110870, atol=5e-7)
    np.testing.assert_allclose(stamp.drive / stamp.damping, 1.86254, atol=5e-6)
    lossy = Motor(efficiency=0.621).stamp()
    np.testing.assert_allclose(lossy.drive, 0.621 * stamp.drive, rtol=1e-15)
    np.testing.assert_allclose(lossy.damping, 0.621 * stamp.damping, rtol=1e-15)


def test_motor_with_inductance_has_the_same_steady_state():
    slow, quick = Motor(inductance=0.18e-3, efficiency=0.8), Motor(efficiency=0.8)
    assert (slow.order, quick.order) == (1, 0)
    s = slow.stamp()
    v, w = 3.0, 2.0
    current = -(s.from_voltage[0] * v + s.from_speed[0] * w) / s.own[0][0]
    q = quick.stamp()
    np.testing.assert_allclose(s.torque[0] * current, q.drive * v - q.damping * w, rtol=1e-14)
    np.testing.assert_allclose(s.own[0][0], -2.6 / 0.18e-3, rtol=1e-15)


def test_dry_friction_levels():
    assert Coulomb(at="hub", level=0.03).limit(0.0, 2.0, -1.0) == 0.03
    uneven = CoulombAsymmetric(at="hub", forward=0.045, backward=0.015)
    assert float(uneven.limit(0.0, 1.0, 1.0)) == 0.045
    assert float(uneven.limit(0.0, 1.0, -1.0)) == 0.015
    stribeck = Stribeck(at="hub", level=0.02, excess=0.01, speed=0.3)
    at = lambda speed: float(stribeck.limit(0.0, jnp.asarray(speed), 1.0))  # noqa: E731
    np.testing.assert_allclose(at(0.0), 0.03, rtol=1e-15)
    np.testing.assert_allclose(at(0.3), 0.02 + 0.01 / math.e, rtol=1e-15)
    np.testing.assert_allclose(at(30.0), 0.02, rtol=1e-15)


def test_force_laws():
    x, w, v = scalars(0.2, -3.0, 1.0)
    np.testing.assert_allclose(QuadraticDrag("arm", 0.01).force(x, w, v), 0.09, rtol=1e-14)
    np.testing.assert_allclose(CubicSpring("joint", 60.0).force(x, w, v), -0.48, rtol=1e-14)
    np.testing.assert_allclose(QuadraticSpring("joint", 3.0).force(x, w, v), -0.12, rtol=1e-14)
    np.testing.assert_allclose(QuadraticSpring("joint", 3.0).force(-x, w, v), -0.12, rtol=1e-14)


def test_gravity_is_a_pendulum():
    """An unbalance m g l that hangs lowest at `rest` restores with m g l sin(x - rest)."""
    size, rest = 0.3, 0.7
    weight = Gravity("hub", sine=size * math.cos(rest), cosine=-size * math.sin(rest))
    x = jnp.linspace(-4.0, 4.0, 9)
    expected = -size * jnp.sin(x - rest)
    np.testing.assert_allclose(weight.force(x, x, x), expected, rtol=1e-13, atol=1e-16)
    assert f"{math.degrees(rest):.0f} degrees" in weight.sentence()


def test_actuation_laws_and_their_order():
    v = jnp.array([-6.0, -0.2, -0.05, 0.0, 0.05, 0.3, 6.0])
    zone = DeadZone(positive=0.25, negative=0.1).drive(v, 0.01)
    np.testing.assert_allclose(zone, [-5.9, -0.1, 0, 0, 0, 0.05, 5.75], atol=1e-15)
    limited = Saturation(limit=5.0).drive(v, 0.01)
    np.testing.assert_allclose(limited, [-5, -0.2, -0.05, 0, 0.05, 0.3, 5], atol=0)
    np.testing.assert_allclose(VoltageOffset(offset=0.3).drive(v, 0.01), v + 0.3, atol=0)
    soft = np.asarray(AmplifierSaturation(limit=5.0).drive(v, 0.01))
    np.testing.assert_allclose(soft, 5 * (1 - 2 / (np.exp(2 * v / 5) + 1)), rtol=1e-13, atol=1e-15)
    small = np.asarray(AmplifierSaturation(limit=5.0).drive(v / 100, 0.01))
    np.testing.assert_allclose(small, v / 100 * (1 - (v / 500) ** 2 / 3), rtol=1e-7)
    assert AmplifierSaturation.stage == Saturation.stage
    assert Saturation.stage < VoltageOffset.stage < DeadZone.stage < Delay.stage < Lag.stage
    assert DeadZone().at == "input"


def like_on_a_mass(mean, moment):
    """Held voltages that move a mass like the true ones, from their means and first moments.

    The moment of a sample is `int (t - middle) v dt / Ts^2`: it moves the mass back in proportion. A pulse in
    this sample and its opposite in the next one have the same effect.
    """
    return mean - np.diff(moment, prepend=0.0)


@pytest.mark.parametrize("samples", [0, 1, 3, 0.25, 1.5, 2.999, 40, 41.3])
def test_delay_moves_a_mass_like_the_shifted_staircase(samples):
    """Reference: the shifted staircase on a grid 1000 times as fine, on which its steps lie exactly."""
    rng, Ts, N, fine = np.random.default_rng(0), 0.004, 30, 1000
    u = rng.normal(size=N)
    late = np.asarray(Delay(time=samples * Ts).drive(jnp.asarray(u), Ts))
    middles = (np.arange(N * fine) + 0.5) / fine
    v = u[np.maximum(np.floor(middles - samples).astype(int), 0)].reshape(N, fine)
    expected = like_on_a_mass(v.mean(axis=1), (v * (middles.reshape(N, fine) % 1 - 0.5)).mean(axis=1))
    np.testing.assert_allclose(late, expected, rtol=0, atol=1e-12)
    if samples in (0, 1, 3):
        np.testing.assert_allclose(late[samples:], u[: N - samples], rtol=0, atol=1e-12)
    if samples >= N:
        np.testing.assert_allclose(late, u[0], rtol=0, atol=1e-12)


@pytest.mark.parametrize("time", [3e-4, 0.006, 0.5])
def test_lag_moves_a_mass_like_a_low_pass(time):
    """Reference: scipy's `lsim` on a grid 100 times as fine, with Simpson's rule over each sample."""
    rng, Ts, N, fine = np.random.default_rng(0), 0.004, 30, 100
    u = rng.normal(size=N)
    t = np.arange(N * fine + 1) * Ts / fine
    held = np.append(np.repeat(u, fine), u[-1])
    v = scipy.signal.lsim(([1.0], [time, 1.0]), held - u[0], t, interp=False)[1] + u[0]
    parts = np.stack([v[k * fine : (k + 1) * fine + 1] for k in range(N)])
    mean = scipy.integrate.simpson(parts, dx=1 / fine, axis=1)
    moment = scipy.integrate.simpson(parts * np.linspace(-0.5, 0.5, fine + 1), dx=1 / fine, axis=1)
    found = np.asarray(Lag(time=time).drive(jnp.asarray(u), Ts))
    expected = like_on_a_mass(mean, moment)
    np.testing.assert_allclose(found, expected, rtol=0, atol=4e-6 if time < 1e-3 else 1e-8)
    assert found[0] == u[0]


def test_a_short_lag_is_a_short_delay():
    """Both delay a ramp by the same time."""
    Ts = 0.004
    ramp = jnp.arange(400.0) * Ts
    late, slow = (e.drive(ramp, Ts) for e in (Delay(time=0.0101), Lag(time=0.0101)))
    np.testing.assert_allclose(slow[100:], late[100:], rtol=0, atol=1e-12)
    np.testing.assert_allclose(late[100:], ramp[100:] - 0.0101, rtol=0, atol=1e-12)


def test_cogging_repeats_and_keeps_energy():
    torque = Cogging("hub", sine=0.02, cosine=-0.013, periods=7.0)
    x = jnp.linspace(-1.0, 1.0, 201)
    said = np.asarray(torque.force(x, x, x))
    np.testing.assert_allclose(torque.force(x + 2 * np.pi / 7, x, x), said, rtol=0, atol=1e-15)
    np.testing.assert_allclose(torque.force(x + np.pi / 7, x, x), -said, rtol=0, atol=1e-15)
    # The work is the difference of a potential in closed form.
    stored = (-0.02 * np.cos(7 * x) - 0.013 * np.sin(7 * x)) / 7
    work = scipy.integrate.simpson(said, x=x)
    np.testing.assert_allclose(work, stored[0] - stored[-1], rtol=1e-6)
    assert max(abs(said)) == pytest.approx(math.hypot(0.02, 0.013), rel=1e-3)
    assert "0.0239 N m" in torque.sentence() and "7 times per turn" in torque.sentence()


def test_the_joint_is_loose_within_its_play():
    """Spring and play together are a spring that begins at the edge of the play."""
    play, stiffness = 0.006, 1.61
    x = jnp.asarray([-0.02, -0.006, -0.0059, -0.001, 0.0, 0.003, 0.006, 0.0061, 0.5])
    spring = -stiffness * x
    together = spring + JointPlay("joint", play, stiffness).force(x, x, x)
    expected = -stiffness * np.sign(x) * np.maximum(np.abs(x) - play, 0)
    np.testing.assert_allclose(together, expected, rtol=0, atol=1e-16)


def test_a_play_of_nothing_has_the_slope_of_a_small_one():
    force = lambda play: JointPlay("joint", play, 1.5).force(jnp.asarray([-0.3, 0.2]), 0.0, 0.0)  # noqa: E731
    np.testing.assert_array_equal(jax.jacfwd(force)(jnp.asarray(0.0)), [-1.5, 1.5])


def test_sensing_laws():
    assert SensorCubic("alpha", cubic=6.0).measure(-0.2) == pytest.approx(-0.248, rel=1e-14)
    value = jnp.array([-2.0, -0.1, 0.0, 0.3])
    np.testing.assert_array_equal(Rectifier("alpha", loss=1.0).measure(value), [0, 0, 0, 0.3])
    np.testing.assert_array_equal(Rectifier("alpha", loss=2.0).measure(value), np.abs(value))
    np.testing.assert_allclose(Rectifier("alpha", loss=0.15).measure(value), [-1.7, -0.085, 0, 0.3])
    assert SensorBias("alpha", bias=0.02).measure(0.1) == pytest.approx(0.12, rel=1e-15)
    assert SensorGain("alpha", error=-0.1).measure(0.2) == pytest.approx(0.18, rel=1e-15)


def test_dahl_builds_up_over_the_presliding():
    """In a steady motion z = 1 - exp(-x / presliding): a closed form."""
    friction = Dahl("hub", level=0.03, presliding=0.004)
    x = jnp.linspace(0.0, 0.03, 50)
    z = 1 - jnp.exp(-x / 0.004)
    speed = jnp.full_like(x, 1.7)
    rate = friction.flow(z, x, speed, x)
    np.testing.assert_allclose(rate, 1.7 * jnp.exp(-x / 0.004) / 0.004, rtol=1e-12)
    np.testing.assert_allclose(friction.force(z, x, speed, x)[-1], -0.03, rtol=1e-3)
    assert friction.initial() == 0.0
