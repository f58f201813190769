"""A model in state space, linearised about an operating point, for control design."""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Real

from rotflex_jax.checks import number, positive, vector
from rotflex_jax.errors import InputError, optional
from rotflex_jax.mechanism import Mechanism
from rotflex_jax.mechanism.assembly import Layout, equations, rest_state
from rotflex_jax.mechanism.linear import state_names, zero_order_hold
from rotflex_jax.mechanism.quantity import input_word
from rotflex_jax.mechanism.simulate import read_outputs
from rotflex_jax.mechanism.step import has_smooth_torques, memory_rates, torques
from rotflex_jax.models.model import Model
from rotflex_jax.runtime.persistent_jit import persistent_jit
from rotflex_jax.runtime.xla import double_precision


@dataclasses.dataclass(frozen=True, eq=False)
class LinearModel:
    """`x' = A x + B u`, `y = C x + D u`, all deviations from an operating point.

    Attributes:
        A: State matrix.
        B: Input matrix.
        C: Output matrix.
        D: Feedthrough matrix; zero, since the outputs depend on the states only.
        Ts: Sampling period [s]; None for continuous time.
        states: Names of the states.
        inputs: Names of the inputs: `voltage`, or `input` in another unit; then the signals of the
            recordings that act on the model.
        outputs: Names of the outputs.
        dropped: Effects that the linear model does not contain, one sentence each.
    """

    A: Float[np.ndarray, "n n"]
    B: Float[np.ndarray, "n i"]
    C: Float[np.ndarray, "C n"]
    D: Float[np.ndarray, "C i"]
    Ts: float | None
    states: tuple[str, ...]
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    dropped: tuple[str, ...]

    def discretise(self, Ts: float) -> "LinearModel":
        """The model in discrete time, exact for an input that is held between samples.

        Args:
            Ts: Sampling period [s].

        Raises:
            InputError: The model is in discrete time already, or `Ts` is not positive and finite.
        """
        if self.Ts is not None:
            raise InputError("The model is in discrete time already; discretise the continuous one.")
        Ts = positive(Ts, "Ts", example="0.002")
        A, B = zero_order_hold(self.A, self.B, Ts)
        return dataclasses.replace(self, A=A, B=B, Ts=Ts)

    def to_control(self) -> Any:
        """The model as `StateSpace` of the package python-control, with names of its signals.

        Raises:
            InputError: The package is not installed.
        """
        control = optional("control", "A state space for python-control")
        return control.ss(
            *(self.A, self.B, self.C, self.D),
            *([] if self.Ts is None else [self.Ts]),
            states=list(self.states),
            inputs=list(self.inputs),
            outputs=list(self.outputs),
        )

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON types."""
        matrices = {name: getattr(self, name).tolist() for name in "ABCD"}
        names = {name: list(getattr(self, name)) for name in ("states", "inputs", "outputs", "dropped")}
        return {"kind": "state space", **matrices, "Ts": self.Ts, **names}


def state_space(
    model: Mechanism | Model,
    Ts: float | None = None,
    positions: Sequence[float] | None = None,
    speeds: Sequence[float] | None = None,
    voltage: float = 0.0,
) -> LinearModel:
    """The model linearised about an operating point.

    Linear effects enter exactly. Nonlinear torques, memories and sensors enter with their slope at the
    operating point, where memories have their steady values if these exist. Effects without a slope are left
    out and listed in `dropped`: dry friction, actuation, the play of a gear. Not for a motion that is
    dominated by friction: simulate it instead.

    Args:
        model: Mechanism with its parameter values, or a Model.
        Ts: Sampling period [s] of a model in discrete time; None for continuous time.
        positions: Positions of the coordinates; zero if None.
        speeds: Speeds of the coordinates; zero if None.
        voltage: Voltage at the motor [V], or the input in its unit.

    Returns:
        LinearModel.

    Source: Any text on control, for instance K. J. Åström and R. M. Murray, Feedback Systems, 2nd ed.,
    2021, section 6.4.
    """
    model = Model.of(model)
    if Ts is not None:
        positive(Ts, "Ts", example="0.002")
    number(voltage, "voltage", unit="V", example="0.0")
    mechanism, layout = model.mechanism, Layout.of(model.mechanism.structure)
    point = [_point(x, layout.n, what) for x, what in ((positions, "positions"), (speeds, "speeds"))]
    x = rest_state(mechanism.structure, np.float64)
    x[: 2 * layout.n] = np.concatenate(point)
    word = input_word(mechanism.units.input)
    inputs = (word, *(mechanism.signals if mechanism.takes_signals else ()))
    u = np.array([float(voltage), *[0.0] * (len(inputs) - 1)])
    with double_precision():
        slopes = functools.partial(_slopes, mechanism.structure, *model.parameters_and_gates())
        x = _with_steady_memories(lambda x: slopes(x, u), x, layout.linear)
        _, A, B, C = map(np.asarray, slopes(x, u))
    names = state_names(mechanism)
    # The linear model neglects the play of a gear, so the rotor has no states of its own.
    rows = [i for i in range(layout.size) if not layout.rotor <= i < layout.linear]
    linear = LinearModel(
        A=A[np.ix_(rows, rows)],
        B=B[rows],
        C=C[:, rows],
        D=np.zeros((len(C), len(inputs))),
        Ts=None,
        states=tuple(names[i] for i in rows),
        inputs=inputs,
        outputs=mechanism.channels,
        dropped=tuple(_dropped(model)),
    )
    return linear if Ts is None else linear.discretise(Ts)


def _point(given: Sequence[float] | None, n: int, what: str) -> np.ndarray:
    return np.zeros(n) if given is None else vector(given, what, n, example=str([0.0] * n))


@persistent_jit(static=1)
def _slopes(
    structure: Mechanism,
    values: Real[Array, " P"],
    gates: Float[Array, " E"],
    x: Float[Array, " n"],
    u: Float[Array, " k"],
) -> tuple[Array, Array, Array, Array]:
    """Rates of the states without dry friction, their slopes by state and input, and those of the outputs."""
    mechanism, start = structure.with_values(values), Layout.of(structure).linear
    eq, smooth = equations(mechanism, gates), has_smooth_torques(mechanism)

    def rate(x: Array, u: Array) -> Array:
        L, z = x[:start], x[start:]
        dL = eq.A @ L + eq.B * u[0]
        if smooth:
            dL = dL + eq.ports @ torques(mechanism, L, z, u if mechanism.takes_signals else u[0], gates)
        return jnp.concatenate([dL, memory_rates(mechanism, L, z, u[0], gates)]) if z.shape[0] else dL

    A, B = jax.jacfwd(rate, argnums=(0, 1))(x, u)
    return rate(x, u), A, B, jax.jacfwd(lambda x: read_outputs(mechanism, gates, x))(x)


def _with_steady_memories(
    slopes: Callable[[np.ndarray], Sequence[Array]], x: Float[np.ndarray, " n"], start: int
) -> Float[np.ndarray, " n"]:
    """The state with its memories, including currents, at their steady values if these exist."""
    for k in range(start, len(x)):
        for _ in range(20):
            rates, A = map(np.asarray, slopes(x)[:2])
            rate, gain = float(rates[k]), float(A[k, k])
            if not (np.isfinite(gain) and gain < 0):
                break
            x[k] -= rate / gain
            if abs(rate / gain) <= 1e-14 * (1 + abs(x[k])):
                break
    return x


def _dropped(model: Model) -> list[str]:
    gates = model.gates or (1.0,) * len(model.mechanism.effects)
    return [
        f"{e.title} at {e.at} {e.not_linearised}"
        for e, gate in zip(model.mechanism.effects, gates, strict=True)
        if e.not_linearised and gate
    ]
