"""Volterra kernels of physical models against tables, closed forms and least squares on simulated data."""

import dataclasses
import json
from pathlib import Path
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from scipy.signal import lfilter
from scipy.stats import norm

import rotflex_jax.effects as fx
from rotflex_jax.basis import Delays, Orthonormal, Volterra
from rotflex_jax.errors import InputError
from rotflex_jax.fit import least_squares
from rotflex_jax.joints import paper
from rotflex_jax.kernels import Kernels, average_kernels, effect_kernels, identified_kernels, local_kernels
from rotflex_jax.kernels.average import _size_without_noise
from rotflex_jax.kernels.figure import kernel_figure
from rotflex_jax.kernels.sensitivities import output_derivatives
from rotflex_jax.mechanism import Exponential, Mechanism, free_run, simulate
from rotflex_jax.mechanism.assembly import rest_state
from rotflex_jax.models.model import Model
from rotflex_jax.recording import Recording
from rotflex_jax.runtime.xla import double_precision

NUMBERS = json.loads((Path(__file__).parent / "paper_numbers.json").read_text())
Ts, MEMORY, REACH, N = 0.05, 6, 12, 8000
HUB, SPRING = fx.Coulomb("hub", level=0.03), fx.QuadraticSpring("joint", stiffness=1.5)
OFFSET = fx.VoltageOffset(offset=0.3)


def model(*effects: fx.Effect, substeps: int = 3, order: int = 2) -> Model:
    mechanism = paper()
    for effect in effects:
        mechanism = mechanism + effect
    return Model(mechanism, Exponential(order=order, substeps=substeps))


def alpha(m: Model, u: np.ndarray, Ts: float = Ts) -> np.ndarray:
    return simulate(m.mechanism, u, Ts, solver=m.solver)[:, 1]


def white(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=N)


class Triangle:
    """The plain Volterra basis: 1, lags, products of lags, in numpy."""

    def __init__(self, memory: int) -> None:
        self.memory, self.pairs = memory, np.triu_indices(memory)

    def regressors(self, phi: np.ndarray) -> np.ndarray:
        i, j = self.pairs
        return np.column_stack([np.ones(len(phi)), phi, phi[:, i] * phi[:, j]])

    def kernels(self, w: np.ndarray, length: int) -> dict:
        h2 = np.zeros((self.memory, self.memory))
        h2[self.pairs] = w[1 + self.memory :]
        return {0: w[0], 1: w[1 : 1 + self.memory][:length], 2: ((h2 + h2.T) / 2)[:length, :length]}


def fitted(basis, w: np.ndarray, covariance: np.ndarray | None = None) -> SimpleNamespace:
    """The result of an identification: a series, or a fit of one with the covariance of its weights."""
    units = {"input_unit": "V", "output_unit": "rad"}
    series = SimpleNamespace(basis=basis, weights=w, channel="alpha", Ts=Ts, **units)
    return series if covariance is None else SimpleNamespace(model=series, covariance=covariance)


def by_numpy(u: np.ndarray, y: np.ndarray, memory: int = MEMORY, reach: int = REACH) -> Kernels:
    """Kernels fitted by numpy, with a covariance that allows for residuals correlated over 40 samples."""
    basis = Triangle(memory)
    phi = np.lib.stride_tricks.sliding_window_view(u, memory)[reach - memory :, ::-1]
    F, y = basis.regressors(phi), y[reach - 1 :]
    w = np.linalg.lstsq(F, y, rcond=None)[0]
    e, G = y - F @ w, np.linalg.inv(F.T @ F)
    sums = np.add.reduceat(F * e[:, None], np.arange(0, len(y), 40))
    return identified_kernels(fitted(basis, w, G @ sums.T @ sums @ G), memory, u)


# -- local kernels -----------------------------------------------------------------------------------


@pytest.mark.parametrize("period", ["0.01", "0.05", "0.1"])
def test_linear_joint_has_its_impulse_response_and_nothing_else(period: str) -> None:
    kernels = local_kernels(paper(), float(period), "alpha", 12)
    np.testing.assert_allclose(kernels.h1, NUMBERS[f"impulse_alpha_{period}"], atol=1e-10)
    assert np.all(kernels.h2 == 0)
    assert kernels.h1[0] == 0


