"""2.7: convergence of LMS with orthogonalised regressors."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import jax.numpy as jnp
import numpy as np
from scipy.linalg import toeplitz
from scipy.signal import lfilter

from rotflex_jax.adaptive import LMS, RLS
from rotflex_jax.adaptive.moments import Moments, ar1_covariance
from rotflex_jax.adaptive.step_sizes import mean_square_bound
from rotflex_jax.basis import Delays, GramSchmidt, Hermite, Volterra
from seed_paper.blocks import Block
from seed_paper.learning import CUTOFF, Task, distances, first_below
from seed_paper.records import record

TITLE = "Orthogonalised regressors"
MEMORY = 5
COLOURS = (0.0, 0.5, 0.8, 0.9, 0.95)
LIMIT = 150_000
DEGREES = Volterra(Delays(MEMORY, first=0), order=2).degrees


def blocks(quick: bool, say: Callable[[str], None]) -> Iterator[Block]:
    """The parts of the table."""
    yield gram(quick)
    yield speed(quick, say)
    say("strong quadratic content")
    yield quadratic(10_000 if quick else 60_000, 2 if quick else 6)


def coloured(N: int, a: float, seed: int) -> np.ndarray:
    """First-order noise of unit variance with correlation `a` between successive samples."""
    w = np.random.default_rng(seed).standard_normal(N)
    w[1:] *= np.sqrt(1 - a**2)
    return lfilter([1.0], [1.0, -a], w)


def volterra() -> Volterra:
    """The raw regressors: a constant, five delays and their 15 products."""
    return Volterra(Delays(MEMORY, first=0), order=2)


def hermite(a: float) -> Hermite:
    """The same regressors, made orthonormal for the coloured input."""
    return Hermite.of(volterra(), toeplitz(a ** np.arange(MEMORY)))


def gram(quick: bool) -> Block:
    """Sample Gram matrices of the orthonormal and of the raw regressors."""
    N = 20_000 if quick else 400_000
    u = coloured(N, 0.8, 0)
    X, raw = (basis.regressors(u)[MEMORY:] for basis in (hermite(0.8), volterra()))
    G = X.T @ X / len(X)
    eigenvalues = np.linalg.eigvalsh(G)
    return Block(
        "Gram matrix after the closed form, a = .8, 400,000 samples",
        f"Hermite polynomials of the whitened delays; {N} samples.",
        ("value",),
        {
            "largest |G - I|": (float(np.max(np.abs(G - np.eye(len(G))))),),
            "smallest eigenvalue": (float(eigenvalues[0]),),
            "largest eigenvalue": (float(eigenvalues[-1]),),
            "raw condition number": (float(np.linalg.cond(raw.T @ raw)),),
        },
        relative=0.03,
        absolute=0.005,
    )


def lms(setting):
    """LMS with one step size for constant and linear regressors, and one for quadratic ones."""
    return LMS(mu=jnp.where(jnp.asarray(DEGREES) == 2, setting[1], setting[0]))


def rls(setting):
    """Recursive least squares without forgetting."""
    return RLS(lam=1.0, delta=setting[0])


def plants(a: float, N: int, runs: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Inputs, outputs and weights of random kernels, with noise 30 dB below the output."""
    U, Y, W = [], [], []
    for seed in range(runs):
        rng = np.random.default_rng(1000 + seed)
        u, w = coloured(N, a, seed), rng.standard_normal(len(DEGREES))
        y = volterra().regressors(u) @ w
        U.append(u)
        Y.append(y + 10**-1.5 * np.std(y) * rng.standard_normal(N))
        W.append(w)
    return np.array(U), np.array(Y), np.array(W)


