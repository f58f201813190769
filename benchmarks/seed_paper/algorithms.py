"""2.8: how many samples each adaptive filter needs on the joint with friction and an offset (S6)."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from rotflex_jax.adaptive import LMS, NLMS, RLS, AffineProjection, Kalman, fixed_point, run
from rotflex_jax.adaptive.filter import Weights
from rotflex_jax.basis import Delays, GramSchmidt, Orthonormal, Volterra
from seed_paper.blocks import Block
from seed_paper.learning import CUTOFF, Task, distances, first_below
from seed_paper.orthonormal import plant_poles
from seed_paper.records import record

TITLE = "Algorithms"
SETTLED = 0.1
EPS = 1e-3


def cases() -> dict[str, tuple[Volterra, float]]:
    """Volterra series and sampling interval of each case, with 21, 10 and 153 weights."""
    return {
        "A": (Volterra(Delays(5, first=0), order=2), 0.1),
        "B": (Volterra(Orthonormal.at(plant_poles(), 0.02), order=2), 0.02),
        "C": (Volterra(Delays(16, first=0), order=2), 0.02),
    }


def lms(setting):
    """LMS with a step size for each weight."""
    return LMS(mu=setting)


def nlms(setting):
    """Normalised LMS."""
    return NLMS(mu=setting[0], eps=EPS)


def apa(setting):
    """Affine projection over four samples."""
    return AffineProjection(mu=setting[0], eps=EPS, window=4)


def rls(setting):
    """Recursive least squares without forgetting."""
    return RLS(lam=1.0, delta=setting[0])


def kalman(setting):
    """Kalman filter for weights on a slow random walk."""
    return Kalman(q=setting[0], r=1.0, p0=1e6)


def step_grid(task: Task, shares: list[tuple[float, float]]) -> np.ndarray:
    """Step sizes (S, P) of pairs of shares, each divided by the power of the regressors of its degree.

    The first share is for constant and linear weights, the second for quadratic ones.
    """
    p1, p2 = task.powers()
    return np.array([np.where(task.degrees == 2, b / p2, a / p1) for a, b in shares])


SHARES = [(a, b) for a in np.geomspace(0.01, 0.5, 6) for b in np.geomspace(0.001, 0.1, 6)]
STEPS = np.array([0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0])[:, None]
GIVEN = {"A": (0.01, 1.9e-4), "B": (1.3e-3, 2.2e-5)}
"""Best step sizes of the reference, for constant and linear weights and for quadratic ones."""


def learned(task: Task, filter_of: Callable, settings: np.ndarray) -> tuple[float | None, float, float]:
    """Samples until the excess error is below the level, their scatter, and the excess error in the end.

    The excess error is a mean over runs, and in the end means over the second half of the samples. Among
    settings whose error is below the level in the end, the values are those of the fastest. If there is none,
    the number of samples is None, the scatter zero, and the error the least of all settings.
    """
    d = distances(filter_of, settings, task.phi, task.y, task.root, task.target)
    d = np.where(np.isfinite(d), d, np.inf)
    mean = d.mean(axis=0)
    n, tail = first_below(mean, SETTLED), mean[:, mean.shape[1] // 2 :].mean(axis=1)
    there = np.isfinite(n) & (tail < SETTLED)
    if not there.any():
        return None, 0.0, float(np.min(tail))
    k = int(np.argmin(np.where(there, n, np.inf)))
    single = first_below(d[:, k], SETTLED)
    return float(n[k]), float(np.std(single[np.isfinite(single)], ddof=1)), float(tail[k])


def blocks(quick: bool, say: Callable[[str], None]) -> Iterator[Block]:
    """The parts of the table."""
    limit, runs = (5_000, 2) if quick else (10_000, 8)
    first, spread, floor, ridge, ridge_spread, tasks = {}, {}, {}, {}, {}, {}
    for name, (basis, Ts) in cases().items():
        say(name)
        task = tasks[name] = Task.of("S6", basis, Ts, limit, runs)
        whitened = GramSchmidt.of(basis, record("S6", Ts, 60_000, CUTOFF, 999)[0])
        white = Task.of("S6", whitened, Ts, limit, runs)
        P = len(task.degrees)
        wander = 1e-9 * float(np.mean(np.var(task.y, axis=1)))
        given = [np.where(task.degrees == 2, b, a) for a, b in [GIVEN[name]]] if name in GIVEN else None
        for label, on, filter_of, settings in (
            ("LMS, best of 36", task, lms, step_grid(task, SHARES)),
            ("LMS, step sizes of the reference", task, lms, np.array(given or np.zeros((0, P)))),
            (
                "orthogonalised LMS, one step size",
                white,
                lms,
                np.geomspace(0.01, 0.5, 9)[:, None] / P * np.ones(P),
            ),
            ("NLMS, best", task, nlms, STEPS),
            ("affine projection 4, best", task, apa, STEPS),
            ("RLS", task, rls, np.array([[1e6]])),
            ("Kalman", task, kalman, np.array([[wander]])),
        ):
            n, scatter, tail = learned(on, filter_of, settings) if len(settings) else (np.nan, 0.0, 0.0)
            first.setdefault(label, []).append(n)
            spread.setdefault(label, []).append(scatter)
            floor.setdefault(label, []).append(tail)
        for n in (400, 1600):
            excess = [after(task, k, n) for k in range(runs)]
            ridge.setdefault(f"{n}", []).append(float(np.mean(excess)))
            ridge_spread.setdefault(f"{n}", []).append(float(np.std(excess, ddof=1)))
    columns = tuple(tasks)
    about = "S6, 2 Hz. A: five delays, 100 ms; B: three functions, 20 ms; C: 16 delays, 20 ms."
    yield Block(
        "Iterations to 10 % excess error (S6)",
        about
        + f" {runs} runs of {limit}: first time that their mean is below, for step sizes that stay below.",
        columns,
        {label: tuple(values) for label, values in first.items()},
        {label: tuple(values) for label, values in spread.items()},
        relative=0.2,
        notes={
            "LMS, best of 36": "the reference's own step sizes (next row, known for A and B) take as long "
            "here as there; this grid of step sizes holds better ones.",
            "orthogonalised LMS, one step size": "there is one number to choose, and the references are "
            "those of steps 2 to 5 times smaller than the best: 0.0023, 0.0009 and 0.0006 give 1450, 3600 "
            "and 5300.",
            "RLS": "single runs of A take 180 to 470, of B 100 to 630.",
            "Kalman": "as RLS.",
        },
    )
    yield Block(
        "Least excess error of the normalised filters",
        "Mean over the second half of the runs, best of nine step sizes.",
        columns,
        {
            "NLMS": tuple(floor["NLMS, best"]),
            "affine projection 4": tuple(floor["affine projection 4, best"]),
        },
        relative=0.35,
        notes={
            "": "the least over a run instead of the mean over its second half lies a quarter lower or more.",
        },
    )
    yield Block(
        "Excess error of ridge regression after n samples",
        f"Ridge 1e-6, mean of {runs} runs.",
        columns,
        {n: tuple(values) for n, values in ridge.items()},
        {n: tuple(values) for n, values in ridge_spread.items()},
        relative=0.2,
    )
    yield rest_of_nlms(4 * limit)
    yield Block(
        "Condition number of the regressors",
        "From 60,000 samples.",
        columns,
        {"condition": tuple(task.condition for task in tasks.values())},
        relative=0.1,
    )


def after(task: Task, k: int, n: int) -> float:
    """Excess error of ridge regression on the first n samples of run k."""
    X, y = task.phi[k, :n], task.y[k, :n]
    w = np.linalg.solve(X.T @ X + 1e-6 * np.eye(X.shape[1]), X.T @ y)
    return float(np.sum((task.root @ (w - task.target)) ** 2))


def rest_of_nlms(N: int) -> Block:
    """Fixed point of NLMS from its equation, compared with the mean weights of a long run."""
    basis, Ts = cases()["A"]
    task = Task.of("S6", basis, Ts, N, 4)
    mu = 0.002
    phi, y = task.phi.reshape(-1, task.phi.shape[2]), task.y.ravel()
    point = fixed_point(phi, y, EPS)
    course = run(NLMS(mu=mu, eps=EPS), phi, y, state=Weights(task.target), keep_every=10).path
    mean = course[len(course) // 4 :].mean(axis=0)
    square = lambda w: float(np.sum((task.root @ w) ** 2))  # noqa: E731
    return Block(
        "Where NLMS settles (A)",
        f"Mean weights over the last three quarters of {len(y)} samples with mu = {mu:g}, started from least"
        " squares.",
        ("value",),
        {
            "excess error of its fixed point": (square(point - task.target),),
            "excess error of its mean weights": (square(mean - task.target),),
            "excess error between the two": (square(mean - point),),
        },
        relative=0.05,
        absolute=0.005,
    )