def second_order(k2: float, u: np.ndarray) -> float:
    """Second-order part of the deflection one sample after `u`, from the equation of the perturbation.

    x1' = A x1 + B u and x2' = A x2 - b k2 (p x1)^2; with z = x1 (x) x1 all are linear under a constant u.
    """
    A, B = np.array(NUMBERS["A4"]), np.array(NUMBERS["B4"])
    hub, arm = 0.0021, 0.0059
    mass = np.array([[hub + arm, arm], [arm, arm]])
    b = np.concatenate([np.zeros(2), np.linalg.inv(mass) @ [0.0, 1.0]])
    p, eye = np.array([0.0, 1.0, 0.0, 0.0]), np.eye(4)
    state = np.zeros(25)  # 1, x1, z, x2
    state[0] = 1.0
    for volt in u:
        G = np.zeros((25, 25))
        G[1:5, 0], G[1:5, 1:5] = B * volt, A
        G[5:21, 1:5] = (np.kron(B[:, None], eye) + np.kron(eye, B[:, None])) * volt
        G[5:21, 5:21] = np.kron(A, eye) + np.kron(eye, A)
        G[21:, 5:21], G[21:, 21:] = -k2 * np.outer(b, np.kron(p, p)), A
        state = scipy.linalg.expm(G * Ts) @ state
    return float(state[22])


def test_a_voltage_acts_for_five_memories_before_the_kernels() -> None:
    """The hub turns on: its angle tells for how long. The last memory is that of the kernels themselves."""
    found = local_kernels(paper(), Ts, "theta", 4, voltage=1.0)
    assert found.h0 == pytest.approx(simulate(paper(), np.ones(24), Ts)[-1, 0], rel=1e-9)


def test_quadratic_spring_has_the_kernel_of_its_second_order_perturbation() -> None:
    found = local_kernels(model(SPRING, substeps=16, order=4), Ts, "alpha", MEMORY).h2
    pulse = np.eye(MEMORY)[:, ::-1][:, :-1]  # row k: a pulse k samples before the output
    alone = [second_order(SPRING.stiffness, u) for u in pulse]
    expected = np.zeros((MEMORY, MEMORY))
    for k in range(MEMORY):
        for j in range(MEMORY):
            both = second_order(SPRING.stiffness, pulse[k] + pulse[j])
            expected[k, j] = (both - alone[k] - alone[j]) / 2
    assert np.max(np.abs(expected)) > 1e-3
    np.testing.assert_allclose(found, expected, rtol=0, atol=4e-7 * np.max(np.abs(expected)))


def test_remainder_of_the_series_is_of_third_order() -> None:
    m = model(SPRING, fx.CubicSpring("joint", stiffness=20.0), OFFSET, substeps=1)
    memory = 24  # longer than the impulse response, or the transient of the offset would count
    level = 0.5
    kernels = local_kernels(m, Ts, "alpha", memory, voltage=level, settle=4.0)
    shape = np.random.default_rng(0).normal(size=10)
    steady = np.full(80, level)

    def remainder(size: float) -> float:
        u = level + size * shape
        y = alpha(m, np.concatenate([steady, u]))[len(steady) :]
        return float(np.max(np.abs(y - kernels.response(u))))

    sizes = [remainder(size) for size in (0.2, 0.1, 0.05)]
    np.testing.assert_allclose(np.divide(sizes[:-1], sizes[1:]), 8.0, rtol=0.1)


def test_diagonal_of_the_cubic_kernel_is_what_one_pulse_shows() -> None:
    m = model(fx.CubicSpring("joint", stiffness=60.0), substeps=1)
    kernels = local_kernels(m, Ts, "alpha", 4, cubic=True)
    size = 0.02
    y = alpha(m, size * np.eye(1, 4)[0])
    expected = (y - size * kernels.h1) / size**3
    np.testing.assert_allclose(kernels.h3_diagonal, expected, rtol=2e-3, atol=1e-7)
    np.testing.assert_allclose(kernels.h2, 0.0, atol=1e-15)


