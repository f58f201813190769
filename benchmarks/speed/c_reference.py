"""The functions of `reference.c` on arrays; the C code is compiled when it is first needed."""

from __future__ import annotations

import ctypes
import functools
import shutil
import subprocess
import tempfile
from pathlib import Path

import numpy as np

SOURCE = Path(__file__).with_name("reference.c")
PLAIN = ("-O3", "-march=native")
FAST_MATH = (*PLAIN, "-ffast-math")
LANES = 100

_doubles = np.ctypeslib.ndpointer(np.float64, flags="C_CONTIGUOUS")


def missing() -> str:
    """Reason why the C code cannot be compiled; empty if it can."""
    return "" if shutil.which("gcc") else "gcc is not installed"


@functools.cache
def library(memory: int = 5, options: tuple[str, ...] = PLAIN) -> ctypes.CDLL:
    """The compiled functions for one number of delays."""
    out = Path(tempfile.mkdtemp(prefix="speed_c_")) / "reference.so"
    subprocess.run(
        ["gcc", *options, f"-DM={memory}", "-shared", "-fPIC", str(SOURCE), "-o", str(out), "-lm"], check=True
    )
    code = ctypes.CDLL(str(out))
    number, whole = ctypes.c_double, ctypes.c_long
    code.lms.argtypes = [_doubles] * 5 + [whole]
    code.lms_lanes.argtypes = [_doubles] * 5 + [whole]
    code.rls.argtypes = [_doubles, _doubles, number, _doubles, _doubles, _doubles, whole]
    code.joint.argtypes = [_doubles, _doubles, number, ctypes.c_int, _doubles, whole]
    code.joint_current.argtypes = [_doubles, _doubles, _doubles, number, ctypes.c_int, _doubles, whole]
    return code


def regressors(memory: int) -> int:
    """Number of regressors: the constant, the delays and their products."""
    return 1 + memory + memory * (memory + 1) // 2


def lms(
    u: np.ndarray,
    y: np.ndarray,
    mu: tuple[float, float, float],
    memory: int,
    options: tuple[str, ...] = PLAIN,
) -> np.ndarray:
    """A-priori errors (N,) of second-order Volterra LMS with one step size per degree."""
    e, w = np.empty_like(u), np.zeros(regressors(memory))
    library(memory, options).lms(u, y, np.array(mu), e, w, len(u))
    return e


def lms_lanes(u: np.ndarray, y: np.ndarray, mu: np.ndarray, memory: int) -> np.ndarray:
    """Sums of squared errors (LANES,) of LMS for step sizes (3, LANES)."""
    sse, w = np.zeros(LANES), np.zeros((regressors(memory), LANES))
    library(memory).lms_lanes(u, y, np.ascontiguousarray(mu), sse, w, len(u))
    return sse


def rls(u: np.ndarray, y: np.ndarray, lam: float, delta: float, memory: int) -> np.ndarray:
    """A-priori errors (N,) of recursive least squares."""
    P = regressors(memory)
    e = np.empty_like(u)
    library(memory).rls(u, y, lam, e, np.zeros(P), delta * np.eye(P), len(u))
    return e


def joint(
    u: np.ndarray, p: np.ndarray, Ts: float, substeps: int = 1, options: tuple[str, ...] = PLAIN
) -> np.ndarray:
    """Angles (N, 2) of the flexible joint without motor current, by classical Runge-Kutta."""
    out = np.empty((len(u), 2))
    library(5, options).joint(u, p, Ts, substeps, out, len(u))
    return out


def joint_current(u: np.ndarray, p: np.ndarray, motor: np.ndarray, Ts: float, substeps: int) -> np.ndarray:
    """Angles (N, 2) of the flexible joint with motor current."""
    out = np.empty((len(u), 2))
    library().joint_current(u, p, motor, Ts, substeps, out, len(u))
    return out
