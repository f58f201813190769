"""Sensitivities computed with the run, and inactive ones, against derivatives of whole runs."""

import dataclasses
import functools
import re
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiler_options import ROUGH

import rotflex_jax.effects as fx
from rotflex_jax.joints import paper
from rotflex_jax.mechanism import (
    Exponential,
    Mechanism,
    SmoothRK4,
    free_run,
    kalman_gains,
    predictor_run,
    simulate,
)
from rotflex_jax.mechanism.assembly import Layout, motor_voltage, rest_state
from rotflex_jax.mechanism.inactive_laws import run_responses
from rotflex_jax.mechanism.roles import search_places
from rotflex_jax.mechanism.sensitivities import (
    RecordingSamples,
    RunParameters,
    TangentDirections,
    inactive_sensitivities,
    outputs_with_sensitivities,
)
from rotflex_jax.mechanism.simulate import PredictorStep, read_outputs
from rotflex_jax.runtime.xla import double_precision, loops_are_fast

Ts, N = 0.004, 150
SOLVER = Exponential(passes=2)

BASELINES = {
    # Absent effects have states on both sides of the memory, and behind the motor current.
    "memory and current": paper(inductance=0.18e-3, joint_damping=1e-3) + fx.Dahl("arm", 0.004, 0.01),
    "dry friction": paper(joint_damping=1e-3) + fx.Coulomb("hub", 0.03),
}
FEW = {
    ("second_mode", "arm"),
    ("heating", "hub"),
    ("lugre", "joint"),
    ("bouc_wen", "joint"),
    ("lag", "input"),
    ("rectifier", "alpha"),
    ("coulomb", "arm"),
    ("coulomb", "joint"),
    ("stribeck", "joint"),
}


def places(case: str) -> list[tuple[type[fx.Effect], str]]:
    """Each effect of a search at one place where the baseline lacks it; a few of them for dry friction.

    The place is the first for one effect, the second for the next, and so on.
    """
    has = {(e.name, e.at) for e in BASELINES[case].effects}
    pairs = [(cls, port) for cls, port in search_places(BASELINES[case]) if (cls.name, port) not in has]
    # A gear with a gap of zero has no derivative.
    pairs = [pair for pair in pairs if not issubclass(pair[0], fx.Gear)]
    if case == "dry friction":
        return [(cls, port) for cls, port in pairs if (cls.name, port) in FEW]
    ports = {cls: [at for other, at in pairs if other is cls] for cls in dict.fromkeys(c for c, _ in pairs)}
    return [(cls, at[k % len(at)]) for k, (cls, at) in enumerate(ports.items())]


@dataclasses.dataclass(frozen=True)
class Case:
    """A baseline, the same with absent effects, a recording, and directions along these effects."""

    baseline: Mechanism
    full: Mechanism
    present: list[int]
    numbers: RunParameters
    samples: RecordingSamples
    names: list[str]
    dvalues: np.ndarray
    dgates: np.ndarray

    def run(self, values: Any, gates: Any) -> jax.Array:
        """Predicted outputs of the whole structure by an ordinary scan."""
        structure, n, s = self.full.structure, self.numbers, self.samples
        step, mechanism = PredictorStep(structure, SOLVER), structure.with_values(values)
        constants = (SOLVER.prepare(structure, values, gates, s.Ts), n.K)
        inputs = (motor_voltage(mechanism, gates, s.u, s.Ts), s.y, s.seen)
        X = jax.lax.scan(lambda x, w: (step(x, w, constants), x), n.x0, inputs)[1]
        return read_outputs(mechanism, gates, X.T).T


def own_states(mechanism: Mechanism, first: int) -> list[int]:
    """Indices in the state that belong to the effects from `first` on."""
    kept, at = [], 2 * len(mechanism.coordinates)
    for part in ("linear", "memory"):
        for i, e in enumerate(mechanism.effects):
            if e.state_part == part:
                kept += [at + k for k in range(e.order)] if i >= first else []
                at += e.order
    return kept