def test_friction_hides_everything_at_rest_and_nothing_while_sliding() -> None:
    m = model(HUB, substeps=1)
    np.testing.assert_allclose(local_kernels(m, Ts, "alpha", MEMORY).h1, 0.0, atol=1e-14)
    sliding = local_kernels(m, Ts, "alpha", MEMORY, voltage=2.0)
    np.testing.assert_allclose(sliding.h1, local_kernels(paper(), Ts, "alpha", MEMORY).h1, atol=1e-12)


# -- slopes along a trajectory -----------------------------------------------------------------------


@pytest.mark.parametrize(
    "effects",
    [
        (HUB, fx.CubicSpring("joint", stiffness=20.0), fx.SensorCubic("alpha", cubic=6.0)),
        (fx.DeadZone(), fx.Delay(time=0.07), fx.Lag(time=0.03), fx.Dahl("hub")),
    ],
    ids=["friction", "actuator with memory"],
)
def test_slopes_are_the_derivative_of_the_whole_simulation(effects: tuple) -> None:
    m, length, reach = model(*effects, substeps=1), 50, 25
    with double_precision():
        s = m.mechanism.structure
        given = (jnp.asarray(m.mechanism.values), jnp.ones(len(m.mechanism.effects)))
        given = (*given, jnp.asarray(rest_state(s, np.float64)))
        u, period = jnp.asarray(white(1)[:length]), jnp.asarray(Ts)
        found = output_derivatives(s, m.solver, 1, reach, *given, u, period)[1]
        run = lambda u: free_run(s, m.solver, *given, u, period)[1][:, 1]  # noqa: E731
        whole = np.asarray(jax.jit(jax.jacfwd(run))(u))
    t = np.arange(reach, length)
    expected = np.array([whole[t, t - k] for k in range(reach)])
    assert np.max(np.abs(expected)) > 0.01
    np.testing.assert_allclose(np.asarray(found)[:, reach:], expected, atol=1e-14)


# -- average kernels ---------------------------------------------------------------------------------


def coloured(seed: int, a: float = 0.6) -> np.ndarray:
    w = np.random.default_rng(seed).normal(size=N + 200)
    return lfilter([np.sqrt(1 - a**2)], [1, -a], w)[200:]


@pytest.mark.parametrize("draw", [white, coloured])
def test_dead_zone_scales_the_linear_kernel_and_squares_on_the_diagonal(draw) -> None:
    """The best linear factor of f(u) is E f', and the best quadratic one is E f''/2.

    This holds for a Gaussian u of any spectrum (theorems of Bussgang and Price).
    """
    up, down = 0.6, 0.2
    zone = fx.DeadZone(positive=up, negative=down)
    memory = 20  # one second, after which the impulse response of the deflection has decayed
    kernels = average_kernels(model(zone, substeps=1), draw(2), "alpha", memory, Ts=Ts)
    linear = local_kernels(paper(), Ts, "alpha", memory).h1
    open_share = norm.sf(up) + norm.sf(down)
    curvature = (norm.pdf(up) - norm.pdf(down)) / 2
    for found, expected, std in (
        (kernels.h1, open_share * linear, kernels.errors[0]),
        (kernels.h2, np.diag(curvature * linear), kernels.errors[1]),
    ):
        # A lower limit for standard errors that are almost zero.
        z = np.abs(found - expected) / np.maximum(std, 2e-5)
        assert np.max(z) < 4.0
    assert abs(kernels.h2[1, 1]) > 5 * kernels.errors[1][1, 1]


CASES = {
    "dead zone": (fx.DeadZone(positive=0.4, negative=0.4),),
    "friction": (HUB,),
    "friction and offset": (HUB, OFFSET),
    "quadratic spring": (SPRING,),
}


