"""What the latent torque is to a user: torques with bands, curves, spectra, and what may be given back."""

import dataclasses
from collections.abc import Sequence
from typing import TYPE_CHECKING, Literal, Self

import numpy as np
import scipy

from rotflex_jax.effects.kinds import Linear
from rotflex_jax.errors import InputError
from rotflex_jax.latent.curve import Curve, binned
from rotflex_jax.mechanism import Mechanism
from rotflex_jax.model import Model
from rotflex_jax.recording import Recording

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Against = Literal["speed", "position", "deflection", "voltage", "time"]
BINS = 40


@dataclasses.dataclass(frozen=True)
class LatentTorque:
    """Torques that a model does not know of, along its recordings, one after the other.

    Attributes:
        ports: Where the torques act (P).
        torque: Mean given all samples [N m] (N, P).
        std: Deviation about it [N m] (N, P).
        time: [s] (N,).
        position: Of each port [rad] (N, P).
        speed: Of each port [rad/s] (N, P).
        voltage: [V] (N,).
        recording: Number of the recording of each sample (N,).
        Ts: Sampling period of each recording [s].
        intensity: Port -> intensity of the torque, a random walk [(N m)^2/s].
        gain_nats: Port -> log-likelihood that its torque gains over none [nat].
        scale: Torque that the motor gives at the root mean square voltage [N m].
        linear: Torques of the model's own dampers and springs at these ports, `port.effect` ->
            torque [N m] (N,); what `given_back` can add.
        motion: Unit of positions.
        effort: Unit of torques.
        added: Which of them are in `torque`.
    """

    ports: tuple[str, ...]
    torque: np.ndarray
    std: np.ndarray
    time: np.ndarray
    position: np.ndarray
    speed: np.ndarray
    voltage: np.ndarray
    recording: np.ndarray
    Ts: tuple[float, ...]
    intensity: dict[str, float]
    gain_nats: dict[str, float]
    scale: float
    linear: dict[str, np.ndarray]
    motion: str = "rad"
    effort: str = "N m"
    added: tuple[str, ...] = ()

    def given_back(self, *names: str, beyond: Self | None = None) -> Self:
        """The torque together with that of some of the model's own dampers and springs.

        A fitted damper holds what is true of it and what it took over from the missing effect; only
        their sum with the torque is what the machine feels.

        Args:
            names: `port.effect`, for instance "hub.viscous"; all dampers if none is named.
            beyond: Torques of the same recordings under a better model: then only what these terms give
                beyond the same terms there is added.
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

    def curve(self, port: str, against: Against = "speed", bins: int = BINS) -> Curve:
        """Mean of the torque at a port in bins, with a 95 % band.

        The band is that of the mean, each stay in a bin counting once; it says nothing of what the
        model's own terms took over.

        Args:
            port: Which torque.
            against: Speed or position of the port, deflection of the joint's spring, voltage or time.
            bins: How many.
        """
        i, (x, name, unit) = self._index(port), self.axis(port, against)
        fields = binned(x, self.torque[:, i], self.std[:, i], bins, self.recording)
        return Curve(**fields, against=name, unit=unit, port=port)

    def axis(self, port: str, against: Against) -> tuple[np.ndarray, str, str]:
        """What a torque is drawn against (N,), its name and unit."""
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
                "rad",
            ),
            "voltage": (self.voltage, "voltage", "V"),
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

    def spectrum(self, port: str) -> tuple[np.ndarray, np.ndarray]:
        """Frequencies [Hz] and amplitude density [N m/sqrt(Hz)] of a torque, over the longest recording."""
        number = int(np.argmax(np.bincount(self.recording)))
        own = self.torque[self.recording == number, self._index(port)]
        f, density = scipy.signal.welch(own, 1 / self.Ts[number], nperseg=min(4096, max(16, len(own) // 5)))
        return f[1:], np.sqrt(density[1:])

    def plot(self, after: Self | None = None) -> "Figure":
        """The torques over speed, without and with the dampers given back, and over position.

        Args:
            after: The torques that a better model leaves on the same recordings, drawn beside.
        """
        from rotflex_jax.report.latent import latent_maps  # the layer above, on request

        return latent_maps(self, after)

    def _index(self, port: str) -> int:
        if port not in self.ports:
            raise InputError(
                f"The torque at {port!r} was asked for, but there is one at {', '.join(self.ports)}; "
                "name one of these."
            )
        return self.ports.index(port)

    def _repr_html_(self) -> str:
        from rotflex_jax.display.cards import latent_card  # the layer above, when a notebook asks

        return latent_card(self)

    def __str__(self) -> str:
        lines = ["Latent torque, root mean square and log-likelihood it gains"]
        lines += [f"  {p}: {self.size(p):.3g} {self.effort}, {self.gain_nats[p]:.0f} nat" for p in self.ports]
        return "\n".join(lines)


def assembled(
    model: Model,
    recordings: Sequence[Recording],
    ports: tuple[str, ...],
    states: tuple[np.ndarray, np.ndarray],
    level: np.ndarray,
    nats: np.ndarray,
    scale: float,
) -> LatentTorque:
    """A result from smoothed states (R, N, m), their deviations, intensities and gains per port."""
    S, std = (np.concatenate([s[: r.N] for s, r in zip(a, recordings, strict=True)]) for a in states)
    m, n, P = model.mechanism, len(model.mechanism.coordinates), len(ports)
    vectors = np.array([m.port_vectors[p] for p in ports]).T
    position, speed = S[:, :n] @ vectors, S[:, n : 2 * n] @ vectors
    return LatentTorque(
        ports=ports,
        torque=S[:, -P:],
        std=std[:, -P:],
        time=np.concatenate([r.t for r in recordings]),
        position=position,
        speed=speed,
        voltage=np.concatenate([r.u for r in recordings]).astype(float),
        recording=np.repeat(np.arange(len(recordings)), [r.N for r in recordings]),
        Ts=tuple(float(r.Ts) for r in recordings),
        intensity=dict(zip(ports, level.tolist(), strict=True)),
        gain_nats=dict(zip(ports, nats.tolist(), strict=True)),
        scale=scale,
        linear=_linear(m, ports, position, speed),
        motion=m.units.motion,
        effort=m.units.effort,
    )


def _linear(
    m: Mechanism, ports: tuple[str, ...], position: np.ndarray, speed: np.ndarray
) -> dict[str, np.ndarray]:
    """Torques of dampers and springs at the ports."""
    found = {}
    for e in m.effects:
        if not isinstance(e, Linear) or e.motor or e.order or e.at not in ports:
            continue
        stamp, i = e.stamp(), ports.index(e.at)
        if float(stamp.damping) or float(stamp.stiffness):
            found[f"{e.at}.{e.name}"] = (
                -float(stamp.damping) * speed[:, i] - float(stamp.stiffness) * position[:, i]
            )
    return found
