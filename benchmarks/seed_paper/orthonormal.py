"""2.3: orthonormal functions instead of delays."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from rotflex_jax.basis import Orthonormal, Volterra, best_laguerre, minimum_nmse, optimise_poles
from rotflex_jax.fit import least_squares
from rotflex_jax.mechanism import linearise
from rotflex_jax.recording import Recording
from rotflex_jax.reproduce.plants import plant
from seed_paper.blocks import Block, mean_and_spread
from seed_paper.records import impulse_response, nmse, record

TITLE = "Orthonormal functions"
SECONDS = 6.0
"""Length of impulse responses, enough for functions with a slow pole to decay."""
INTERVALS = {"1 ms": 0.001, "10 ms": 0.01, "20 ms": 0.02, "50 ms": 0.05}
FREE_FREE = complex(-1.6, 32.2)
"""A pole of the joint without back-EMF [1/s]. It has the 0.2 s of the paper, but is no pole of the joint."""


def blocks(quick: bool, say: Callable[[str], None]) -> Iterator[Block]:
    """The parts of the table."""
    poles = plant_poles()
    responses = {name: impulse_response(Ts, SECONDS) for name, Ts in INTERVALS.items()}
    rows = {
        "the plant's poles, 3 functions": [
            minimum_nmse(Orthonormal.at(poles, Ts), responses[n]) for n, Ts in INTERVALS.items()
        ]
    }
    for count in (2, 4, 6):
        rows[f"Kautz at the resonance, {count}"] = [
            minimum_nmse(Orthonormal.kautz(np.exp(poles[1] * Ts), count), responses[n])
            for n, Ts in INTERVALS.items()
        ]
    rows["Kautz at the free-free pole, 6"] = [
        minimum_nmse(Orthonormal.kautz(np.exp(FREE_FREE * Ts), 6), responses[n])
        for n, Ts in INTERVALS.items()
    ]
    best = {}
    for count in (4, 6, 8, 10):
        say(f"best pole of {count} Laguerre functions")
        found = [best_laguerre(h, count) for h in responses.values()]
        rows[f"Laguerre, best pole, {count}"] = [share for _, share in found]
        best[f"{count} functions"] = tuple(
            bank.continuous_poles(Ts)[0].real for (bank, _), Ts in zip(found, INTERVALS.values(), strict=True)
        )
    yield Block(
        "NMSE of the impulse response",
        "What the projection on the functions leaves, linear joint, white input; the functions are driven "
        "by u[t-1].",
        tuple(INTERVALS),
        {name: tuple(row) for name, row in rows.items()},
        relative=0.05,
        absolute=5.1e-5,
        notes={"10 ms": "the reference has one number for 1 to 10 ms, that of 1 ms."},
    )
    yield Block("Best Laguerre pole [1/s]", "Where the shares above are least.", tuple(INTERVALS), best)
    yield Block(
        "Coefficients of the deflection on the plant's poles",
        "Projection of the impulse response [rad/V], real pole first.",
        ("real", "pair 1", "pair 2"),
        {n: tuple(map(float, coefficients(poles, INTERVALS[n], responses[n]))) for n in ("10 ms", "20 ms")},
        absolute=1e-6,
    )
    say("best poles under friction")
    yield from under_friction(quick, poles)


def plant_poles() -> tuple[complex, ...]:
    """Poles of the linear joint except the integrator [1/s]: the real one, then the pair, upper one first."""
    eigenvalues = np.linalg.eigvals(linearise(plant("S0")).A)
    chosen = [complex(p) for p in eigenvalues if abs(p) > 1e-6]
    return tuple(sorted(chosen, key=lambda p: (abs(p.imag) > 1e-9, -p.imag)))


def coefficients(poles: tuple[complex, ...], Ts: float, h: np.ndarray) -> np.ndarray:
    """Coefficients of an impulse response on the functions with these poles."""
    return Orthonormal.at(poles, Ts).impulse_responses(len(h)).T @ h


def under_friction(quick: bool, poles: tuple[complex, ...]) -> Iterator[Block]:
    """Poles fitted to recordings with friction, and held-out errors with fixed and with fitted poles."""
    Ts, N, records = 0.02, *((3000, 2) if quick else (15000, 6))
    rows, spread, errors = {}, {}, []
    for scenario in ("S1", "S2"):
        values = []
        for seed in range(records):
            (u, y), (v, z) = (record(scenario, Ts, N, 5.0, 2 * seed + k) for k in (0, 1))
            bank, _ = optimise_poles(u, y, Orthonormal.at(poles, Ts).poles)
            real, pair = sorted(bank.continuous_poles(Ts), key=lambda s: s.imag)[1:]
            values.append([real.real, pair.real, pair.imag])
            if scenario == "S1":
                errors.append([test_nmse(b, (u, y), (v, z), Ts) for b in (Orthonormal.at(poles, Ts), bank)])
        rows[scenario], spread[scenario] = mean_and_spread(values)
    about = (
        f"Three poles fitted to {N} samples (5 Hz) with the weights projected out; mean of {records} records."
    )
    yield Block(
        "Best poles under friction, 20 ms [1/s]",
        about,
        ("real", "pair, real part", "pair, imaginary part"),
        rows,
        spread,
        relative=0.02,
    )
    names = ("the linear plant's poles", "optimised poles")
    (fixed, moved), (fixed_spread, moved_spread) = mean_and_spread(errors)
    yield Block(
        "NMSE at S1, 20 ms",
        "Held out, degree 1 with constant.",
        ("value",),
        dict(zip(names, ((fixed,), (moved,)), strict=True)),
        dict(zip(names, ((fixed_spread,), (moved_spread,)), strict=True)),
        relative=0.05,
    )


def test_nmse(bank: Orthonormal, train: tuple, test: tuple, Ts: float) -> float:
    """NMSE of a linear fit on a second recording."""
    recordings = [Recording(u=u, y=y, Ts=Ts, channels="alpha") for u, y in (train, test)]
    fit = least_squares(Volterra(bank, order=1), recordings[0], "alpha")
    return nmse(test[1], fit.model.simulate(recordings[1])[:, 0])
