"""The paper's joint without friction, from its published matrices: reference for linear filter banks."""

import json
from pathlib import Path

import numpy as np
from scipy.linalg import expm

PAPER = json.loads((Path(__file__).parent / "paper_numbers.json").read_text())
POLES = tuple(complex(*pole) for pole in PAPER["eig4"][:3])  # the fourth is the free rotation


def impulse_response(Ts: float, seconds: float = 2.0) -> np.ndarray:
    """Deflection [rad] at every sample after 1 V over one sample, by the matrix exponential."""
    big = np.zeros((5, 5))
    big[:4, :4], big[:4, 4] = PAPER["A4"], PAPER["B4"]
    big = expm(big * Ts)
    x, answer = big[:4, 4], [0.0]
    for _ in range(round(seconds / Ts) - 1):
        answer.append(x[1])
        x = big[:4, :4] @ x
    return np.array(answer)
