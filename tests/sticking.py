"""Event-driven integration of dry friction with sticking, by scipy and independent of the package.

Between events every contact slides in one direction or rests, and an adaptive method of order 8 integrates
with a relative tolerance of 1e-11. An event is a sliding speed that reaches zero or a holding torque that
reaches its level. The result is accurate enough to check the integration step of the package.
"""

import dataclasses
import itertools
from collections.abc import Callable

import numpy as np
from scipy.integrate import solve_ivp

# A speed below this counts as zero [rad/s].
REST = 1e-14
HUB, JOINT, ARM = (1.0, 0.0), (0.0, 1.0), (1.0, 1.0)


@dataclasses.dataclass(frozen=True)
class Contact:
    """Dry friction at a port: `against(way, speed)` is the level against motion in a direction (+1, -1)."""

    port: tuple[float, float]
    against: Callable[[float, float], float]


def coulomb(port, level):
    return Contact(port, lambda way, speed: level)


def asymmetric(port, forward, backward):
    return Contact(port, lambda way, speed: forward if way > 0 else backward)


def stribeck(port, level, excess, over):
    return Contact(port, lambda way, speed: level + excess * np.exp(-((speed / over) ** 2)))


@dataclasses.dataclass(frozen=True)
class Joint:
    """The paper's joint, with extra smooth torques [N m] on (theta, alpha) as `extra(q, w)`."""

    contacts: tuple[Contact, ...] = ()
    extra: Callable[[np.ndarray, np.ndarray], np.ndarray] = lambda q, w: np.zeros(2)
    J_hub: float = 0.0021
    J_arm: float = 0.0059
    K: float = 1.61
    drive: float = 0.00767 * 70 / 2.6
    damping: float = (0.00767 * 70) ** 2 / 2.6

    @property
    def mass(self) -> np.ndarray:
        return np.array([[self.J_hub + self.J_arm, self.J_arm], [self.J_arm, self.J_arm]])

    def torque(self, q, w, v):
        linear = np.array([self.drive * v - self.damping * w[0], -self.K * q[1]])
        return linear + self.extra(q, w)

    def motion(self, x, v, modes):
        """Accelerations and contact torques where each contact slides (+1, -1) or rests (0)."""
        q, w = x[:2], x[2:]
        inverse = np.linalg.inv(self.mass)
        free = self.torque(q, w, v)
        ports = np.array([c.port for c in self.contacts]).reshape(-1, 2)
        f = np.array(
            [-m * c.against(m, abs(p @ w)) for m, c, p in zip(modes, self.contacts, ports, strict=True)]
        )
        rest = [i for i, m in enumerate(modes) if m == 0]
        if rest:
            moving = free + ports.T @ np.where(np.array(modes) == 0, 0.0, f)
            P = ports[rest]
            # With three contacts on two coordinates, holding torques are not unique: use the least norm.
            f[rest] = np.linalg.lstsq(P @ inverse @ P.T, -P @ inverse @ moving, rcond=None)[0]
        return inverse @ (free + ports.T @ f), f

    def modes(self, x, v, letting_go):
        """The consistent combination of modes; of several, the one with the most contacts at rest.

        Args:
            x: State.
            v: Voltage.
            letting_go: Contact -> direction, for a contact whose level has just been reached.
        """
        speeds = [np.dot(c.port, x[2:]) for c in self.contacts]
        choices = [
            (letting_go[i],) if i in letting_go else (int(np.sign(s)),) if abs(s) > REST else (0, 1, -1)
            for i, s in enumerate(speeds)
        ]
        for modes in sorted(itertools.product(*choices), key=lambda m: sum(map(abs, m))):
            a, f = self.motion(x, v, modes)
            good = True
            for i, (m, c) in enumerate(zip(modes, self.contacts, strict=True)):
                if m == 0:
                    good &= -c.against(1, 0.0) <= f[i] <= c.against(-1, 0.0)
                elif abs(speeds[i]) <= REST and i not in letting_go:
                    good &= m * np.dot(c.port, a) > 0
            if good:
                return modes
        raise AssertionError(f"no consistent contact state at {x}")

    def hold(self, x, v, span):
        """State after `span` [s] of constant voltage `v`."""
        t, letting_go = 0.0, {}
        for _ in range(100):
            modes = self.modes(x, v, letting_go)
            events, labels = [], []
            for i, (m, c) in enumerate(zip(modes, self.contacts, strict=True)):
                for way in (1, -1) if m == 0 else (m,):
                    events.append(self._event(i, c, way, m, v, modes))
                    labels.append((i, way if m == 0 else 0))
            run = solve_ivp(
                lambda _, s, modes=modes: np.concatenate([s[2:], self.motion(s, v, modes)[0]]),
                (t, span),
                x,
                method="DOP853",
                rtol=1e-11,
                atol=1e-13,
                events=events,
            )
            x, t = run.y[:, -1].copy(), run.t[-1]
            happened = [labels[k] for k, e in enumerate(run.t_events or ()) if len(e)]
            letting_go = {i: way for i, way in happened if way != 0}
            stopped = {i for i, way in happened if way == 0}
            x[2:] = self._arrested(x[2:], modes, stopped)
            if run.status == 0:
                return x
        raise AssertionError("too many events")

    def _event(self, i, contact, way, mode, v, modes):
        if mode == 0:

            def event(_, s):
                return contact.against(way, 0.0) + way * self.motion(s, v, modes)[1][i]

        else:

            def event(_, s):
                return way * np.dot(contact.port, s[2:])

        event.terminal, event.direction = True, -1
        return event

    def _arrested(self, w, modes, stopped):
        """Speeds with exactly zero at every contact that rests or has just come to rest."""
        still = [
            c.port
            for i, (m, c) in enumerate(zip(modes, self.contacts, strict=True))
            if m == 0 or i in stopped
        ]
        if not still:
            return w
        P = np.array(still)
        w = w - np.linalg.pinv(P) @ (P @ w)
        return np.where(np.abs(w) < REST, 0.0, w)

    def run(self, u, Ts, x0=(0.0, 0.0, 0.0, 0.0)):
        """States (N, 4) at the samples."""
        x = np.array(x0, dtype=float)
        states = []
        for v in u:
            states.append(x)
            x = self.hold(x, float(v), Ts)
        return np.array(states)
