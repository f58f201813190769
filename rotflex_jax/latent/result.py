"""The result of a latent-torque estimation: torques with bands, binned curves, spectra."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import scipy
from jaxtyping import Bool, Float, Int

from rotflex_jax.checks import whole
from rotflex_jax.effects.base import Linear
from rotflex_jax.errors import InputError
from rotflex_jax.latent.in_time import Drift, PeriodicTorque, drift, periodic_torques
from rotflex_jax.mechanism import Mechanism
from rotflex_jax.mechanism.assembly import effects_of
from rotflex_jax.mechanism.quantity import input_word
from rotflex_jax.models.model import Model
from rotflex_jax.parameters import HALF_WIDTH_95
from rotflex_jax.recording import Recording
from rotflex_jax.text.colours import FINAL, MUTED
from rotflex_jax.text.markup import bullets, card, picture, table
from rotflex_jax.text.numbers import plain_number
from rotflex_jax.text.svg import Panel, signals

if TYPE_CHECKING:
    from matplotlib.figure import Figure


# Least number of samples of a bin; bins with fewer are left out.
MIN_SAMPLES_PER_BIN = 8
# Least gain of a torque that is examined for behaviour in time [nat]; with less, it may be the prior alone.
ASKED_FOR = 10.0
# Weight of the variance over all bins in the variance of one bin, in stays.
PRIOR_STAYS = 3


@dataclasses.dataclass(frozen=True, eq=False)
class TorqueCurve:
    """Mean of a torque in bins of another signal.

    Attributes:
        at: Mean of the abscissa in each bin.
        mean: Mean torque in each bin [N m].
        low: Lower end of the 95 % band of this mean [N m].
        high: Upper end of the band [N m].
        spread: Standard deviation of single samples about the mean [N m].
        count: Number of samples in each bin.
        visits: Number of separate stays in each bin.
        index: Number of each bin; those of bins that are left out are missing.
        against: Name of the abscissa.
        unit: Unit of the abscissa.
        port: Port at which the torque acts.
    """

    at: Float[np.ndarray, " B"]
    mean: Float[np.ndarray, " B"]
    low: Float[np.ndarray, " B"]
    high: Float[np.ndarray, " B"]
    spread: Float[np.ndarray, " B"]
    count: Int[np.ndarray, " B"]
    visits: Int[np.ndarray, " B"]
    index: Int[np.ndarray, " B"]
    against: str
    unit: str
    port: str


def binned_mean(
    x: Float[np.ndarray, " N"],
    torque: Float[np.ndarray, " N"],
    std: Float[np.ndarray, " N"],
    bins: int,
    segment: Int[np.ndarray, " N"],
) -> dict[str, Float[np.ndarray, " B"] | Int[np.ndarray, " B"]]:
    """Mean of a torque in bins of an abscissa, as fields of a `TorqueCurve`.

    Neighbouring samples are correlated, so a stay in a bin, from entering to leaving it, counts as one
    observation. Bins are equally wide between the 1 % and 99 % quantiles; the outermost bins contain the
    rest.

    Args:
        x: Abscissa.
        torque: Torque [N m].
        std: Standard deviation of the torque [N m].
        bins: Number of bins.
        segment: Number of the recording of each sample.
    """
    low, high = np.quantile(x, (0.01, 0.99))
    edges = np.linspace(low, high if high > low else low + 1.0, bins + 1)
    which = np.clip(np.searchsorted(edges, x, side="right") - 1, 0, bins - 1)
    enters = np.r_[True, (which[1:] != which[:-1]) | (segment[1:] != segment[:-1])]
    stay = np.cumsum(enters) - 1
    length, bin_of = np.bincount(stay).astype(float), which[enters]
    count = np.bincount(bin_of, length, bins)
    visits = np.bincount(bin_of, minlength=bins)
    kept = count >= MIN_SAMPLES_PER_BIN
    each = np.maximum(count, 1.0)
    mean, own, at = (np.bincount(which, w, bins) / each for w in (torque, std**2, x))
    scatter = np.bincount(which, (torque - mean[which]) ** 2, bins) / each
    # Variance of the means of stays about the mean of their bin; with few stays, nearer to that of all bins.
    squares = length * (np.bincount(stay, torque) / length - mean[bin_of]) ** 2
    pooled = squares.sum() / max(count[visits > 1].sum(), 1.0)
    between = visits * np.bincount(bin_of, squares, bins) / each + PRIOR_STAYS * pooled
    between = between / np.maximum(visits - 1 + PRIOR_STAYS, 1)
    error = np.sqrt(between * np.bincount(bin_of, length**2, bins) / each**2 + own / np.maximum(visits, 1))
    return {
        "at": at[kept],
        "mean": mean[kept],
        "low": (mean - HALF_WIDTH_95 * error)[kept],
        "high": (mean + HALF_WIDTH_95 * error)[kept],
        "spread": np.sqrt(scatter[kept]),
        "count": count[kept].astype(int),
        "visits": visits[kept],
        "index": np.flatnonzero(kept),
    }


Abscissa = Literal["speed", "position", "deflection", "voltage", "time"]
CURVE_BINS = 40


@dataclasses.dataclass(frozen=True, eq=False)
class LatentTorque:
    """Torques that a model lacks, along all samples of its recordings.

    Attributes:
        ports: The D ports at which the torques act.
        torque: Mean of the torque at each port, given all samples [N m].
        std: Standard deviation of the torque, given all samples [N m].
        time: Time of each sample [s].
        position: Position of each port [rad].
        speed: Speed of each port [rad/s].
        voltage: Input [V].
        recording: Number of the recording of each sample.
        Ts: Sampling period of each recording [s].
        intensity: Port -> intensity of the torque, a random walk [(N m)^2/s].
        gain_nats: Port -> log-likelihood that its torque gains over no torque [nat].
        scale: Torque that the motor gives at the root mean square voltage [N m].
        linear: `port.effect` -> torque of a damper or spring of the model at these ports [N m], which
            `given_back` can add.
        motion: Unit of positions.
        input: Unit of the input.
        effort: Unit of torques.
        added: Names of the torques in `linear` that are included in `torque`.
    """

    ports: tuple[str, ...]
    torque: Float[np.ndarray, "N D"]
    std: Float[np.ndarray, "N D"]
    time: Float[np.ndarray, " N"]
    position: Float[np.ndarray, "N D"]
    speed: Float[np.ndarray, "N D"]
    voltage: Float[np.ndarray, " N"]
    recording: Int[np.ndarray, " N"]
    Ts: tuple[float, ...]
    intensity: dict[str, float]
    gain_nats: dict[str, float]
    scale: float
    linear: dict[str, Float[np.ndarray, " N"]]
    motion: str = "rad"
    input: str = "V"
    effort: str = "N m"
    added: tuple[str, ...] = ()

    def given_back(self, *names: str, beyond: "LatentTorque | None" = None) -> "LatentTorque":
        """The torque plus the torques of some of the model's own dampers and springs.

        A fitted damper compensates for a part of the missing effect, in addition to the true damping. Only
        the sum of the damper's torque and the latent torque is determined.

        Args:
            names: `port.effect`, for instance "hub.viscous"; all dampers if none is named.
            beyond: Latent torques of the same recordings with a better model. Then only the difference
                between the torques of these effects in the two models is added.
        """
        chosen = names or tuple(n for n in self.linear if n.endswith(".viscous"))
        torque = self.torque.copy()
        for name in chosen:
            if name not in self.linear:
                raise InputError(
                    f"{name!r} was to be given back, but the model has {', '.join(self.linear) or 'none'} "
                    "at the ports of the torques; name one of these."
                )
            if name in self.added:
                continue
            known = 0.0 if beyond is None else beyond.linear.get(name, 0.0)
            torque[:, self._index(name.partition(".")[0])] += self.linear[name] - known
        added = tuple(dict.fromkeys((*self.added, *chosen)))
        return dataclasses.replace(self, torque=torque, added=added)

    def curve(self, port: str, against: Abscissa = "speed", bins: int = CURVE_BINS) -> TorqueCurve:
        """Mean of the torque at a port in bins, with a 95 % band.

        The band is about the mean, and each stay in a bin counts as one observation. The part of the missing
        effect that the model's own parameters compensate for is not in the curve.

        Args:
            port: Port of the torque.
            against: Speed or position of the port, deflection of the joint's spring, voltage or time.
            bins: Number of bins.

        Raises:
            InputError: There is no such port, abscissa or number of bins.
        """
        bins = whole(bins, "bins", 1)
        i, (x, name, unit) = self._index(port), self.axis(port, against)
        fields = binned_mean(x, self.torque[:, i], self.std[:, i], bins, self.recording)
        return TorqueCurve(**fields, against=name, unit=unit, port=port)

    def axis(self, port: str, against: Abscissa) -> tuple[Float[np.ndarray, " N"], str, str]:
        """The abscissa of a curve, its name and unit."""
        i = self._index(port)
        if against == "deflection":
            springs = [n.partition(".")[0] for n in self.linear if n.endswith(".spring")]
            if not springs:
                raise InputError(
                    "A curve against the deflection was asked for, but no port of the torques has a "
                    "spring; use 'position'."
                )
            return self.position[:, self._index(springs[0])], f"deflection of the {springs[0]}", self.motion
        sprung = f"{port}.spring" in self.linear
        known = {
            "speed": (self.speed[:, i], f"speed of the {port}", f"{self.motion}/s"),
            "position": (
                self.position[:, i],
                f"{'deflection' if sprung else 'position'} of the {port}",
                self.motion,
            ),
            "voltage": (self.voltage, input_word(self.input), self.input),
            "time": (self.time, "time", "s"),
        }
        if against not in known:
            raise InputError(
                f"A curve against {against!r} was asked for, but there is {', '.join(known)} and "
                "deflection; choose one."
            )
        return known[against]

    def size(self, port: str) -> float:
        """Root mean square of a torque [N m]."""
        return float(np.sqrt(np.mean(self.torque[:, self._index(port)] ** 2)))

    def spectrum(self, port: str) -> tuple[Float[np.ndarray, " F"], Float[np.ndarray, " F"]]:
        """Frequencies [Hz] and amplitude density [N m/sqrt(Hz)] of a torque, over the longest recording."""
        number = int(np.argmax(np.bincount(self.recording)))
        own = self.torque[self.recording == number, self._index(port)]
        f, density = scipy.signal.welch(own, 1 / self.Ts[number], nperseg=min(4096, max(16, len(own) // 5)))
        return f[1:], np.sqrt(density[1:])

    def periodic(self, port: str) -> tuple[PeriodicTorque, ...]:
        """Sines in the torque that the input lacks; see `latent.in_time.periodic_torques`.

        They are sought in the longest recording. There are none if the torque gains too little.
        """
        own = self._longest()
        return self._if_there(port, periodic_torques, self.voltage[own], self._period_of(own)) or ()

    def drift(self, port: str) -> Drift | None:
        """Slow rise or fall of a torque over the longest recording; None if there is none."""
        own = self._longest()
        return self._if_there(port, drift, self._period_of(own))

    def in_time(self) -> list[str]:
        """Sentences on the torques over time: periodic disturbances and slow drifts."""
        said = []
        for port in self.ports:
            for line in self.periodic(port):
                low, high = line.interval
                said.append(
                    f"The torque at the {port} has a sine of {line.frequency:.3g} Hz that the input has not: "
                    f"amplitude {line.amplitude:.3g} {self.effort} [{low:.3g}, {high:.3g}], a periodic "
                    f"disturbance unless a controller closes a loop (chance of none {line.p_value:.0e})."
                )
            if slow := self.drift(port):
                way = "rises" if slow.change > 0 else "falls"
                said.append(
                    f"The torque at the {port} {way} by {abs(slow.change):.3g} {self.effort} over the "
                    f"recording, a slow drift (chance of none {slow.p_value:.0e})."
                )
        return said

    def _longest(self) -> Bool[np.ndarray, " N"]:
        """Samples of the longest recording."""
        return self.recording == int(np.argmax(np.bincount(self.recording)))

    def _period_of(self, samples: Bool[np.ndarray, " N"]) -> float:
        return self.Ts[int(self.recording[samples][0])]

    def _if_there(self, port: str, read: Callable[..., Any], *given: Any) -> Any:
        """A function of a torque over the longest recording; None if the torque gains too little."""
        i = self._index(port)
        if self.gain_nats[port] < ASKED_FOR:
            return None
        return read(self.torque[self._longest(), i], *given)

    def plot(self, after: "LatentTorque | None" = None) -> "Figure":
        """Figure of the torques over speed, without and with the dampers' torques added, and over position.

        Args:
            after: Latent torques of a better model over the same recordings, drawn as well.
        """
        from rotflex_jax.latent.figure import latent_maps  # takes long to import

        return latent_maps(self, after)

    def _index(self, port: str) -> int:
        if port not in self.ports:
            raise InputError(
                f"The torque at {port!r} was asked for, but there is one at {', '.join(self.ports)}; "
                "name one of these."
            )
        return self.ports.index(port)

    def _repr_html_(self) -> str:
        """A card with size and gain of the torque at each port, and its mean over the speed of the port."""
        rows = [(p, plain_number(self.size(p)), plain_number(self.gain_nats[p])) for p in self.ports]
        drawn = []
        for port in self.ports:
            curve = self.curve(port)
            if len(curve.at) > 1:
                lines = [(curve.mean, FINAL, ""), (curve.low, MUTED, "3 3"), (curve.high, MUTED, "3 3")]
                panel, label = Panel(f"{port} [{self.effort}]", lines), f"{curve.against} [{curve.unit}]"
                svg = signals(curve.at, [panel], label, height=90)
                drawn.append(picture(svg, f"Mean torque at the {port} over its speed, with its band."))
        drawn.append(bullets(self.in_time()))
        return card(
            "Latent torque: what the model would have to be given to follow the measurement",
            table(("port", f"rms [{self.effort}]", "gain [nat]"), rows),
            *drawn,
        )

    def __str__(self) -> str:
        lines = ["Latent torque, root mean square and log-likelihood it gains"]
        for port in self.ports:  # `z`: a gain that rounds to zero has no sign
            lines.append(f"  {port}: {self.size(port):.3g} {self.effort}, {self.gain_nats[port]:z.0f} nat")
        return "\n".join([*lines, *(f"  {sentence}" for sentence in self.in_time())])


def latent_torque_result(
    model: Model,
    recordings: Sequence[Recording],
    ports: tuple[str, ...],
    states: tuple[Float[np.ndarray, "R N m"], Float[np.ndarray, "R N m"]],
    intensity: Float[np.ndarray, " D"],
    nats: Float[np.ndarray, " D"],
    scale: float,
) -> LatentTorque:
    """The result from smoothed states with their standard deviations, and intensity and gain of each port."""
    S, std = (np.concatenate([s[: r.N] for s, r in zip(a, recordings, strict=True)]) for a in states)
    m, n, D = model.mechanism, len(model.mechanism.coordinates), len(ports)
    vectors = np.array([m.port_vectors[p] for p in ports]).T
    position, speed = S[:, :n] @ vectors, S[:, n : 2 * n] @ vectors
    return LatentTorque(
        ports=ports,
        torque=S[:, -D:],
        std=std[:, -D:],
        time=np.concatenate([r.t for r in recordings]),
        position=position,
        speed=speed,
        voltage=np.concatenate([r.u for r in recordings]).astype(float),
        recording=np.repeat(np.arange(len(recordings)), [r.N for r in recordings]),
        Ts=tuple(float(r.Ts) for r in recordings),
        intensity=dict(zip(ports, intensity.tolist(), strict=True)),
        gain_nats=dict(zip(ports, nats.tolist(), strict=True)),
        scale=scale,
        linear=_linear_torques(m, ports, position, speed),
        motion=m.units.motion,
        input=m.units.input,
        effort=m.units.effort,
    )


def _linear_torques(
    m: Mechanism, ports: tuple[str, ...], position: np.ndarray, speed: np.ndarray
) -> dict[str, np.ndarray]:
    """`port.effect` -> torque of each damper and spring at the ports [N m]."""
    found = {}
    for _, e in effects_of(m, Linear):
        if e.motor or e.order or e.at not in ports:
            continue
        stamp, i = e.stamp(), ports.index(e.at)
        if float(stamp.damping) or float(stamp.stiffness):
            found[f"{e.at}.{e.name}"] = (
                -float(stamp.damping) * speed[:, i] - float(stamp.stiffness) * position[:, i]
            )
    return found
