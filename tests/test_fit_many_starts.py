"""Many starts of a grey-box fit, on recordings of the arena's simulator and against scipy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import least_squares

import rotflex_jax.effects as fx
from rotflex_jax.arena.simulator.records import make_record
from rotflex_jax.errors import InputError
from rotflex_jax.fit.dataset import first_states, sensor_noise
from rotflex_jax.fit.many_starts import many_starts, minimise_starts
from rotflex_jax.fit.problem import directions, normal_equations
from rotflex_jax.joints import paper
from rotflex_jax.mechanism import Exponential, simulate
from rotflex_jax.mechanism.assembly import whole_state
from rotflex_jax.mechanism.sensitivities import RecordingSamples, RunParameters
from rotflex_jax.models.model import Model
from rotflex_jax.recording import Recording
from rotflex_jax.runtime.xla import double_precision


def recording(seed: int, seconds: float = 2.0) -> Recording:
    r = make_record((), seed=seed, seconds=seconds, fs=400.0, rms=1.5)
    return Recording(u=r["u"], y=r["y"], Ts=r["Ts"])


@pytest.mark.parametrize("effect", [fx.Coulomb("hub", 0.02), fx.Lag(time=0.004)], ids=["dry", "lag"])
def test_one_pass_has_the_sums_that_differences_of_runs_have(effect) -> None:
    joint = paper(hub_damping=0.01, joint_damping=0.002) + effect
    rng = np.random.default_rng(0)
    u, y, Ts = rng.normal(size=300), 0.1 * rng.normal(size=(300, 2)), 0.002
    seen, scale, x0 = (
        (np.arange(300) < 280).astype(float),
        np.array([0.1, 0.02]),
        np.array([0.1, -0.02, 0.5, 0.3]),
    )
    moved = [0, 2, len(joint.values) - 1]

    def error(steps: np.ndarray) -> np.ndarray:
        values = joint.values.copy()
        values[moved] *= 1 + steps[:3]
        y_hat = simulate(joint.with_values(values), u, Ts, x0 + steps[3:])
        return ((y_hat - y) / scale * seen[:, None]).ravel()

    h = 1e-6
    J = np.stack([(error(h * way) - error(-h * way)) / (2 * h) for way in np.eye(7)], axis=1)
    e = error(np.zeros(7))
    with double_precision():
        structure = joint.structure
        start = whole_state(structure, jnp.asarray(x0))
        numbers = RunParameters(jnp.asarray(joint.values), jnp.ones(len(joint.effects)), start, None)
        ways = directions(structure, jnp.asarray(joint.values), jnp.asarray(moved), 4)
        samples = RecordingSamples(*(jnp.asarray(a) for a in (u, y, seen, Ts)))
        sums = jax.jit(normal_equations, static_argnums=(0, 1))
        got = jax.device_get(sums(structure, Exponential(), numbers, ways, samples, jnp.asarray(scale)))
    np.testing.assert_allclose(got.cost, e @ e / 2, rtol=1e-10)
    # A difference quotient across the instant at which friction breaks away is not quite the derivative.
    np.testing.assert_allclose(got.gradient, J.T @ e, rtol=1e-4, atol=1e-4 * np.abs(J.T @ e).max())
    np.testing.assert_allclose(got.H, J.T @ J, rtol=1e-4, atol=1e-4 * np.diag(J.T @ J).min())


@pytest.fixture(scope="module")
def found():
    """Two recordings fitted jointly from widely spread starts around wrong parameters."""
    recordings = [recording(3), recording(3, seconds=1.6)]
    wrong = paper(hub_inertia=0.003, stiffness=1.1, hub_damping=0.02, joint_damping=0.01)
    said: list[str] = []
    result = many_starts(
        wrong, recordings, starts=10, spread=0.6, short_seconds=0.7, keep=3, seed=1, progress=said.append
    )
    return recordings, result, said


def test_the_best_is_the_optimum_that_scipy_finds(found) -> None:
    recordings, result, _ = found
    m = result.model.mechanism
    free = [m.parameter_names.index(n) for n in m.free_names]
    noise = sensor_noise(recordings, result.model)
    heads = first_states(result.model, recordings)

    def errors(x: np.ndarray) -> np.ndarray:
        values = m.values.copy()
        values[free] = np.exp(x[: len(free)])
        joint, x0 = m.with_values(values), x[len(free) :].reshape(2, 4)
        runs = [(simulate(joint, r.u, r.Ts, x) - r.y) / noise for r, x in zip(recordings, x0, strict=True)]
        return np.concatenate(runs).ravel()

    start = np.concatenate([np.log(m.values[free] * 1.05), heads.ravel()])
    reference = least_squares(errors, start, method="lm", xtol=1e-12, ftol=1e-12, gtol=1e-12)
    assert result.cost == pytest.approx(reference.cost, rel=1e-6)
    np.testing.assert_allclose(m.values[free], np.exp(reference.x[: len(free)]), rtol=2e-3)


def test_those_that_went_to_the_end_agree_and_are_in_order(found) -> None:
    _, result, said = found
    assert len(result.costs) == 3
    assert np.all(np.diff(result.costs) >= 0)
    assert result.share == 1.0
    assert "10 starts, 3 of them to the end" in str(result)
    assert any("first seconds: 8 done" in line for line in said)


def test_other_values_compile_nothing_again(found) -> None:
    recordings, _, _ = found
    before = len(minimise_starts)
    other = paper(hub_inertia=0.0025, stiffness=1.9, hub_damping=0.004, joint_damping=0.001)
    many_starts(other, recordings, starts=10, spread=0.3, short_seconds=0.7, keep=3, seed=5, max_steps=3)
    assert len(minimise_starts) == before


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"starts": 0}, "starts"),
        ({"keep": 2.5}, "keep"),
        ({"spread": 1.0}, "spread"),
        ({"short_seconds": -1.0}, "short_seconds"),
    ],
)
def test_bad_input_names_itself(given, said) -> None:
    with pytest.raises(InputError, match=f"`{said}`"):
        many_starts(paper(), recording(1, seconds=1.0), **given)


def test_nothing_to_fit_is_refused() -> None:
    joint = paper()
    with pytest.raises(InputError, match="trusted"):
        many_starts(Model(joint.trust(*joint.free_names)), recording(1, seconds=1.0))
