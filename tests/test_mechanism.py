"""Mechanisms: refused arguments, adding and removing of effects, and no new program for other values."""

import dataclasses
from collections.abc import Callable
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rotflex_jax.effects as fx
from rotflex_jax.errors import InputError
from rotflex_jax.fit import fit
from rotflex_jax.joints import paper
from rotflex_jax.mechanism import Exponential, Mechanism, free_run, linearise, simulate
from rotflex_jax.mechanism.assembly import rest_state
from rotflex_jax.models.model import Model
from rotflex_jax.parameters import parameter
from rotflex_jax.recording import Recording
from rotflex_jax.runtime.xla import double_precision

PORTS = {"hub": (1.0, 0.0), "joint": (0.0, 1.0), "arm": (1.0, 1.0)}
OUTPUTS = {"theta": "hub", "alpha": "joint"}
BODY = (fx.Inertia("hub", inertia=0.002), fx.Inertia("arm", inertia=0.006))


def made(effects=BODY, ports=PORTS, outputs=OUTPUTS, trusted=(), units: Any = ("rad", "N m")) -> Mechanism:
    return Mechanism(("theta", "alpha"), ports, effects, outputs, trusted, units)


def noise(N: int, seed: int = 0) -> np.ndarray:
    return np.repeat(np.random.default_rng(seed).standard_normal(N // 5 + 1), 5)[:N]


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"ports": {**PORTS, "motor": (1.0,)}}, ["motor", "1 entries", "2 coordinates"]),
        ({"outputs": {"theta": "shaft"}}, ["theta", "shaft", "hub"]),
        ({"outputs": {"theta": ("hub", "torque")}}, ["torque", "'speed'"]),
        ({"effects": (*BODY, fx.Coulomb("wrist"))}, ["Coulomb", "wrist", "joint"]),
        ({"effects": (*BODY, fx.DeadZone("hub"))}, ["DeadZone", "hub", "input"]),
        ({"effects": (*BODY, fx.SensorBias("hub"))}, ["SensorBias", "hub", "alpha"]),
        ({"effects": (*BODY, fx.Inertia("hub", inertia=0.1))}, ["inertia", "hub", "Two"]),
        ({"trusted": ("hub.inertia.mass",)}, ["hub.inertia.mass", "hub.inertia.inertia"]),
        ({"units": "m"}, ["units", "'m'", '("m", "N")']),
        ({"units": ("m",)}, ["units", '("m", "N")']),
        ({"units": ("m", 1.0)}, ["units", '("m", "N")']),
        ({"units": ("m", "N", -1.0)}, ["units", '("m", "N")']),
    ],
)
def test_what_makes_no_sense_is_refused_in_words(given, words):
    with pytest.raises(InputError) as caught:
        made(**given)
    for word in words:
        assert word in str(caught.value)


def test_a_pair_of_units_is_taken() -> None:
    """A cart on a rail, with its units written as in docs/own_machine.md."""
    axis = Mechanism(
        coordinates=["x"],
        ports={"cart": (1,)},
        effects=[fx.CurrentDrive("cart", gain=5.0), fx.Inertia("cart", inertia=2.0), fx.Viscous("cart")],
        outputs={"x": "cart"},
        units=("m", "N"),  # pyright: ignore[reportArgumentType]
    )
    units = [s.unit for s in axis.parameter_specifications]
    assert dict(zip(axis.parameter_names, units, strict=True)) == {
        "cart.current_drive.gain": "N/V",
        "cart.inertia.inertia": "kg",
        "cart.viscous.coefficient": "N s/m",
    }
    assert (axis + fx.Coulomb("cart")).units == axis.units


def test_unknown_names_are_refused():
    joint = paper()
    for call in (
        lambda: joint.trust("hub.coulomb.level"),
        lambda: joint.release("hub.coulomb.level"),
        lambda: joint.with_values({"hub.coulomb.level": 0.1}),
        lambda: joint.without("coulomb", "hub"),
        lambda: joint.effect("coulomb", "hub"),
        lambda: joint + fx.Viscous("hub", coefficient=0.1),
    ):
        with pytest.raises(InputError, match=r"hub|Two"):
            call()


