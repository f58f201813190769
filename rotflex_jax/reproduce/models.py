"""The models that are compared: linearised, identified linear, the paper's, richer ones, grey box."""

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Float

from rotflex_jax.basis import Delays, Orthonormal, Volterra
from rotflex_jax.basis.pole_search import ar1, minimum_nmse, optimise_poles
from rotflex_jax.effects import Coulomb, DeadZone, VoltageOffset
from rotflex_jax.errors import InputError
from rotflex_jax.fit import fit, least_squares
from rotflex_jax.kernels import EffectKernels, Kernels, average_kernels, effect_kernels, identified_kernels
from rotflex_jax.mechanism import Exponential, Mechanism, linearise, simulate
from rotflex_jax.models.model import Model
from rotflex_jax.models.series import Series
from rotflex_jax.reproduce.records import Records, decimate_like
from rotflex_jax.reproduce.settings import Settings


def impulse_response(joint: Mechanism, Ts: float, seconds: float = 1.2) -> Float[np.ndarray, " L"]:
    """Deflection [rad] after 1 V held over one sample, of the linear part of a joint.

    >>> from rotflex_jax.joints import paper
    >>> impulse_response(paper(), 0.1)[:3].round(6)
    array([ 0.      , -0.067914,  0.064805])
    """
    space = linearise(joint)
    A, x = space.discretise(Ts)
    row = space.C[joint.channels.index("alpha")]
    h = np.zeros(max(8, int(np.ceil(seconds / Ts))))
    for k in range(1, len(h)):
        h[k] = row @ x
        x = A @ x
    return h


def least_nmse(
    s: Settings, joint: Mechanism, intervals: Float[np.ndarray, " K"], *, white: bool = False
) -> Float[np.ndarray, " K"]:
    """Least NMSE of a linear model at several sampling intervals [s].

    Args:
        s: Settings `memory` and `cutoff`.
        joint: Plant, whose linear part is used.
        intervals: Sampling intervals [s].
        white: Whether the input is white; otherwise it is first-order noise with the cutoff frequency.
    """
    responses = [impulse_response(joint, float(Ts)) for Ts in intervals]
    length = max(map(len, responses))  # one length for all, so that the program is compiled once
    found = []
    for Ts, h in zip(intervals, responses, strict=True):
        a = 0.0 if white else float(np.exp(-2 * np.pi * s.cutoff * Ts))
        h = np.concatenate([h, np.zeros(length - len(h))])
        found.append(minimum_nmse(Delays(s.memory), h, ar1(a, length)))
    return np.array(found)


KERNEL_SAMPLES = 4000
"""Number of samples of the training recording over which kernels of the equations are averaged."""


@dataclasses.dataclass(frozen=True)
class KernelComparison:
    """Kernels of the machine and kernels from its data.

    Attributes:
        physics: Kernels from derivatives of the simulator, averaged over the input.
        data: Kernels from a least-squares fit of the quadratic model.
        effects: Contribution of each effect of the machine to the kernels; None if the machine cannot be
            simulated without one of them.
    """

    physics: Kernels
    data: Kernels
    effects: EffectKernels | None

    def __str__(self) -> str:
        agreement = str(self.physics.against(self.data))
        return agreement if self.effects is None else f"{agreement}\n\n{self.effects}"


def compare_kernels(s: Settings, records: Records) -> KernelComparison | None:
    """Kernels of a simulated machine and kernels from its data; None for measured recordings.

    Args:
        s: Settings.
        records: Recordings, of which the first one for training is used.
    """
    if records.machine is None:
        return None
    first = records.train[0]
    part = first.slice(0, min(KERNEL_SAMPLES, first.N))
    # The step is longer than in the simulation of the recording; an error of a per mille is acceptable here.
    model = Model(records.machine, Exponential(substeps=max(1, round(s.Ts / 5e-3))))
    fit = least_squares(Volterra(Delays(s.memory)), first, records.channel)
    physics = average_kernels(model, part, records.channel, s.memory)
    try:
        effects = effect_kernels(model, part, records.channel, s.memory)
    except InputError:  # unstable without one effect, such as a softening spring without the hardening part
        effects = None
    return KernelComparison(physics, identified_kernels(fit, s.memory, first), effects)


POLE_SAMPLES = 4000
"""Number of samples of the training recording that the search for poles uses."""


@dataclasses.dataclass(frozen=True)
class EvaluatedModel:
    """One model and its errors on data that it was not fitted to.

    Attributes:
        name: Short name for tables.
        about: Description of the model and of its identification.
        size: Number of parameters fitted to data.
        held_out: Error on the evaluation data, relative to the variance (NMSE).
        pulses: Error on each pulse, relative to the variance (NMSE).
        y_hat: Output of the model on every evaluation recording.
        pulse_hat: Output of the model on each pulse.
        series: The model if it is a series, else None.
    """

    name: str
    about: str
    size: int
    held_out: float
    pulses: tuple[float, ...]
    y_hat: tuple[Float[np.ndarray, " _"], ...]
    pulse_hat: tuple[Float[np.ndarray, " _"], ...]
    series: Series | None = None


Outputs = Sequence[Float[np.ndarray, " _"]]
"""One output of several recordings."""


def nmse(y: Outputs, y_hat: Outputs) -> float:
    """Squared error over squared deviation from the mean, over several recordings together.

    >>> nmse([np.array([1.0, 3.0])], [np.array([1.0, 2.0])])
    0.5
    """
    measured, modelled = np.concatenate(list(y)), np.concatenate(list(y_hat))
    return float(np.sum((measured - modelled) ** 2) / np.sum((measured - measured.mean()) ** 2))


