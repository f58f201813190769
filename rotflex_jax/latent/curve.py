"""The mean of a torque over speed, position or time, with what scatters about it."""

import dataclasses

import numpy as np

# Fewer samples than this in a bin tell nothing.
FEWEST = 8
# What is usual elsewhere counts as much as this many stays in a bin.
FEW = 3


@dataclasses.dataclass(frozen=True)
class Curve:
    """A binned mean.

    Attributes:
        at: Mean of what it is drawn against in each bin (B,).
        mean: Mean torque [N m] (B,).
        low: Lower end of the 95 % band of that mean [N m].
        high: Upper end [N m].
        spread: Deviation of single samples about the mean [N m] (B,).
        count: Samples in each bin.
        visits: Separate stays in each bin.
        against: What it is drawn against.
        unit: Of that.
        port: Where the torque acts.
    """

    at: np.ndarray
    mean: np.ndarray
    low: np.ndarray
    high: np.ndarray
    spread: np.ndarray
    count: np.ndarray
    visits: np.ndarray
    against: str
    unit: str
    port: str


def binned(
    x: np.ndarray, torque: np.ndarray, std: np.ndarray, bins: int, segment: np.ndarray
) -> dict[str, np.ndarray]:
    """Fields of a curve.

    Neighbouring samples tell the same, so a stay in a bin, from entering to leaving it, counts as one
    observation. Bins are equally wide between the outermost hundredths, which they take in.

    Args:
        x: What to draw against (N,).
        torque: [N m] (N,).
        std: Its deviation [N m] (N,).
        bins: How many.
        segment: Number of the recording of each sample (N,).
    """
    low, high = np.quantile(x, (0.01, 0.99))
    edges = np.linspace(low, high if high > low else low + 1.0, bins + 1)
    which = np.clip(np.searchsorted(edges, x, side="right") - 1, 0, bins - 1)
    enters = np.r_[True, (which[1:] != which[:-1]) | (segment[1:] != segment[:-1])]
    stay = np.cumsum(enters) - 1
    length, bin_of = np.bincount(stay).astype(float), which[enters]
    count = np.bincount(bin_of, length, bins)
    visits = np.bincount(bin_of, minlength=bins)
    kept = count >= FEWEST
    each = np.maximum(count, 1.0)
    mean, own, at = (np.bincount(which, w, bins) / each for w in (torque, std**2, x))
    scatter = np.bincount(which, (torque - mean[which]) ** 2, bins) / each
    # How far the means of stays lie from that of their bin; where stays are few, as far as elsewhere.
    off = length * (np.bincount(stay, torque) / length - mean[bin_of]) ** 2
    usual = off.sum() / max(count[visits > 1].sum(), 1.0)
    apart = (visits * np.bincount(bin_of, off, bins) / each + FEW * usual) / np.maximum(visits - 1 + FEW, 1)
    error = np.sqrt(apart * np.bincount(bin_of, length**2, bins) / each**2 + own / np.maximum(visits, 1))
    return {
        "at": at[kept],
        "mean": mean[kept],
        "low": (mean - 1.96 * error)[kept],
        "high": (mean + 1.96 * error)[kept],
        "spread": np.sqrt(scatter[kept]),
        "count": count[kept].astype(int),
        "visits": visits[kept],
    }
