"""The models side by side: the linearised one, identified linear ones, the paper's, and richer ones."""

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np

from rotflex_jax.basis import Delays, Orthonormal, Volterra
from rotflex_jax.basis.pole_search import optimise_poles
from rotflex_jax.fit import least_squares
from rotflex_jax.mechanism import Mechanism, linearise
from rotflex_jax.reproduce.records import Records
from rotflex_jax.reproduce.settings import Settings
from rotflex_jax.series import Series

POLE_SAMPLES = 4000
"""Of the record in which poles are looked for."""

Say = Callable[[str], None]


@dataclasses.dataclass(frozen=True)
class Judged:
    """One model and how it fares where nothing was learnt.

    Attributes:
        name: Short, for tables.
        about: What it is and how it came about.
        size: How many numbers were learnt from the data.
        held_out: Error on held-out data, relative to the variance (NMSE).
        pulses: The same on each pulse.
        y_hat: Output on every held-out record (N,).
        pulse_hat: Output on each pulse (N,).
        series: The model, where it is a series.
    """

    name: str
    about: str
    size: int
    held_out: float
    pulses: tuple[float, ...]
    y_hat: tuple[np.ndarray, ...]
    pulse_hat: tuple[np.ndarray, ...]
    series: Series | None = None


def nmse(y: Sequence[np.ndarray], y_hat: Sequence[np.ndarray]) -> float:
    """Squared error over squared deviation from the mean, over several records together.

    >>> nmse([np.array([1.0, 3.0])], [np.array([1.0, 2.0])])
    0.5
    """
    measured, modelled = np.concatenate(list(y)), np.concatenate(list(y_hat))
    return float(np.sum((measured - modelled) ** 2) / np.sum((measured - measured.mean()) ** 2))


def judged(
    records: Records,
    name: str,
    about: str,
    size: int,
    *,
    outputs: tuple[Sequence[np.ndarray], Sequence[np.ndarray]] | None = None,
    series: Series | None = None,
) -> Judged:
    """Score a model on the held-out records and the pulses."""
    if outputs is None:
        # A model that came to nothing (a filter that diverged) has no output.
        run = (lambda r: series.simulate(r)[:, 0]) if series else (lambda r: np.full(r.N, np.nan))
        outputs = [run(r) for r in records.test], [run(p.recording) for p in records.pulses]
    held, pulses = (tuple(np.asarray(y) for y in part) for part in outputs)
    seen = [r.channel(records.channel)[r.n_init :] for r in records.test]
    return Judged(
        name,
        about,
        size,
        nmse(seen, [y[r.n_init :] for y, r in zip(held, records.test, strict=True)]),
        tuple(nmse([p.recording.y[:, 0]], [y]) for p, y in zip(records.pulses, pulses, strict=True)),
        held,
        pulses,
        series,
    )


def linearised(records: Records) -> Judged:
    """The physical model with the friction left out, nothing learnt."""
    outputs = records.linearised, [p.linearised for p in records.pulses]
    return judged(
        records, "linearised joint", "physics with the listed constants, nothing learnt", 0, outputs=outputs
    )


def poles(joint: Mechanism) -> list[complex]:
    """Continuous-time poles of the deflection [1/s]: those of the joint without the free rotation."""
    found = np.linalg.eigvals(linearise(joint).A)
    return [complex(p) for p in found if abs(p) > 1e-6 * np.max(np.abs(found))]


def black_boxes(s: Settings, records: Records, say: Say) -> list[Judged]:
    """Identified models: delays and orthonormal functions, of degree 1, 2 and 3, by least squares."""
    found = []
    delays = Delays(s.memory)
    for degree, word in ((1, "linear"), (2, "quadratic"), (3, "cubic")):
        say(f"least squares: memory {s.memory}, {word}")
        basis = Volterra(delays, order=degree, constant=s.constant, layout=s.layout)
        found.append(
            _fitted(records, basis, f"M={s.memory} {word}", f"delays, degree {degree}, least squares")
        )
    start = poles(records.joint)
    say("orthonormal functions: poles")
    bank = optimised(records, Orthonormal.at(start, records.Ts))
    for degree, word in ((1, "linear"), (2, "quadratic"), (3, "cubic")):
        say(f"least squares: orthonormal functions, {word}")
        basis = Volterra(bank, order=degree, constant=s.constant)
        text = f"{bank.size} orthonormal functions with learnt poles, degree {degree}, least squares"
        found.append(_fitted(records, basis, f"GOBF-{bank.size} {word}", text, bank.size))
    return found


def optimised(records: Records, bank: Orthonormal) -> Orthonormal:
    """Poles that suit the first training record best, on the way of a linear model."""
    first = records.train[0]
    y = first.channel(records.channel)[:POLE_SAMPLES].astype(float)
    u = first.u[:POLE_SAMPLES].astype(float)
    return optimise_poles(u, y, bank.poles, skip=min(first.n_init, len(u) // 4), starts=1)[0]


def _fitted(records: Records, basis: Volterra, name: str, about: str, extra: int = 0) -> Judged:
    fit = least_squares(basis, list(records.train), records.channel)
    return judged(records, name, about, basis.size + extra, series=fit.model)