def evaluate_model(
    records: Records,
    name: str,
    about: str,
    size: int,
    *,
    outputs: tuple[Outputs, Outputs] | None = None,
    series: Series | None = None,
) -> EvaluatedModel:
    """Evaluates a model on the evaluation recordings and the pulses."""
    if outputs is None:
        # A filter that diverged gives no model; its output is NaN.
        run = (lambda r: series.simulate(r)[:, 0]) if series else (lambda r: np.full(r.N, np.nan))
        outputs = [run(r) for r in records.test], [run(p.recording) for p in records.pulses]
    held, pulses = (tuple(np.asarray(y) for y in part) for part in outputs)
    seen = [r.channel(records.channel)[r.n_init :] for r in records.test]
    return EvaluatedModel(
        name,
        about,
        size,
        nmse(seen, [y[r.n_init :] for y, r in zip(held, records.test, strict=True)]),
        tuple(nmse([p.recording.y[:, 0]], [y]) for p, y in zip(records.pulses, pulses, strict=True)),
        held,
        pulses,
        series,
    )


def linearised(records: Records) -> EvaluatedModel:
    """The physical model without friction, not fitted."""
    outputs = records.linearised, [p.linearised for p in records.pulses]
    return evaluate_model(
        records, "linearised joint", "physics with the listed constants, nothing learnt", 0, outputs=outputs
    )


def poles(joint: Mechanism) -> list[complex]:
    """Continuous-time poles of the deflection [1/s]: all poles of the joint except the free rotation."""
    found = np.linalg.eigvals(linearise(joint).A)
    return [complex(p) for p in found if abs(p) > 1e-6 * np.max(np.abs(found))]


def black_boxes(s: Settings, records: Records, progress: Callable[[str], None]) -> list[EvaluatedModel]:
    """Identified models: delays and orthonormal functions, of degree 1, 2 and 3, by least squares."""
    found = []
    delays = Delays(s.memory)
    for degree, word in ((1, "linear"), (2, "quadratic"), (3, "cubic")):
        progress(f"least squares: memory {s.memory}, {word}")
        basis = Volterra(delays, order=degree, constant=s.constant, layout=s.layout)
        found.append(
            _fitted(records, basis, f"M={s.memory} {word}", f"delays, degree {degree}, least squares")
        )
    start = poles(records.joint)
    progress("orthonormal functions: poles")
    bank = optimised_bank(records, Orthonormal.at(start, records.Ts))
    for degree, word in ((1, "linear"), (2, "quadratic"), (3, "cubic")):
        progress(f"least squares: orthonormal functions, {word}")
        basis = Volterra(bank, order=degree, constant=s.constant)
        text = f"{bank.size} orthonormal functions with learnt poles, degree {degree}, least squares"
        found.append(_fitted(records, basis, f"GOBF-{bank.size} {word}", text, bank.size))
    return found


def optimised_bank(records: Records, bank: Orthonormal) -> Orthonormal:
    """The bank with the best poles of a linear model for the first training recording."""
    first = records.train[0]
    y = first.channel(records.channel)[:POLE_SAMPLES].astype(float)
    u = first.u[:POLE_SAMPLES].astype(float)
    return optimise_poles(u, y, bank.poles, skip=min(first.n_init, len(u) // 4), starts=1)[0]


def _fitted(records: Records, basis: Volterra, name: str, about: str, extra: int = 0) -> EvaluatedModel:
    fit = least_squares(basis, list(records.train), records.channel)
    return evaluate_model(records, name, about, basis.size + extra, series=fit.model)


FIT_SECONDS = 40.0
"""Length of the part of each training recording that the grey-box fit uses [s]; more is not needed."""
LONGEST_FIT_STEP = 5e-3
"""Longest step of the simulation in the grey-box fit [s]."""


def grey_box(records: Records, progress: Callable[[str], None]) -> EvaluatedModel | None:
    """The linear joint with dry friction at hub and joint, dead zone and offset, fitted in free runs.

    The fit starts from the listed constants and a little friction, and takes about half a minute. The dead
    zone is left out on measured recordings. The result is None if recordings lack an output of the joint.

    Args:
        records: Recordings. All outputs of the joint are fitted, one is evaluated.
        progress: Called with a line of text for every step.
    """
    train, test = records.whole
    if any(set(records.joint.channels) - set(r.channels) for r in (*train, *test)):
        return None
    start = with_friction(records.joint, dead_zone=not records.measured)
    substeps = max(1, round(train[0].Ts / LONGEST_FIT_STEP))
    part = [r.slice(0, min(r.N, round(FIT_SECONDS / r.Ts))) for r in train]
    progress("grey box: fitting, which takes a while")
    found = fit(Model(start, Exponential(substeps=substeps)), part).model
    column = records.joint.channels.index(records.channel)
    held_out = decimate_like(records.test, [found.simulate(r)[:, column] for r in test])
    pulses = [
        simulate(found.mechanism, p.recording.u, p.recording.Ts, solver=found.solver)[:, column]
        for p in records.pulses
    ]
    about = (
        "equations with friction, dead zone and offset, fitted"
        if not records.measured
        else ("equations with friction and offset, fitted")
    )
    return evaluate_model(records, "grey box", about, len(start.free_names), outputs=(held_out, pulses))


def with_friction(joint: Mechanism, *, dead_zone: bool) -> Mechanism:
    """A linear joint with a little dry friction and an offset, as the start of a fit.

    Args:
        joint: The linear joint.
        dead_zone: Whether to add a dead zone too.
    """
    for effect in (Coulomb("hub", level=0.01), Coulomb("joint", level=0.001), VoltageOffset(offset=0.0)):
        joint = joint + effect
    if not dead_zone:
        return joint
    # An offset shifts the dead zone, so one of the offset and the two ends of the dead zone is redundant.
    return (joint + DeadZone(positive=0.05, negative=0.05)).trust("input.dead_zone.negative")
