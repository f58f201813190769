"""Certificates of exports: the difference of a simulator from the toolkit, and what its format lacks."""

import dataclasses
import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float, Real

from rotflex_jax.checks import positive, signal
from rotflex_jax.effects.base import Effect, Memory
from rotflex_jax.mechanism import Mechanism, simulate
from rotflex_jax.mechanism.mechanism import check_input_alone
from rotflex_jax.models.model import Model
from rotflex_jax.text.files import write_file
from rotflex_jax.text.numbers import one_line

# Unit of the input -> amplitude of the standard input of certificates.
_AMPLITUDES = {"V": 2.0, "rad": 0.6, "A": 0.5}

_SECONDS = 5.0


@dataclasses.dataclass(frozen=True)
class Certificate:
    """Comparison of an export, simulated by another program, with the toolkit on the same input.

    Attributes:
        form: Format of the export, such as `MJCF`.
        simulated_by: Program that simulated the exported file; empty if none did.
        not_simulated: Why no program simulated the file; empty if one did.
        on: The input, in words.
        channels: Names of the outputs.
        units: Units of the outputs.
        largest: Largest difference per channel [unit of the channel].
        rms: Root mean square difference per channel [unit of the channel].
        spans: Range of each channel in the toolkit's run, largest less smallest [unit of the channel].
        left_out: Effects and readings that the format cannot represent, with the reason.
        approximated: Effects that the export represents in a different way.
    """

    form: str
    simulated_by: str
    not_simulated: str
    on: str
    channels: tuple[str, ...]
    units: tuple[str, ...]
    largest: tuple[float, ...] = ()
    rms: tuple[float, ...] = ()
    spans: tuple[float, ...] = ()
    left_out: tuple[str, ...] = ()
    approximated: tuple[str, ...] = ()

    def __str__(self) -> str:
        lines = [f"Certificate of the export to {self.form}"]
        if self.not_simulated:
            lines.append(f"Not simulated: {self.not_simulated}")
        else:
            lines.append(f"Simulated by {self.simulated_by} and by rotflex_jax on the same input: {self.on}")
            for row in zip(self.channels, self.units, self.largest, self.rms, self.spans, strict=True):
                channel, unit, largest, rms, span = row
                small = f" = {np.degrees(largest):.3g} deg" if unit == "rad" else ""
                lines.append(
                    f"  {channel}: largest difference {largest:.3g} {unit}{small}, rms {rms:.3g} {unit}, "
                    f"of a motion over {span:.3g} {unit}"
                )
        for title, entries in (("Left out", self.left_out), ("Said otherwise", self.approximated)):
            lines += [f"{title}:", *(f"  - {entry}" for entry in entries)] if entries else []
        if not self.left_out:
            lines.append("Left out: nothing")
        return "\n".join(map(one_line, lines))