def speed(quick: bool, say: Callable[[str], None]) -> Block:
    """Samples until the error of the raw weights is 10 %, for LMS, orthonormalised LMS and RLS."""
    runs, limit = (3, 10_000) if quick else (9, LIMIT)
    P = len(DEGREES)
    rows = {}
    for a in COLOURS:
        say(f"a = {a:g}")
        U, Y, W = plants(a, limit, runs)
        size = np.linalg.norm(W, axis=1)[:, None]
        raw, orthonormal = volterra(), hermite(a)
        T = np.array([orthonormal.raw_weights(column) for column in np.eye(P)]).T
        exact = Moments.gaussian(ar1_covariance(a, MEMORY))
        found = []
        for basis, filter_of, settings, root, part in (
            (raw, lms, grid(a), np.eye(P), 5000),
            (orthonormal, lms, grid(0.0), T, 2000),
            (raw, rls, np.array([[1e6]]), np.eye(P), 2000),
        ):
            phi = np.array([basis.regressors(u)[MEMORY:] for u in U])
            target = np.linalg.solve(root, (W / size).T).T
            d = distances(filter_of, settings, phi, Y[:, MEMORY:] / size, root, target, below=0.01, part=part)
            found.append(np.sort(np.min(first_below(d, 0.01), axis=1)))
        spans = [f for times in found for f in (times[0], times[-1])]
        rows[f"{a:g}".lstrip("0") or "0"] = (
            exact.condition,
            *(float(np.median(times)) for times in found),
            *map(float, spans),
        )
    names = ("condition", "raw LMS", "Hermite LMS", "RLS")
    ranges = tuple(f"{name}, {end}" for name in ("raw", "Hermite", "RLS") for end in ("least", "largest"))
    return Block(
        "Iterations to 10 % parameter error, median of 3 seeds",
        "Random normal weights of five delays and their products, noise 30 dB below; best of 5 x 5 step "
        f"sizes for each of {runs} plants, at most {limit} samples; median, least and largest. The error is "
        "that of the raw weights.",
        (*names, *ranges),
        rows,
        relative=0.5,
        notes={
            "raw LMS": "the reference does not say how its kernels were drawn, and that decides: with "
            "kernels that decay by exp(-1/2) per lag, six plants at a = .8 took 5,260 to 53,850, which "
            "holds the reference (6,560, worst 62,460); with quadratic kernels of 0.3 the size 9,540 to "
            "34,660.",
            "Hermite LMS": "as for raw LMS; single plants lie a factor of two to each side (last columns), "
            "and the best of 25 step sizes is taken for each plant.",
            "RLS": "as for raw LMS; single plants range from 110 to 1380 at a = .95.",
        },
    )


def grid(a: float) -> np.ndarray:
    """Step sizes as shares of the mean-square bounds of the linear and of the quadratic part alone."""
    shares = np.array([0.05, 0.1, 0.2, 0.4, 0.8])
    covariance = ar1_covariance(a, MEMORY)
    first, second = (mean_square_bound(Moments.gaussian(covariance, (d,))) for d in (1, 2))
    return np.array([(x, y) for x in first * shares for y in second * shares])


def quadratic(N: int, runs: int) -> Block:
    """Samples to 10 % excess error for a plant with a large quadratic kernel, S5s, with eight delays."""
    Ts = 0.05
    basis = Volterra(Delays(8, first=0), order=2)
    whitened = GramSchmidt.of(basis, record("S5s", Ts, 60_000, CUTOFF, 999)[0])
    shares = np.geomspace(0.003, 0.6, 10)
    rows = {"one step size": [], "two step sizes": []}
    for chosen in (basis, whitened):
        task = Task.of("S5s", chosen, Ts, N, runs)
        p1, p2 = task.powers()
        one = shares[:, None] / (p1 + p2) * np.ones(basis.size)
        two = np.array([np.where(task.degrees == 2, b / p2, a / p1) for a in shares[2:] for b in shares[2:]])
        for row, settings in zip(rows, (one, two), strict=True):
            mean = np.mean(distances(weighted, settings, task.phi, task.y, task.root, task.target), axis=0)
            mean = np.where(np.isfinite(mean), mean, np.inf)
            rows[row].append(float(np.min(first_below(mean, 0.1))))
    return Block(
        "Iterations to 10 % excess error, strong quadratic content (S5s, 8 delays, 50 ms)",
        f"Input of {CUTOFF:g} Hz, best of 10 or 64 step sizes, first time that the mean of {runs} runs is "
        "below.",
        ("raw", "orthogonalised", "ratio"),
        {row: (*values, values[0] / values[1]) for row, values in rows.items()},
        relative=0.25,
        notes={
            "raw": "times go as one over the step size; steps of 0.0003 (raw) and 0.0004 (orthogonalised), "
            "five times below the fastest here, give 20,000 and 9,700 as in the reference, and the ratio is"
            " the same.",
            "orthogonalised": "see raw.",
            "two step sizes | ratio": "of two numbers that hang on the choice of step sizes in the "
            "reference: its two step sizes are slower than its single one for the raw regressors, although "
            "they include it.",
        },
    )


def weighted(mu):
    """LMS with a step size for each weight."""
    return LMS(mu=mu)
