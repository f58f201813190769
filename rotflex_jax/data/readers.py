"""Readers of other public recordings with friction or a nonlinear spring, not of this joint."""

import os
from dataclasses import replace

import numpy as np

from rotflex_jax.data.binary import read_mat
from rotflex_jax.data.files import readable_file
from rotflex_jax.recording import Recording
from rotflex_jax.recording.samples import even_spacing

ARM_LENGTH = 0.45
"""Hub to tip of the rotary arm [m]."""


def load_emps(path: str | os.PathLike[str]) -> Recording:
    """Reads a run of the Electro-Mechanical Positioning System: motor voltage to position.

    The force is 35.1507 N per volt. Protocol: free run, the first 20 samples for initialisation.

    Args:
        path: of the MAT file.

    Returns:
        The recording, channel position [m].

    Source:
        Janot, Gautier, Brunot 2019, Data set and reference models of EMPS.
    """
    file = readable_file(path)
    variables = read_mat(file)
    return Recording(
        u=variables["vir"],
        y=variables["qm"],
        Ts=even_spacing(np.asarray(variables["t"]), f"{file.name}: the time"),
        channels=("position",),
        units=("m",),
        n_init=20,
        source=file.name,
    )


def load_silverbox(path: str | os.PathLike[str]) -> list[Recording]:
    """Reads the Silverbox, an electronic oscillator with a cubic spring: voltage to voltage.

    Protocol: free run, the first 50 samples for initialisation.

    Args:
        path: of the MAT file.

    Returns:
        The official parts, channel output [V]: a multisine to learn from, one to judge on, an arrow
        of growing amplitude, and the arrow within the amplitudes of the first part.

    Source:
        Wigren, Schoukens 2013, Three free data sets for development and benchmarking in nonlinear
        system identification.
    """
    file = readable_file(path)
    variables = read_mat(file)
    whole = Recording(
        u=variables["V1"],
        y=variables["V2"],
        Ts=1 / 610.35,
        channels=("output",),
        units=("V",),
        n_init=50,
        source=file.name,
    )
    ranges = {
        "multisine": (40650, 105712),
        "multisine, held out": (105712, 127400),
        "arrow": (100, 40575),
        "arrow without extrapolation": (100, 32100),
    }
    return [replace(whole.slice(i, j), source=f"{file.name}, {part}") for part, (i, j) in ranges.items()]


def load_rotary_arm(path: str | os.PathLike[str]) -> Recording:
    """Reads a run of a geared motor with a rigid or a flexible arm, rounded to 1 mrad and 1 mm.

    Motor constants: gear ratio 48.4, 0.0107 N m/A, 3.29 ohm. The time is in milliseconds, whatever
    the header says. The tip of the flexible arm was measured as a distance; its angle is
    `alpha = tip / 0.45 m`, so that theta + alpha points at the tip.

    Args:
        path: of the text file.

    Returns:
        The recording, channel theta [rad] and, where the arm is flexible, alpha [rad].
    """
    file = readable_file(path)
    t, theta, tip, *_ = columns = np.loadtxt(file, skiprows=1).T
    flexible = bool(np.any(tip))
    alpha = tip / ARM_LENGTH
    return Recording(
        u=columns[6],
        y=np.column_stack([theta, alpha] if flexible else [theta]),
        Ts=even_spacing(t / 1000, f"{file.name}: the time"),
        source=file.name,
        resolution={"theta": 1e-3, "alpha": 1e-3 / ARM_LENGTH},
    )