@pytest.mark.parametrize("case", CASES)
def test_least_squares_finds_the_average_kernels(case: str) -> None:
    m, u = model(*CASES[case]), white(3)
    kernels = average_kernels(m, u, "alpha", MEMORY, Ts=Ts)
    other = by_numpy(u, alpha(m, u))
    agreement = kernels.against(other)
    assert abs(kernels.h0 - other.h0) < 4 * np.hypot(kernels.h0_std, other.h0_std)
    if case == "quadratic spring":  # the mean of the output is the constant and that of the squares
        assert abs(np.mean(alpha(m, u)) - other.h0) > 10 * np.hypot(kernels.h0_std, other.h0_std)
    assert agreement.rms[0] < 2.5  # a dead zone scales all lags alike: one random error, not six
    assert 0.6 < agreement.rms[1] < 1.5
    quadratic = kernels.against(average_kernels(paper(), u, "alpha", MEMORY, Ts=Ts)).rms[1]
    if case in ("dead zone", "friction"):
        assert quadratic < 1.6
    else:
        assert quadratic > 6


def test_a_fit_of_the_package_gives_the_same_kernels_as_numpy() -> None:
    m, u = model(HUB, OFFSET), white(3)
    y = alpha(m, u)
    recording = Recording(u=u, y=y, Ts=Ts, channels="alpha")
    fit = least_squares(Volterra(Delays(MEMORY)), recording, "alpha", skip=REACH - 1)
    found, expected = identified_kernels(fit, MEMORY, recording), by_numpy(u, y)
    np.testing.assert_allclose(found.h1, expected.h1, atol=1e-10)
    np.testing.assert_allclose(found.h2, expected.h2, atol=1e-10)
    np.testing.assert_allclose(found.errors[0], expected.errors[0], rtol=0.4)
    assert average_kernels(m, recording_of(u, m), "alpha", MEMORY).against(found).rms[1] < 1.5
    assert identified_kernels(fit.model, MEMORY).h1_std is None


def recording_of(u: np.ndarray, m: Model) -> Recording:
    return Recording(u=u, y=simulate(m.mechanism, u, Ts, solver=m.solver), Ts=Ts)


def test_least_squares_finds_them_under_a_coloured_input_and_a_short_memory() -> None:
    m, u, memory, reach = model(HUB, OFFSET), coloured(4), 4, 24
    kernels = average_kernels(m, u, "alpha", memory, Ts=Ts, reach=reach)
    agreement = kernels.against(by_numpy(u, alpha(m, u), memory, reach))
    assert agreement.rms[0] < 1.5
    assert agreement.rms[1] < 1.5
    # The input correlates later lags with these, so leaving later lags out changes the kernel.
    without = average_kernels(m, u, "alpha", memory, Ts=Ts, reach=memory)
    assert np.max(np.abs(without.h1 - kernels.h1)) > 10 * np.max(kernels.errors[0])


def test_kernels_are_about_the_mean_of_the_input() -> None:
    u = 2.0 + white(16)[:4000]
    found = average_kernels(paper(), u, "alpha", MEMORY, Ts=Ts)
    assert found.about == pytest.approx(np.mean(u))
    assert found.covariance is not None and found.covariance[0, 0] == pytest.approx(1.0, abs=0.1)
    assert average_kernels(paper(), u, "alpha", MEMORY, Ts=Ts, mirrored=True).about == 0.0


def test_an_input_that_is_not_gaussian_is_told_with_its_kurtosis() -> None:
    """Uniform numbers have the excess kurtosis -1.2."""
    rng = np.random.default_rng(15)
    even = average_kernels(paper(), rng.uniform(-1, 1, 4000), "alpha", MEMORY, Ts=Ts)
    assert "far from Gaussian" in even.note and "excess kurtosis -1.2" in even.input
    assert average_kernels(paper(), rng.normal(size=4000), "alpha", MEMORY, Ts=Ts).note == ""


def test_friction_damps_the_linear_kernel() -> None:
    u = white(5)
    kernels = average_kernels(model(HUB), u, "alpha", MEMORY, Ts=Ts)
    linear = average_kernels(paper(), u, "alpha", MEMORY, Ts=Ts)
    assert kernels.sizes[0] < 0.96 * linear.sizes[0]
    assert kernels.against(linear).rms[0] > 10