def test_what_is_added_can_be_taken_away():
    joint = paper().trust("joint.spring.stiffness")
    more = joint + fx.Coulomb("hub", level=0.03)
    assert more.parameter_names == (*joint.parameter_names, "hub.coulomb.level")
    assert "hub.coulomb.level" in more.free_names
    assert joint.parameter_names == paper().parameter_names  # the original is unchanged
    assert more.without("coulomb", "hub") == joint
    held = more.trust("hub.coulomb.level")
    assert held.without("coulomb", "hub") == joint  # a removed parameter is no longer trusted
    assert held.release("hub.coulomb.level") == more
    with pytest.raises(InputError, match=r"but 1\.0 was given"):
        joint + 1.0


def test_an_effect_changes_the_motion_and_its_absence_does_not():
    u, joint = noise(200), paper()
    plain = simulate(joint, u, 0.01)
    braked = joint + fx.Coulomb("hub", level=0.03)
    assert np.abs(simulate(braked, u, 0.01) - plain).max() > 0.01
    same = simulate(braked.with_values({"hub.coulomb.level": 0.0}), u, 0.01)
    np.testing.assert_allclose(same, plain, atol=1e-10)
    np.testing.assert_array_equal(simulate(braked.without("coulomb", "hub"), u, 0.01), plain)


def test_values_by_name_and_as_a_vector():
    joint = paper() + fx.Coulomb("hub", level=0.03)
    i = joint.parameter_names.index("joint.spring.stiffness")
    vector = joint.values
    vector[i] = 2.0
    named = joint.with_values({"joint.spring.stiffness": 2.0})
    assert named == joint.with_values(vector)
    assert named.effect("spring", "joint").stiffness == 2.0
    # Independent check: the stiffness in the equations of motion.
    M = np.array([[0.0021 + 0.0059, 0.0059], [0.0059, 0.0059]])
    np.testing.assert_allclose(linearise(named).A[2:, 1], np.linalg.solve(M, [0.0, -2.0]))


def test_structure_knows_no_numbers():
    one, two = paper(stiffness=1.0), paper(stiffness=2.0).trust("joint.spring.stiffness")
    assert one.structure == two.structure and hash(one.structure) == hash(two.structure)
    assert one.structure != (one + fx.Coulomb("hub")).structure
    assert one.structure != dataclasses.replace(one, outputs={"theta": "hub"}).structure
    assert one.structure != paper(inductance=1e-4).structure


def test_pytree_there_and_back():
    joint = (paper() + fx.Dahl("arm")).trust("joint.spring.stiffness")
    leaves, treedef = jax.tree.flatten(joint)
    np.testing.assert_array_equal(leaves, joint.values)
    assert jax.tree.unflatten(treedef, leaves) == joint
    doubled = jax.tree.map(lambda x: 2 * x, joint)
    np.testing.assert_array_equal(doubled.values, 2 * joint.values)
    assert doubled.trusted == joint.trusted


@pytest.mark.parametrize("use", [lambda joint: simulate(joint, noise(60), 0.01), linearise, Model])
def test_traced_values_are_refused_where_numbers_are_needed(use: Callable[[Mechanism], Any]) -> None:
    joint = paper()
    with pytest.raises(InputError, match=r"values that JAX traces.* use rotflex_jax\.mechanism\.free_run"):
        jax.jit(lambda joint: use(joint) and None)(joint)
    with pytest.raises(InputError, match=r"JAX traces `u`.* use rotflex_jax\.mechanism\.free_run"):
        jax.jit(lambda u: simulate(joint, u, 0.01))(noise(60))


def last_deflection(joint: Mechanism) -> jax.Array:
    values = jnp.stack([jnp.asarray(leaf) for leaf in jax.tree.leaves(joint)])
    structure = joint.structure
    gates = jnp.ones(len(joint.effects))
    start = jnp.asarray(rest_state(structure, np.float64))
    u = jnp.asarray(noise(60))
    return free_run(structure, Exponential(), values, gates, start, u, jnp.asarray(0.01))[1][-1, 1]


