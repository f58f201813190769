"""Reader of the public recordings of a real rotary flexible joint (SRV02 with ROTFLEX module).

A student laboratory logged two closed-loop runs at 500 Hz with 4096-count encoders: reference a
square wave of 30 degrees, feedback of theta in one and of theta + alpha in the other. Dry friction
holds the hub still between the steps, at angles that the controller would not have chosen.
"""

import math
import os
from types import MappingProxyType

import numpy as np

from rotflex_jax.data.binary import read_mat
from rotflex_jax.data.files import readable_file
from rotflex_jax.errors import InputError
from rotflex_jax.recording import Recording
from rotflex_jax.recording.samples import even_spacing

LABORATORY = MappingProxyType(
    {
        "R_m": (2.6, "ohm"),
        "k_t": (0.00768, "N m/A"),
        "k_m": (0.00768, "V s/rad"),
        "K_g": (70.0, "-"),
        "eta_g": (0.9, "-"),
        "eta_m": (0.69, "-"),
        "B_hub": (0.004, "N m s/rad"),
        "J_hub": (0.002584, "kg m^2"),
        "J_arm": (0.003894, "kg m^2"),
        "K": (1.0142, "N m/rad"),
    }
)
"""The laboratory's own parameters: name to value and unit. They leave dry friction out."""

COUNT = 2 * math.pi / 4096
"""One count of the encoders [rad]."""


def load_rotflex(path: str | os.PathLike[str]) -> Recording:
    """Reads one run: motor voltage, servo angle and deflection, degrees turned into radians.

    Args:
        path: of the MAT file.

    Returns:
        The recording, channels theta and alpha [rad].

    Raises:
        InputError: the file is missing, damaged, or has not the variables of such a run.
    """
    file = readable_file(path)
    variables = read_mat(file)
    missing = {"data_vm", "data_theta", "data_alpha"} - set(variables)
    if missing:
        raise InputError(
            f"{file.name} lacks {', '.join(sorted(missing))}, which the public ROTFLEX runs have; "
            "read another file with load(path, input=..., outputs=...)."
        )
    t, u = np.asarray(variables["data_vm"], dtype=np.float64).T
    theta = np.asarray(variables["data_theta"])[:, 2]  # time, reference, measured
    alpha = np.asarray(variables["data_alpha"])[:, 1]
    return Recording(
        u=u,
        y=np.deg2rad(np.column_stack([theta, alpha])),
        Ts=even_spacing(t, f"{file.name}: the time"),
        source=file.name,
        start=float(t[0]),
        resolution={"theta": COUNT, "alpha": COUNT},
    )
