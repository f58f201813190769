"""Laws of the joint, fitted to the arm alone: the measured hub angle is the input of the model.

    phi'' = -(w2 alpha + d alpha' + cubic alpha^3 + level z + dry s),   alpha = phi - theta measured

Here `z` is the state of Bouc-Wen hysteresis (width, beta) and `s` the smoothed sign tanh(alpha' / 0.01
rad/s) of dry friction. The measured angle of the hub is smoothed slightly, and more where it hardly moves,
because each count of its sensor would excite an oscillation of the arm.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import least_squares
from scipy.signal import savgol_filter

import rotflex_jax as rf
from rotflex_jax.runtime.xla import double_precision

# Start and scale of each parameter; torques are divided by the inertia of the arm.
START = {
    "w2": 520.0,
    "d": 0.3,
    "bias": 0.0,
    "cubic": 0.0,
    "level": 0.0,
    "width": 0.05,
    "beta": 0.3,
    "dry": 0.0,
}
SCALE = {
    "w2": 500.0,
    "d": 1.0,
    "bias": 0.01,
    "cubic": 1e4,
    "level": 3.0,
    "width": 0.05,
    "beta": 1.0,
    "dry": 1.0,
}
LINEAR = ("w2", "d", "bias")
LAWS: dict[str, tuple[str, ...]] = {
    "linear spring": LINEAR,
    "and a cubic term": (*LINEAR, "cubic"),
    "and hysteresis (Bouc-Wen)": (*LINEAR, "level", "width", "beta"),
    "and hysteresis, Coulomb friction": (*LINEAR, "level", "width", "beta", "dry"),
}
STEPS = 3  # per sample


def compare(runs: dict[str, rf.Recording]) -> dict:
    """Errors of the deflection [deg] of each law, fitted to one run and evaluated on each run."""
    out = {}
    for law, free in LAWS.items():
        for learnt, run in runs.items():
            numbers = _fitted(run, free)
            # A bias is a calibration of one recording.
            errors = {
                k: float(np.sqrt(np.mean(_errors(numbers | ({} if k == learnt else {"bias": 0.0}), r) ** 2)))
                for k, r in runs.items()
            }
            out[f"{law}, from {learnt}"] = {"errors_deg": errors, "numbers": {k: numbers[k] for k in free}}
    return out


def _fitted(run: rf.Recording, free: tuple[str, ...]) -> dict[str, float]:
    start = START | ({"level": 3.0} if "level" in free else {})
    scale = np.array([SCALE[k] for k in free])

    def residual(z: np.ndarray) -> np.ndarray:
        return np.nan_to_num(_errors(start | dict(zip(free, z * scale, strict=True)), run).ravel(), nan=1e3)

    found = least_squares(residual, [start[k] / SCALE[k] for k in free], diff_step=1e-4, max_nfev=60)
    return start | dict(zip(free, (found.x * scale).tolist(), strict=True))


def _errors(numbers: dict[str, float], run: rf.Recording) -> np.ndarray:
    """Errors (W, N) over windows of two seconds, without the first 0.2 s [deg]."""
    hub, alpha = _windows(run)
    with double_precision():
        p = {k: jnp.asarray(v) for k, v in numbers.items()}
        y = np.asarray(_arm(p, jnp.asarray(hub), jnp.asarray(alpha[:, :50].mean(axis=1)), run.Ts))
    return np.degrees(np.asarray(y - alpha[:, :-1]))[:, 100:]


def _windows(run: rf.Recording) -> tuple[np.ndarray, np.ndarray]:
    theta, alpha = np.asarray(run.y).T
    speed = np.abs(np.asarray(savgol_filter(theta, 21, 2, deriv=1, delta=run.Ts)))
    nearby = np.max([np.roll(speed, k) for k in range(-20, 21)], axis=0)
    share = np.clip((np.degrees(nearby) - 8) / 12, 0, 1)
    smooth = share * savgol_filter(theta, 5, 2) + (1 - share) * savgol_filter(theta, 41, 3)
    width = round(2 / run.Ts)
    starts = range(0, run.N - width + 1, width)
    return np.array([smooth[i : i + width] for i in starts]), np.array([alpha[i : i + width] for i in starts])


@functools.partial(jax.jit, static_argnums=3)
def _arm(p, hub, first, Ts):
    h = Ts / STEPS

    def slope(x, theta, speed):
        phi, dphi, z = x
        a, da = phi - theta, dphi - speed
        pull = p["w2"] * a + p["d"] * da + p["cubic"] * a**3 + p["level"] * z + p["dry"] * jnp.tanh(da / 0.01)
        dz = (da - p["beta"] * jnp.abs(da) * z - (1 - p["beta"]) * da * jnp.abs(z)) / p["width"]
        return jnp.stack([dphi, -pull, dz])

    def one(theta, alpha):
        speed = jnp.gradient(theta) / Ts

        def sample(x, k):
            between = lambda s: ((1 - s) * theta[k] + s * theta[k + 1], (1 - s) * speed[k] + s * speed[k + 1])  # noqa: E731
            reading = x[0] - theta[k] + p["bias"]
            for i in range(STEPS):  # classical Runge-Kutta
                begin, middle, end = between(i / STEPS), between((i + 0.5) / STEPS), between((i + 1) / STEPS)
                k1 = slope(x, *begin)
                k2 = slope(x + h / 2 * k1, *middle)
                k3 = slope(x + h / 2 * k2, *middle)
                x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + slope(x + h * k3, *end))
            return x, reading

        start = jnp.stack([theta[:50].mean() + alpha - p["bias"], jnp.zeros(()), jnp.zeros(())])
        return jax.lax.scan(sample, start, jnp.arange(len(theta) - 1))[1]

    return jax.vmap(one)(hub, first)