def test_jit_and_gradient_pass_through_a_mechanism():
    joint = paper(hub_damping=0.004) + fx.CubicSpring("joint", 20.0)
    with double_precision():
        value = float(jax.jit(last_deflection)(joint))
        gradient = jax.jit(jax.grad(last_deflection))(joint)
    assert isinstance(gradient, Mechanism)
    assert value == pytest.approx(simulate(joint, noise(60), 0.01)[-1, 1], rel=1e-12)
    found = dict(zip(joint.parameter_names, jax.tree.leaves(gradient), strict=True))
    for name, old in zip(joint.parameter_names, joint.values, strict=True):
        h = 1e-5 * abs(old) or 1e-7
        up, down = (simulate(joint.with_values({name: old + s * h}), noise(60), 0.01)[-1, 1] for s in (1, -1))
        expected = (up - down) / (2 * h)
        assert float(found[name]) == pytest.approx(expected, rel=1e-5, abs=1e-9), name


TRACED: list[str] = []


@dataclasses.dataclass(frozen=True)
class Counting(fx.Force):
    """A damper that records each time it is traced."""

    name: ClassVar[str] = "counting"
    title: ClassVar[str] = "a damper that counts"
    equation: ClassVar[str] = "tau = -gain * speed"

    gain: float = parameter(0.001, unit="N m s/rad")

    def force(self, position, speed, voltage):
        TRACED.append("force")
        return -self.gain * speed


def test_a_new_number_does_not_trace_again():
    joint = paper() + Counting("joint", gain=0.002) + fx.Coulomb("hub", level=0.03)
    u = noise(100)
    first = simulate(joint, u, 0.01)
    traced = len(TRACED)
    assert traced > 0
    changed = joint.with_values({"joint.counting.gain": 0.004, "hub.coulomb.level": 0.01})
    second = simulate(changed, -u, 0.02, x0=np.array([0.1, 0.0, 0.0, 0.0]))
    simulate(joint.trust("hub.coulomb.level"), u, 0.01)
    assert len(TRACED) == traced
    assert np.abs(second - first).max() > 1e-3
    simulate(joint + fx.Viscous("arm", coefficient=0.001), u, 0.01)
    assert len(TRACED) > traced  # a new structure is traced, so the count works


def test_a_second_fit_does_not_trace_again():
    joint = paper() + Counting("joint", gain=0.002)
    joint = joint.trust(*(n for n in joint.free_names if n != "joint.counting.gain"))
    records = []
    for seed in (1, 2):
        u = noise(120, seed)
        y = simulate(joint, u, 0.01) + 1e-4 * np.random.default_rng(seed).normal(size=(120, 2))
        records.append(Recording(u=u, y=y, Ts=0.01))
    fit(joint, records[0])
    traced = len(TRACED)
    start = joint.with_values({"joint.counting.gain": 0.001, "joint.spring.stiffness": 1.7})
    fit(start, records[1])
    assert len(TRACED) == traced


def test_gates_do_not_trace_again():
    joint = paper() + Counting("joint", gain=0.02)
    u = noise(110)
    record = Recording(u=u, y=simulate(joint, u, 0.01), Ts=0.01, accept=("units",))
    on = Model(joint, gates=(1.0,) * len(joint.effects))
    off = dataclasses.replace(on, gates=(*on.gates[:-1], 0.0))
    x0 = np.zeros(4)
    with_it = on.simulate(record, x0=x0)
    traced = len(TRACED)
    without = off.simulate(record, x0=x0)
    assert len(TRACED) == traced
    np.testing.assert_allclose(with_it, record.y, atol=1e-12)
    np.testing.assert_allclose(without, simulate(paper(), u, 0.01), atol=1e-12)
    assert np.abs(with_it - without).max() > 1e-3


def test_only_an_effect_is_added() -> None:
    joint = paper()
    for given, words in (
        (fx.LuGre, r"the class LuGre was given; .* rotflex_jax\.effects\.LuGre\(at='hub'\)"),
        (fx.Delay, r"effects\.Delay\(at='input'\)"),
        ("coulomb", r"'coulomb' was given; .*Coulomb\(at='hub'\)"),
    ):
        for start in (joint, Model(joint)):
            with pytest.raises(InputError, match=words):
                start + given  # type: ignore[operator]