@dataclasses.dataclass(frozen=True)
class Exported:
    """A model in the format of a simulator, with its certificate.

    Attributes:
        content: Content of the file: text, or bytes.
        certificate: Comparison of the simulator with the toolkit.
    """

    content: str | bytes
    certificate: Certificate

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Writes the file and returns its path.

        Raises:
            InputError: The file cannot be written.
        """
        return write_file(path, self.content)


@dataclasses.dataclass(frozen=True)
class Subject:
    """A model to be exported, and the input of its certificate.

    Attributes:
        model: The model without effects that are switched off.
        Ts: Sampling period [s].
        u: Input of the certificate, held over each sample.
        on: The input in words.
        left_out: Readings that the format cannot represent.
    """

    model: Model
    Ts: float
    u: Float[np.ndarray, " N"]
    on: str
    left_out: tuple[str, ...] = ()

    @classmethod
    def of(
        cls, model: Mechanism | Model, Ts: float, u: Real[np.ndarray, " N"] | Sequence[float] | None
    ) -> "Subject":
        """A subject from the arguments of an export, which are checked.

        Raises:
            InputError: An argument is no model, no sampling period or no finite signal, or a gate is neither
                0 nor 1.
        """
        model, Ts = Model.of(model), positive(Ts, "Ts", example="0.002")
        check_input_alone(model.mechanism, "an exported model")
        model = model.without_gates()
        unit = model.mechanism.units.input
        if u is None:
            size = _AMPLITUDES.get(unit, 1.0)
            return cls(
                model,
                Ts,
                standard_input(Ts, size),
                f"{_SECONDS:g} s of three sines up to {size:g} {unit}, with rests",
            )
        given = signal(u).astype(float)
        return cls(
            model,
            Ts,
            given,
            f"{len(given)} samples of the user's own, up to {np.max(np.abs(given)):.3g} {unit}",
        )

    @property
    def mechanism(self) -> Mechanism:
        """The mechanism."""
        return self.model.mechanism

    def of_motion(self) -> "Subject":
        """The subject without readings of a motor, for formats whose sensors measure motions only."""
        m = self.mechanism
        others = {c: pair for (c, pair), q in zip(m.outputs, m.quantities, strict=True) if q.of_motion}
        if len(others) == len(m.outputs):
            return self
        reads = lambda e: e.acts_on == "channel" and e.at not in others  # noqa: E731
        effects = tuple(e for e in m.effects if not (reads(e) or (isinstance(e, Memory) and e.shows)))
        left_out = tuple(f"{c}: the {what} at {port}" for c, (port, what) in m.outputs if c not in others)
        names = {e.full_name(n) for e in effects for n in e.values}
        reduced = dataclasses.replace(m, effects=effects, outputs=others, trusted=m.trusted & names)
        model = dataclasses.replace(self.model, mechanism=reduced)
        return dataclasses.replace(self, model=model, left_out=left_out)

    def certificate(
        self,
        form: str,
        simulated_by: str,
        y: Float[np.ndarray, "N C"] | None,
        left_out: Sequence[str] = (),
        approximated: Sequence[str] = (),
        why_not: str = "",
    ) -> Certificate:
        """The certificate from the outputs of another program.

        Args:
            form: Format of the export.
            simulated_by: Name of the program.
            y: Outputs of the program from rest, or None if it did not run.
            left_out: Effects that the format cannot represent.
            approximated: Effects that the export represents in a different way.
            why_not: Reason why the program did not run.
        """
        m = self.mechanism
        units = tuple(q.unit(m.units) for q in m.quantities)
        certified = Certificate(
            form,
            simulated_by,
            why_not,
            self.on,
            m.channels,
            units,
            left_out=(*self.left_out, *left_out),
            approximated=tuple(approximated),
        )
        if y is None:
            return certified
        own = simulate(m, self.u, self.Ts, solver=self.model.solver)
        apart = np.abs(y - own)
        return dataclasses.replace(
            certified,
            largest=tuple(apart.max(axis=0).tolist()),
            rms=tuple(np.sqrt(np.mean(apart**2, axis=0)).tolist()),
            spans=tuple(np.ptp(own, axis=0).tolist()),
        )


def standard_input(Ts: float, size: float) -> Float[np.ndarray, " N"]:
    """Standard input of certificates: three sines, with two constant stretches for dry friction to hold in.

    Args:
        Ts: Sampling period [s].
        size: Bound of the magnitude [unit of the input].
    """
    t = Ts * np.arange(max(round(_SECONDS / Ts), 2))
    u = (
        0.5 * np.sin(2 * np.pi * 0.4 * t)
        + 0.35 * np.sin(2 * np.pi * 1.9 * t)
        + 0.15 * np.sin(2 * np.pi * 5.3 * t)
    )
    u[(t >= 2.4) & (t < 3.2)] = 0.0
    u[(t >= 4.0) & (t < 4.4)] = 0.05
    return size * u


def label(effect: Effect) -> str:
    """Name of an effect in certificates."""
    return f"{effect.title} {effect.location} ({effect.name})"


def in_comment(text: str) -> str:
    """A text for a comment in XML, in which no two hyphens may follow each other."""
    return "\n" + text.replace("--", "- -").replace("--", "- -") + "\n"
