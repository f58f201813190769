"""The measured joint with play in the gear: motor and hub are two bodies that touch at the ends of a gap.

    motor   (1 - share) J vm' = drive (u + offset) - damping vm - friction(vm) - contact
    hub           share J v'  = contact + joint - load_level sign(v)
    arm          arm_inertia w' = -joint
    contact = side max(stiff (|m - theta| - gap) + damp side (vm - v), 0)  where |m - theta| > gap

m is the angle of the motor at the output of the gear, theta that of the hub, side the sign of m - theta, and
gap is half of the play. Integration rule, friction laws and the torque of the joint are those of `fine_run`.
The sensor of the hub angle is on the load side of the play.
"""

from collections.abc import Sequence

import numba
import numpy as np
from scipy.optimize import least_squares

import rotflex_jax as rf
from measured_joint import fine_run
from measured_joint.fine_run import ARM_INERTIA, STEPS, WEIGHTS, Law, _shrink, residual, rms

# Stiffness and damping of the contact [N m/rad, N m s/rad]. They are constants and are not fitted.
STIFF, SOFT = 150.0, 0.05
NUMBERS: dict[str, tuple[float, float]] = fine_run.NUMBERS | {
    "share": (0.25, 0.3),
    "gap": (0.0023, 0.002),
    "load_level": (0.003, 0.005),
}
NONNEGATIVE = fine_run.NONNEGATIVE | {"share", "gap", "load_level"}
PLAY = ("share", "gap")
STRUCTURES: dict[str, tuple[str, ...]] = {
    "Coulomb and play": (*fine_run.LINEAR, "level", *PLAY, "load_level"),
    "LuGre and play": (*fine_run.LINEAR, *fine_run.LUGRE, *PLAY),
    "LuGre and play, Bouc-Wen at the joint": (
        *fine_run.LINEAR,
        *fine_run.LUGRE,
        *PLAY,
        "load_level",
        *fine_run.BOUC_WEN,
    ),
}


@numba.njit(cache=True)
def _window(p, lugre, u, theta, alpha, Ts):
    c, d_hub, J, k, d, level, rise, slow, pre, joint, width, beta, offset, bias, share, gap, load = p
    h, J_hub, J_motor = Ts / STEPS, J * share, J * (1 - share)
    phi, m = theta + alpha - bias, theta
    v, vm, w, z, s = 0.0, 0.0, 0.0, 0.0, 0.0
    out = np.empty((len(u), 2))
    for i in range(len(u)):
        out[i, 0], out[i, 1] = theta, phi - theta + bias
        for _ in range(STEPS):
            a, da, e = phi - theta, w - v, m - theta
            pull = k * a + d * da + joint * z
            contact = 0.0
            if e > gap:
                contact = max(STIFF * (e - gap) + SOFT * (vm - v), 0.0)
            elif e < -gap:
                contact = min(STIFF * (e + gap) + SOFT * (vm - v), 0.0)
            free = c * (u[i] + offset) - d_hub * vm - contact
            if lugre:
                g = 1.0 + rise * np.exp(-((vm / slow) ** 2))
                rate = abs(vm) / (g * pre)
                if rate * h > 1e-9:
                    end = np.sign(vm) * g + (s - np.sign(vm) * g) * np.exp(-rate * h)
                else:
                    end = s + h * vm / pre
                vm, s = vm + h * (free - level * 0.5 * (s + end)) / J_motor, end
            else:
                vm = _shrink(vm + h * free / J_motor, h * level / J_motor)
            v = _shrink(v + h * (contact + pull) / J_hub, h * load / J_hub)
            w = w - h * pull / ARM_INERTIA
            z = z + h * (da - beta * abs(da) * z - (1 - beta) * da * abs(z)) / width
            z = min(max(z, -1.5), 1.5)
            m, theta, phi = m + h * vm, theta + h * v, phi + h * w
    return out


# Every run starts at rest in the middle of the play.
LAW = Law(tuple(NUMBERS), _window)


def fit(
    run: rf.Recording,
    free: Sequence[str],
    lugre: bool,
    start: dict[str, float] | None = None,
) -> dict[str, float]:
    """All parameters, the free ones fitted to one run by least squares of free-run errors over windows."""
    held = {k: v for k, (v, _) in NUMBERS.items()} | {
        k: 0.0 for k in ("joint_level", "load_level") if k not in free
    }
    held |= start or {}
    scale = np.array([NUMBERS[k][1] for k in free])
    low = np.array([0.0 if k in NONNEGATIVE else -np.inf for k in free])
    high = np.array([{"joint_beta": 1.0, "share": 0.9}.get(k, np.inf) for k in free])
    low = np.where(np.array(free) == "share", 0.08, low)

    def missed(x: np.ndarray) -> np.ndarray:
        numbers = held | dict(zip(free, (x * scale).tolist(), strict=True))
        return (residual(numbers, lugre, run, law=LAW) / WEIGHTS).ravel()

    begin = np.clip(np.array([held[k] for k in free]) / scale, low / scale + 1e-6, high / scale - 1e-6)
    found = least_squares(missed, begin, bounds=(low / scale, high / scale), diff_step=1e-3, max_nfev=60)
    return held | dict(zip(free, (found.x * scale).tolist(), strict=True))


def compare(A: rf.Recording, B: rf.Recording) -> dict:
    """Fits each structure to each of the two runs, and evaluates each fit on both runs.

    The errors are those of free runs over windows, without offset and with the offset fitted to the evaluated
    run, and of one free run over the whole recording with this offset.
    """
    runs, out = {"A": A, "B": B}, {}
    for name, free in STRUCTURES.items():
        lugre = "presliding" in free
        for learnt in runs:
            found = fit(runs[learnt], (*free, *fine_run.OWN), lugre)
            evaluated = {}
            for key, run in runs.items():
                bare = found | {"offset": 0.0, "bias": 0.0}
                own = found if key == learnt else fit(run, ("offset",), lugre, bare)
                evaluated[key] = {
                    "no_offset": rms(bare, lugre, run, law=LAW),
                    "own_offset": rms(own, lugre, run, law=LAW),
                    "offset": own["offset"],
                    "whole": rms(own, lugre, run, run.N, LAW),
                }
                errors = " | ".join(
                    " / ".join(f"{e:.2f}" for e in evaluated[key][k])
                    for k in ("no_offset", "own_offset", "whole")
                )
                seen = "" if key != learnt else " (bound)"
                print(f"| {name} | {learnt}, {key}{seen} | {errors} |", flush=True)
            out[f"{name}, from {learnt}"] = {"evaluated": evaluated, "numbers": found}
    return out