def test_under_a_small_input_average_and_local_kernels_are_one() -> None:
    m, u = model(SPRING), 0.05 * white(6)
    variance = 0.05**2 * np.eye(1, REACH)[0]
    kernels = average_kernels(m, u, "alpha", MEMORY, Ts=Ts, autocovariance=variance)
    local = local_kernels(m, Ts, "alpha", MEMORY)
    np.testing.assert_allclose(kernels.h1, local.h1, atol=2e-4 * np.max(np.abs(local.h1)))
    assert kernels.against(local).rms[1] < 1.6
    np.testing.assert_allclose(kernels.h2, local.h2, atol=0.05 * np.max(np.abs(local.h2)))


def test_a_known_autocovariance_replaces_the_samples() -> None:
    r = np.eye(1, REACH)[0]
    kernels = average_kernels(paper(), white(7), "alpha", MEMORY, Ts=Ts, autocovariance=r)
    np.testing.assert_allclose(kernels.h1, local_kernels(paper(), Ts, "alpha", MEMORY).h1, atol=1e-12)


def test_a_speed_has_its_unit() -> None:
    joint = dataclasses.replace(paper(), outputs={"rate": ("hub", "speed")})
    assert average_kernels(joint, white(7)[:1000], "rate", 4, Ts=Ts).units(1) == "rad/s/V"
    assert local_kernels(joint, Ts, "rate", 4).units(2) == "rad/s/V²"


def test_a_recording_gives_voltage_and_start() -> None:
    m, u = model(HUB), white(8)
    found = average_kernels(m, recording_of(u, m), "alpha", MEMORY)
    expected = average_kernels(m, u, "alpha", MEMORY, Ts=Ts)
    np.testing.assert_allclose(found.h1, expected.h1, atol=1e-5)
    assert found.output_unit == "rad"


def test_constants_of_a_recording_are_those_of_the_model() -> None:
    m, u = model(), white(8)[:2000]
    recording = recording_of(u, m)
    stiff = dataclasses.replace(recording, constants={"joint.spring.stiffness": 5.0})
    expected = average_kernels(m.with_values({"joint.spring.stiffness": 5.0}), recording, "alpha", MEMORY)
    np.testing.assert_array_equal(average_kernels(m, stiff, "alpha", MEMORY).h1, expected.h1)
    whole = effect_kernels(m, stiff, "alpha", MEMORY).whole
    np.testing.assert_array_equal(whole.h1, expected.h1)


def test_recording_in_degrees_or_of_another_period_is_refused() -> None:
    m, u = model(), white(8)[:2000]
    recording = recording_of(u, m)
    turned = dataclasses.replace(recording, y=np.rad2deg(recording.y), units=("deg", "deg"))
    refused(
        "in deg, but the output theta of the model is in rad", lambda: average_kernels(m, turned, "alpha", 4)
    )
    refused(
        "sampling period of 0.05 s; leave Ts out", lambda: average_kernels(m, recording, "alpha", 4, Ts=0.1)
    )


def test_mirrored_motion_begins_on_the_other_side() -> None:
    """A joint with dry friction that a recording catches in motion is as odd as one at rest."""
    m, u = model(HUB), white(8)[:2000]
    y = simulate(m.mechanism, u, Ts, x0=[0.0, 0.05, 3.0, -1.0], solver=m.solver)
    found = average_kernels(m, Recording(u=u, y=y, Ts=Ts), "alpha", MEMORY, mirrored=True)
    assert np.max(np.abs(found.h1)) > 0.01
    assert np.max(np.abs(found.h2)) < 1e-15


# -- effects -----------------------------------------------------------------------------------------


def test_what_odd_effects_do_to_an_odd_joint() -> None:
    effects = (HUB, fx.DeadZone(positive=0.2, negative=0.2), fx.Coulomb("joint", level=0.0))
    table = effect_kernels(model(*effects), white(9)[:4000], "alpha", MEMORY, Ts=Ts, mirrored=True)
    assert [s.name for s in table.shares] == ["coulomb at hub", "dead_zone at input"]
    assert np.max(np.abs(table.whole.h2)) < 1e-15
    for share in table.shares:
        assert "h2 by exactly nothing" in str(share)
        assert 0.03 < share.linear < 0.3
        assert share.z[0] > 10


