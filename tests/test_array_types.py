"""The check of arrays at run time, which the test session switches on for the package."""

import dataclasses

import array_types
import jaxtyping
import numpy as np
import pytest
from jaxtyping import Float

from rotflex_jax.discover.selection import error_ratio, paired_gain


def rms(x: Float[np.ndarray, " N"]) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(x**2)))


@dataclasses.dataclass
class Pair:
    """Two arrays of equal length."""

    a: Float[np.ndarray, " N"]
    b: Float[np.ndarray, " N"]

    @property
    def wrong(self) -> Float[np.ndarray, "N N"]:
        """A vector, although a matrix is annotated."""
        return self.a


HOOK = jaxtyping.jaxtyped(typechecker=array_types.checked)


def test_arrays_are_as_annotated_in_the_first_calls(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(array_types, "CALLS", 2)
    hooked = HOOK(rms)
    assert hooked(np.full(3, 2.0)) == 2.0
    with pytest.raises(jaxtyping.TypeCheckError):
        hooked(np.ones((3, 1)))
    assert hooked(np.ones((3, 1))) == 1.0  # no longer checked


def test_so_are_those_of_data_classes_and_properties():
    pair = HOOK(
        dataclasses.make_dataclass("Own", [("a", Float[np.ndarray, " N"]), ("b", Float[np.ndarray, " N"])])
    )
    pair(np.ones(3), np.ones(3))
    with pytest.raises(jaxtyping.TypeCheckError):
        pair(np.ones(3), np.ones(2))
    with pytest.raises(jaxtyping.TypeCheckError):
        HOOK(Pair.__dict__["wrong"]).fget(Pair(np.ones(3), np.ones(3)))


def test_the_package_is_checked():
    assert hasattr(paired_gain, "__wrapped__") and not hasattr(error_ratio, "__wrapped__")


def test_functions_without_arrays_stay_as_they_are():
    def plain(x: float) -> str:
        return str(x)

    assert HOOK(plain) is plain