@functools.cache
def case_of(case: str) -> Case:
    baseline = full = BASELINES[case]
    for cls, port in places(case):
        shape = {n: 0.0 if n in cls.amplitudes else 1.1 * s.typical for n, s in cls.declared().items()}
        shape |= {"limit": 0.8} if cls is fx.Saturation else {}  # one that the voltage reaches
        full = full + cls(at=port, **shape)
    first, names = len(baseline.effects), full.parameter_names
    listed, dvalues, dgates = [], [], []
    for i, e in enumerate(full.effects[first:], first):
        for name in e.amplitudes or (None,):
            dvalues.append(np.zeros(len(names)))
            dgates.append(np.zeros(len(full.effects)))
            if name is None:
                dgates[-1][i] = 1.0
            else:
                dvalues[-1][names.index(f"{e.at}.{e.name}.{name}")] = e.declared()[name].typical
            listed.append(f"{e.at}.{e.name}.{name}")
    size, absent = Layout.of(full.structure).size, own_states(full, first)
    present = [i for i in range(size) if i not in absent]
    rng = np.random.default_rng(0)
    # Gains of a predictor with large process noise, and random gains for the absent states.
    K = 0.05 * rng.normal(size=(size, 2))
    K[present] = kalman_gains(baseline, [{"hub": 1e-4, "joint": 1e-5}], [5e-4, 5e-4], Ts)[0]
    assert np.abs(K[:4]).max() > 50
    u = 1.5 * np.repeat(rng.normal(size=N // 5), 5)
    y = simulate(paper(stiffness=1.5), u, Ts) + 5e-4 * rng.normal(size=(N, 2))
    x0 = rest_state(full.structure, np.float64)
    x0[:4] = [0.1, 0.01, 0.2, -0.1]
    gates = [1.0 if i < first or e.amplitudes else 0.0 for i, e in enumerate(full.effects)]
    with double_precision():
        numbers = RunParameters(*map(jnp.asarray, (full.values, np.array(gates), x0, K)))
        samples = RecordingSamples(*map(jnp.asarray, (u, y, 1.0 * (rng.random(N) < 0.9), Ts)))
    return Case(baseline, full, present, numbers, samples, listed, np.array(dvalues), np.array(dgates))


@functools.cache
def found(case: str) -> np.ndarray:
    """Inactive sensitivities from the recursion of the baseline alone."""
    c = case_of(case)
    with double_precision():
        present = jnp.array(c.present)
        values, gates = jnp.asarray(c.baseline.values), jnp.ones(len(c.baseline.effects))
        mine = RunParameters(values, gates, c.numbers.x0[present], c.numbers.K[present])
        responses = jax.jit(run_responses, static_argnums=(0, 1, 2), compiler_options=ROUGH)
        run = responses(c.baseline.structure, SOLVER, (), mine, c.samples).run
        assert run.A.shape == (N, len(present), len(present))
        along = jax.jit(inactive_sensitivities, static_argnums=(0, 1, 2), compiler_options=ROUGH)
        inactive = tuple(range(len(c.baseline.effects), len(c.full.effects)))
        given = (c.numbers, c.samples, present, run, jnp.asarray(c.dvalues), jnp.asarray(c.dgates))
        return np.asarray(along(c.full.structure, SOLVER, inactive, *given))


@pytest.mark.parametrize("case", ["dry friction", pytest.param("memory and current", marks=pytest.mark.slow)])
def test_slopes_are_those_of_the_whole_run(case):
    """Against JAX's own derivative of a scan that carries every effect and its states."""
    c = case_of(case)
    assert len(places(case)) >= len(FEW) and len(c.present) < Layout.of(c.full.structure).size

    def slope(dvalues, dgates):
        return jax.jvp(c.run, (c.numbers.values, c.numbers.gates), (dvalues, dgates))[1]

    with double_precision():
        ways = (jnp.asarray(c.dvalues), jnp.asarray(c.dgates))
        expected = np.asarray(jax.jit(jax.vmap(slope), compiler_options=ROUGH)(*ways))
    for name, mine, whole in zip(c.names, found(case), expected, strict=True):
        size = np.abs(whole).max()
        assert size > 1e-6, name  # a drift grows from zero, to 2e-6 V in this run
        np.testing.assert_allclose(mine, whole, rtol=0, atol=1e-9 * size, err_msg=name)


@functools.cache
def with_a_little(h: float) -> np.ndarray:
    """Outputs of the whole run, first unchanged, then with `h` times each direction."""
    c = case_of("dry friction")
    with double_precision():
        run = jax.jit(jax.vmap(c.run), compiler_options=ROUGH)
        values = c.numbers.values[None] + h * jnp.asarray(np.vstack([0 * c.dvalues[:1], c.dvalues]))
        gates = c.numbers.gates[None] + h * jnp.asarray(np.vstack([0 * c.dgates[:1], c.dgates]))
        return np.asarray(run(values, gates))


def test_slopes_foretell_what_a_little_of_an_effect_does():
    """Reference: the difference of two runs, one with a millionth of the effect's usual size."""
    c, y = case_of("dry friction"), with_a_little(1e-6)
    for name, mine, moved in zip(c.names, found("dry friction"), (y[1:] - y[0]) / 1e-6, strict=True):
        if name.startswith(("joint.coulomb", "joint.stribeck")):
            # Two contacts that stop in one step share the slip, however small one of them is.
            continue
        np.testing.assert_allclose(mine, moved, rtol=0, atol=1e-5 * np.abs(moved).max(), err_msg=name)


def test_a_run_with_absent_effects_is_the_run_without():
    c = case_of("dry friction")
    with double_precision():
        run = jax.jit(predictor_run, static_argnums=(0, 1), compiler_options=ROUGH)
        gates, present = jnp.ones(len(c.baseline.effects)), jnp.array(c.present)
        numbers = (jnp.asarray(c.baseline.values), gates, c.numbers.x0[present])
        samples = (c.samples.u, c.samples.y, c.samples.seen, c.numbers.K[present], c.samples.Ts)
        plain = np.asarray(run(c.baseline.structure, SOLVER, *numbers, *samples)[1])
    np.testing.assert_allclose(with_a_little(1e-6)[0], plain, rtol=0, atol=1e-12)


JOINT = paper(hub_damping=0.01, joint_damping=0.002, inductance=2e-4)
PLAIN = paper(hub_damping=0.01, joint_damping=0.002)
CASES = {
    "forces": (JOINT + fx.CubicSpring("joint", 4.0), Exponential(order=4), False),
    "two contacts": (
        PLAIN + fx.Coulomb("hub", 0.02) + fx.Coulomb("joint", 0.01),
        Exponential(passes=1),
        True,
    ),
    "memory": (PLAIN + fx.LuGre("hub"), Exponential(), True),
    "sensor and input": (
        PLAIN + fx.SensorCubic("alpha", 0.1) + fx.Lag(time=0.004),
        Exponential(substeps=2, between="smooth"),
        True,
    ),
    "one direction by itself": (PLAIN + fx.CubicSpring("joint", 4.0), SmoothRK4(substeps=2), False),
}


@pytest.mark.parametrize("case", CASES)
def test_slopes_are_those_that_jax_takes(case: str) -> None:
    joint, solver, corrected = CASES[case]
    structure = joint.structure
    rng = np.random.default_rng(0)
    N, n, P, E = 120, len(rest_state(structure, np.float64)), len(joint.values), len(joint.effects)
    ways = TangentDirections(
        rng.normal(size=(5, P)) * joint.values, np.zeros((5, E)), 0.1 * rng.normal(size=(5, n))
    )
    ways.gates[4, -1] = 1.0
    samples = RecordingSamples(
        3 * rng.normal(size=N), 0.1 * rng.normal(size=(N, 2)), np.arange(N) % 7 > 0.0, 0.002
    )
    gain = 0.2 * rng.normal(size=(n, 2)) if corrected else None
    with double_precision():
        given = jax.tree.map(jnp.asarray, (joint.values, np.ones(E), 0.05 * rng.normal(size=n)))
        u, y, seen, Ts = (jnp.asarray(a, jnp.float64) for a in samples[:4])

        def run(*point: jax.Array) -> jax.Array:
            values, gates, x0 = point
            if gain is None:
                return free_run(structure, solver, values, gates, x0, u, Ts)[1]
            return predictor_run(structure, solver, values, gates, x0, u, y, seen, jnp.asarray(gain), Ts)[1]

        directions = jax.tree.map(jnp.asarray, tuple(ways))
        slope = jax.vmap(lambda p, g, x: jax.jvp(run, given, (p, g, x))[1], out_axes=-1)
        y_hat, J = jax.jit(lambda: (run(*given), slope(*directions)), compiler_options=ROUGH)()
        numbers = RunParameters(given[0], given[1], given[2], None if gain is None else jnp.asarray(gain))
        carried = jax.jit(outputs_with_sensitivities, static_argnums=(0, 1))
        got = carried(
            structure, solver, numbers, TangentDirections(*directions), RecordingSamples(u, y, seen, Ts)
        )
    np.testing.assert_allclose(got[0], y_hat, rtol=1e-10, atol=1e-12 * np.abs(y_hat).max())
    np.testing.assert_allclose(got[1], J, rtol=1e-7, atol=1e-9 * np.abs(J).max())


def compiled_slopes(joint: Mechanism, D: int, options: dict[str, Any] | None = None) -> str:
    """Text of the compiled program of N samples of a predictor with its sensitivities along D directions."""
    structure = joint.structure
    with double_precision():
        P, E, n = len(joint.values), len(joint.effects), Layout.of(structure).size
        numbers = RunParameters(jnp.asarray(joint.values), jnp.ones(E), jnp.zeros(n), jnp.zeros((n, 2)))
        directions = TangentDirections(jnp.ones((D, P)), jnp.zeros((D, E)), jnp.zeros((D, n)))
        samples = RecordingSamples(jnp.zeros(N), jnp.zeros((N, 2)), jnp.ones(N), jnp.asarray(Ts))
        run = jax.jit(functools.partial(outputs_with_sensitivities, structure, SOLVER))
        return run.lower(numbers, directions, samples).compile(options).as_text()


def test_slopes_of_a_large_structure_are_one_function():
    """All operations over samples and 32 directions are small calls of compiled functions."""
    if not loops_are_fast():
        pytest.skip("XLA was started without the option for small loops")
    joint = paper() + fx.Backlash("hub") + fx.Dahl("hub") + fx.LuGre("joint") + fx.Cogging("arm")
    D = 32
    program = compiled_slopes(joint, D, ROUGH)
    main = program[program.index("ENTRY") :].splitlines()
    over_samples = [line for line in main if f"[{N},2,{D}]" in line and ("call(" in line or "while(" in line)]
    assert over_samples and all("xla_cpu_small_call" in line for line in over_samples)


def test_a_law_is_evaluated_once_for_all_states_and_directions_that_it_moves():
    """Counted in the compiled program: a step of order 2 evaluates a torque twice, with its derivative."""
    joint = paper() + fx.LuGre("hub", 0.02, 0.02) + fx.Cogging("arm", 0.01, 0.01, 7.0)
    n, D = Layout.of(joint.structure).size, 16
    program = compiled_slopes(joint, D)
    assert [program.count(f" {name}(") for name in ("sine", "cosine")] == [2, 2]
    # No single loop over states and directions contains both evaluations of the friction.
    loops = [part for part in program.split("\n\n") if f"-> f64[{n},{D}]" in part.split("\n")[0]]
    longest = max(len(re.findall(rf"= f64\[{D}\]\S* (?:multiply|add|subtract|select)\(", x)) for x in loops)
    assert loops and longest < 30, longest