def test_offset_makes_friction_even() -> None:
    before = len(output_derivatives)
    table = effect_kernels(model(HUB, OFFSET), white(10), "alpha", MEMORY, Ts=Ts)
    # One compilation for the kernels with and without each effect (none if an earlier test compiled it).
    assert len(output_derivatives) - before <= 1
    friction, offset = table.shares
    without = average_kernels(model(HUB), white(10), "alpha", MEMORY, Ts=Ts)
    np.testing.assert_allclose(offset.change.h2, table.whole.h2 - without.h2, atol=1e-12)
    size = np.sqrt(2 * np.sum((table.whole.h2 - without.h2) ** 2)) / np.linalg.norm(table.whole.h1)
    assert offset.quadratic == pytest.approx(size, rel=0.1)
    assert friction.quadratic > 0.01
    assert offset.quadratic > 0.01
    assert "%" in str(offset)
    # Without friction an offset of the voltage has no effect on the deflection.
    alone = effect_kernels(model(OFFSET), white(10), "alpha", MEMORY, Ts=Ts).shares[0]
    assert alone.linear == alone.quadratic == 0.0
    assert json.loads(json.dumps(table.to_dict()))["effects"][1]["effect"] == "voltage_offset"


def test_a_linear_effect_changes_the_linear_kernel_by_an_exact_amount() -> None:
    table = effect_kernels(model(fx.Lag(time=0.02), substeps=1), white(19)[:2000], "alpha", MEMORY, Ts=Ts)
    share = table.shares[0]
    assert np.isinf(share.z[0])
    assert "(exact), h2 by exactly nothing" in str(share)
    assert table.to_dict()["effects"][0]["standard_errors"] == [None, 0.0]


def test_the_scatter_of_blocks_is_taken_out_of_a_size() -> None:
    """Four blocks of 50 entries, each with noise of variance 1, about kernels of size 10."""
    rng = np.random.default_rng(14)
    blocks = np.sqrt(2.0) + rng.standard_normal((400, 4, 50))
    squares = [_size_without_noise(each, np.linalg.norm) ** 2 for each in blocks]
    assert np.mean(squares) == pytest.approx(100.0, abs=3 * np.std(squares) / 20)


def test_gates_of_a_model_count() -> None:
    off = Model((paper() + HUB), gates=(1.0,) * len(paper().effects) + (0.0,))
    kernels = average_kernels(off, white(11)[:2000], "alpha", MEMORY, Ts=Ts)
    expected = average_kernels(paper(), white(11)[:2000], "alpha", MEMORY, Ts=Ts)
    np.testing.assert_allclose(kernels.h1, expected.h1, atol=1e-14)
    assert effect_kernels(off, white(11)[:2000], "alpha", MEMORY, Ts=Ts).shares == ()


# -- the result --------------------------------------------------------------------------------------


def some() -> Kernels:
    rng = np.random.default_rng(12)
    h2 = rng.normal(size=(4, 4))
    return Kernels("alpha", Ts, 0.3, rng.normal(size=4), h2 + h2.T, h2_std=np.ones((4, 4)))


def test_series_is_the_same_about_any_level() -> None:
    kernels, u = some(), np.random.default_rng(13).normal(size=50)
    moved = kernels.moved(0.7)
    # From sample 3 on, where both use the same past samples.
    np.testing.assert_allclose(moved.response(u)[3:], kernels.response(u)[3:], atol=1e-12)
    np.testing.assert_allclose(moved.moved(0.0).h1, kernels.h1, atol=1e-12)
    by_hand = [
        kernels.h0 + kernels.h1 @ past + past @ kernels.h2 @ past
        for past in (u[t : t - 4 : -1] if t > 3 else u[3::-1] for t in range(3, 50))
    ]
    np.testing.assert_allclose(kernels.response(u)[3:], by_hand, atol=1e-12)


