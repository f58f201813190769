"""SINDy against a known equation, pysindy called directly and scipy's integrator; SINDy without pysindy."""

import builtins
import dataclasses
from typing import Any

import numpy as np
import pytest
import scipy.integrate
import scipy.signal

import rotflex_jax as rf
from rotflex_jax.compare import SINDy
from rotflex_jax.compare.sindy import smoothed_derivatives, smoothed_input
from rotflex_jax.compare.sparse_equations import Piece, SparseEquations, Terms, motions, refined
from rotflex_jax.errors import InputError
from rotflex_jax.recording import Recording

Ts = 0.01
LIMITS: dict[str, Any] = {
    "smoothings": (("savgol", 9), ("spline", 5.0)),
    "thresholds": (0.0, 0.03),
    "orders": (2,),
}


def pendulum(seed: int = 0, seconds: float = 12.0, noise: float = 0.0) -> Recording:
    """A recording of q'' = -9 q - 0.4 q' - 2 q^3 + 3 u with a held input, integrated by scipy."""
    rng = np.random.default_rng(seed)
    N = round(seconds / Ts)
    u = np.repeat(rng.normal(size=N // 20), 20)
    x, states = np.zeros(2), []
    for level in u:
        states.append(x)
        law = lambda t, x, level=level: [x[1], -9 * x[0] - 0.4 * x[1] - 2 * x[0] ** 3 + 3 * level]  # noqa: E731
        x = scipy.integrate.solve_ivp(law, (0.0, Ts), x, rtol=1e-9, atol=1e-11).y[:, -1]
    y = np.array(states)[:, 0]
    return Recording(u=u, y=y + noise * rng.normal(size=N), Ts=Ts, channels="q", n_init=40)


@pytest.mark.parametrize("variant", ["plain", "ensemble", "weak", "free runs"])
def test_the_law_behind_the_data_is_found(variant: Any) -> None:
    pytest.importorskip("pysindy")
    train, test = pendulum(0, noise=1e-5), pendulum(1)
    kind = {"variant": "weak", "free_runs": True} if variant == "free runs" else {"variant": variant}
    fitted = SINDy(**kind, degrees=(3,), bags=5, **LIMITS).fit(None, [train], lambda _: None)  # type: ignore[arg-type]
    law: Any = fitted.simulator
    found = dict(zip(law.terms.names, law.W[:, 0], strict=True))
    assert found["u"] == pytest.approx(3.0, rel=0.05)
    assert found["q"] == pytest.approx(-9.0, rel=0.05)
    assert found["q^3"] == pytest.approx(-2.0, rel=0.25)
    part = test.slice(300, 800)
    e = (law.simulate(part) - part.y)[part.n_init :]
    assert np.sqrt(np.mean(e**2)) < 0.1 * part.y.std()
    assert fitted.parameters == np.count_nonzero(law.W)
    assert "choices" in fitted.note


def test_the_weights_are_those_of_pysindy_called_directly() -> None:
    ps = pytest.importorskip("pysindy")
    train = pendulum(0)
    method = SINDy(smoothings=(("savgol", 9),), thresholds=(0.03,), orders=(2,), degrees=(3,))
    fitted = method.fit(None, [train], lambda _: None)  # type: ignore[arg-type]
    law: Any = fitted.simulator
    y = train.y[:, 0]
    v, a = (scipy.signal.savgol_filter(y, 9, 3, deriv=d, delta=Ts) for d in (1, 2))
    q = scipy.signal.savgol_filter(y, 9, 3)
    s = 0.03 * np.sqrt(np.mean(v**2))
    u = smoothed_input(train, ("savgol", 9), 2)
    library = np.column_stack([u * 0 + 1, u, q, q**2, q**3, v, v * abs(v), np.tanh(v / s), v**3])[10:-10]
    size, rate = np.sqrt(np.mean(library**2, axis=0)), a[10:-10]
    out = np.sqrt(np.mean(rate**2))
    direct = (
        ps.STLSQ(threshold=0.03, alpha=1e-6, max_iter=30).fit(library / size, (rate / out)[:, None]).coef_[0]
    )
    np.testing.assert_allclose(law.W[:, 0], direct / size * out, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("kind", [("savgol", 15), ("spline", 8.0)])
def test_smoothing_gives_speed_and_acceleration(kind: tuple[str, float]) -> None:
    t = Ts * np.arange(600)
    record = Recording(u=np.cos(t), y=np.sin(3 * t), Ts=Ts, channels="q")
    q, v, a = smoothed_derivatives(record, kind).T[:, 40:-40]
    np.testing.assert_allclose(q, np.sin(3 * t)[40:-40], atol=2e-3)
    np.testing.assert_allclose(v, 3 * np.cos(3 * t)[40:-40], atol=1e-2)
    np.testing.assert_allclose(a, -9 * np.sin(3 * t)[40:-40], atol=0.2)
    with pytest.raises(InputError, match="savgol"):
        smoothed_derivatives(record, ("wavelet", 3))


@pytest.mark.parametrize("width", [9, 31])
def test_the_input_is_seen_through_the_same_smoothing(width: int) -> None:
    """For one and two integrators with a held input, smoothed derivatives equal the smoothed input.

    With `savgol` they agree to rounding, with `spline` to a tenth.
    """
    u = np.random.default_rng(3).normal(size=400)
    speed = np.concatenate([[0.0], np.cumsum(Ts * u)[:-1]])
    place = np.concatenate([[0.0], np.cumsum(Ts * speed + Ts**2 / 2 * u)[:-1]])
    inside = slice(width, -width)
    for y, order in ((speed, 1), (place, 2)):
        record = Recording(u=u, y=y, Ts=Ts, channels="q")
        rate = smoothed_derivatives(record, ("savgol", width))[:, order]
        np.testing.assert_allclose(
            rate[inside], smoothed_input(record, ("savgol", width), order)[inside], atol=1e-10
        )
        spline = smoothed_derivatives(record, ("spline", 12.0))[:, order][60:-60]
        seen = smoothed_input(record, ("spline", 12.0), order)[60:-60]
        assert np.std(spline - seen) < 0.1 * np.std(spline)


def test_numbers_refined_for_free_runs_are_those_of_the_pendulum() -> None:
    record, terms = pendulum(4), Terms(("q",), 2, 3, (1e-3,))
    true = {"u": 3.0, "q": -9.0, "q'": -0.4, "q^3": -2.0}
    W = np.zeros((len(terms.names), 1))
    for name, w in true.items():
        W[terms.names.index(name)] = 1.15 * w
    states = smoothed_derivatives(record, ("savgol", 5))
    pieces = [Piece(states[k, :2], record.u[k : k + 200], record.y[k : k + 200]) for k in (100, 400, 700)]
    found = dict(zip(terms.names, refined(terms, W, pieces, Ts)[:, 0], strict=True))
    assert {n: found[n] for n in true} == pytest.approx(true, rel=0.02)
    assert not any(found[n] for n in found if n not in true)


def test_motion_is_that_of_scipy() -> None:
    record = pendulum(2, 3.0)
    terms = Terms(("q",), 2, 3, (1e-3,))
    W = np.zeros((len(terms.names), 1))
    for name, w in {"u": 3.0, "q": -9.0, "q'": -0.4, "q^3": -2.0}.items():
        W[terms.names.index(name)] = w
    run = motions(terms, W[None], np.zeros((1, 1, 2)), record.u[None], Ts)[0, 0]
    np.testing.assert_allclose(run[:, 0], record.y[:, 0], atol=1e-6)
    part = record.slice(100, 300)
    np.testing.assert_allclose(SparseEquations(terms, W, Ts).simulate(part), part.y, atol=1e-4)
    law = SparseEquations(terms, W, Ts)
    for k in (1, 3, 10, 120):
        y = record.y.copy()
        y[k:] += 0.5
        changed = dataclasses.replace(record, y=y)
        np.testing.assert_array_equal(law.predict(record)[: k + 1], law.predict(changed)[: k + 1])
    short = record.slice(100, 109)
    np.testing.assert_allclose(law.predict(short)[4:], short.y[4:], atol=1e-3)


def test_an_input_that_runs_on_is_not_held() -> None:
    """q'' = -9 q - 0.4 q' + 3 sin 5t, with 0.5 rad of the sine per sample, against scipy's integrator.

    The error is below 1 % with a smooth input and above 10 % with a held input.
    """
    step, N = 0.1, 120
    t = step * np.arange(N)
    law = lambda s, x: [x[1], -9 * x[0] - 0.4 * x[1] + 3 * np.sin(5 * s)]  # noqa: E731
    true = scipy.integrate.solve_ivp(law, (0.0, t[-1]), [0.0, 0.0], t_eval=t, rtol=1e-9, atol=1e-11).y[0]
    errors = {}
    for held in (True, False):
        terms = Terms(("q",), 2, 1, (1e-3,), held)
        W = np.zeros((len(terms.names), 1))
        for name, w in {"u": 3.0, "q": -9.0, "q'": -0.4}.items():
            W[terms.names.index(name)] = w
        run = motions(terms, W[None], np.zeros((1, 1, 2)), np.sin(5 * t)[None], step)[0, 0, :, 0]
        errors[held] = np.std(run - true) / np.std(true)
    assert errors[False] < 0.01
    assert errors[True] > 0.1


def test_without_pysindy_the_row_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    load = builtins.__import__

    def missing(name: str, *rest: Any, **named: Any) -> Any:
        if name == "pysindy":
            raise ImportError(name)
        return load(name, *rest, **named)

    monkeypatch.setattr(builtins, "__import__", missing)
    mechanism = rf.joints.single_inertia(channel="q")
    row = rf.compare(pendulum(0, 2.0), ["sindy"], mechanism=mechanism)["sindy"]
    assert row.status == "failed"
    assert "rotflex_jax[baselines]" in row.reason