def test_standard_error_of_the_constant_about_another_level() -> None:
    """Independent errors of all entries, drawn and moved one by one."""
    rng, M, runs = np.random.default_rng(2), 3, 20000
    first, second = np.array([0.1, 0.2, 0.3]), np.array([[0.3, 0.1, 0.2], [0.1, 0.2, 0.1], [0.2, 0.1, 0.1]])
    kernels = Kernels(
        "alpha", Ts, 0.0, np.zeros(M), np.zeros((M, M)), h0_std=0.1, h1_std=first, h2_std=second
    )
    drawn = np.triu(rng.normal(size=(runs, M, M)) * second)
    drawn = drawn + np.swapaxes(np.triu(drawn, 1), 1, 2)
    h1, h0 = rng.normal(size=(runs, M)) * first, 0.1 * rng.normal(size=runs)
    levels = [
        dataclasses.replace(kernels, h0=c, h1=a, h2=b).moved(0.8).h0
        for c, a, b in zip(h0, h1, drawn, strict=True)
    ]
    assert kernels.moved(0.8).h0_std == pytest.approx(np.std(levels), rel=0.03)


def test_input_of_a_fit_in_other_forms() -> None:
    u = white(3)[:500]
    recording = recording_of(u, model())
    fit = least_squares(Volterra(Delays(4)), recording, "alpha")
    expected = identified_kernels(fit, 4, u).covariance
    for data in (u.tolist(), jnp.asarray(u), recording, [recording], (u,)):
        np.testing.assert_allclose(identified_kernels(fit, 4, data).covariance, expected, rtol=1e-6)
    refused("`data` must be real numbers of shape", lambda: identified_kernels(fit, 4, ["run.csv"]))
    refused("input of 3 samples was given for kernels of 4 lags", lambda: identified_kernels(fit, 4, u[:3]))
    refused("sampling period", lambda: identified_kernels(fit, 4, recording.decimate(2)))


@pytest.mark.parametrize("a", [0.0, 0.8])
def test_sizes_are_standard_deviations_under_a_gaussian_input(a: float) -> None:
    """White noise, and a first-order process of unit variance, whose covariance is `a^|k - j|`."""
    kernels = dataclasses.replace(some(), covariance=scipy.linalg.toeplitz(a ** np.arange(4)) if a else None)
    white = np.random.default_rng(14).normal(size=400_000)
    y = kernels.response(lfilter([np.sqrt(1 - a**2)], [1, -a], white))
    assert np.std(y) == pytest.approx(np.hypot(*kernels.sizes), rel=0.01)


def test_each_entry_of_a_symmetric_kernel_counts_once_in_an_agreement() -> None:
    """Differences of 2, 1 and 0 standard errors, two of them on the diagonal."""
    one = Kernels("alpha", Ts, 0.0, np.zeros(2), np.zeros((2, 2)), h2_std=np.full((2, 2), 0.1))
    other = dataclasses.replace(one, h2=np.array([[0.2, 0.1], [0.1, 0.0]]), h2_std=None)
    assert one.against(other).rms[1] == pytest.approx(np.sqrt((4 + 1 + 0) / 3))


def test_kernels_about_two_levels_agree_if_one_is_the_other_one_moved() -> None:
    kernels = some()
    assert kernels.against(kernels.moved(0.7)).relative == pytest.approx((0.0, 0.0), abs=1e-12)


def test_standard_errors_pass_from_weights_to_kernels() -> None:
    basis, rng = Triangle(3), np.random.default_rng(15)
    root = rng.normal(size=(10, 10))
    kernels = identified_kernels(fitted(basis, np.arange(10.0), root @ root.T), 3)
    variance = np.sum(root**2, axis=1)
    np.testing.assert_allclose(kernels.h1_std, np.sqrt(variance[1:4]))
    assert kernels.h2_std is not None
    assert kernels.h2_std[0, 1] == pytest.approx(np.sqrt(variance[5]) / 2)
    assert kernels.h2[0, 0] == 4.0


def test_weights_of_a_basis_with_the_plants_poles_are_its_impulse_response() -> None:
    poles = [pole for pole in np.linalg.eigvals(np.array(NUMBERS["A4"])) if pole.real < -1]
    basis = Volterra(Orthonormal.at(poles, Ts))
    h = np.concatenate([NUMBERS["impulse_alpha_0.05"], np.zeros(8)])
    impulse = np.eye(1, 12)[0]
    w = np.zeros(basis.size)
    w[1:4] = np.linalg.lstsq(basis.regressors(impulse)[:, 1:4], h[:12], rcond=None)[0]
    kernels = identified_kernels(fitted(basis, w), 12)
    np.testing.assert_allclose(kernels.h1, local_kernels(paper(), Ts, "alpha", 12).h1, atol=1e-10)


def test_a_cubic_degree_is_counted_by_its_best_line() -> None:
    """Least squares with and without cubic terms gives the same linear kernel of an odd plant with memory."""
    m, u = model(HUB, fx.DeadZone(positive=0.4, negative=0.4)), coloured(20)
    y, found = alpha(m, u), []
    for degrees in ((1,), (1, 3)):
        basis = Volterra(Delays(5), degrees=degrees)
        w = np.linalg.lstsq(basis.regressors(u)[20:], y[20:], rcond=None)[0]
        found.append(identified_kernels(fitted(basis, w), 5, u).h1)
    assert np.max(np.abs(w[1:6] - found[0])) > 0.003
    np.testing.assert_allclose(found[1], found[0], atol=5e-4)


def test_text_and_dictionary_carry_units() -> None:
    kernels = average_kernels(paper(), white(16)[:1000], "alpha", MEMORY, Ts=Ts)
    assert "rad/V²" in str(kernels)
    plain = json.loads(json.dumps(kernels.to_dict()))
    assert plain["units"] == ["rad", "rad/V", "rad/V²"]
    assert plain["lags"][-1] == pytest.approx(0.25)
    assert "standard errors" in str(kernels.against(kernels))


def test_figures_show_model_and_data_with_units() -> None:
    u = white(17)[:2000]
    kernels = average_kernels(model(HUB), u, "alpha", MEMORY, Ts=Ts)
    labels = lambda f: {a.get_ylabel() for a in f.axes} | {a.get_xlabel() for a in f.axes}  # noqa: E731
    assert {"h1 [deg/V]", "h2 [deg/V²]", "lag [s]", "second lag [s]"} <= labels(kernel_figure(kernels))
    figure = kernel_figure(kernels, by_numpy(u, alpha(model(HUB), u)))
    assert {"h1 [deg/V]", "h2 [deg/V²]", "standard errors"} <= labels(figure)
    assert len(figure.axes) == 7


def refused(phrase: str, call) -> None:
    with pytest.raises(InputError, match=phrase):
        call()


def test_bad_input_is_refused_in_one_sentence() -> None:
    u, joint = white(18), paper()
    refused("has the outputs theta, alpha", lambda: local_kernels(joint, Ts, "tip", 4))
    refused("`memory` must be a whole number from 1", lambda: local_kernels(joint, Ts, "alpha", 0))
    refused("`Ts` must be a finite number above 0", lambda: local_kernels(joint, -1.0, "alpha", 4))
    refused("`Ts` must be .* is None; .* or a recording", lambda: average_kernels(joint, u, "alpha", 4))
    refused("longer recording", lambda: average_kernels(joint, u[:50], "alpha", 4, Ts=Ts))
    refused("distinguishes the lags", lambda: average_kernels(joint, np.ones(500), "alpha", 4, Ts=Ts))
    refused("8 numbers", lambda: average_kernels(joint, u, "alpha", 4, Ts=Ts, autocovariance=np.ones(3)))
    wild: Mechanism = joint + fx.QuadraticSpring("joint", stiffness=30.0)
    refused("does not stay finite", lambda: average_kernels(wild, u, "alpha", 4, Ts=Ts))
    refused("same channel", lambda: some().against(local_kernels(joint, Ts, "theta", 4)))
    turned = dataclasses.replace(some(), output_unit="deg")
    refused("in rad/V were compared with kernels in deg/V", lambda: some().against(turned))

    for order, words in ((3, "degree 3 was given without data"), (4, "degree 4 was given, but")):
        basis = Volterra(Delays(2), order)
        refused(words, lambda b=basis: identified_kernels(fitted(b, np.ones(b.size)), 2))
