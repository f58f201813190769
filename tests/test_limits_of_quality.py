"""Each limit of the checks of a recording, from both sides."""

import numpy as np
import pytest

from rotflex_jax.errors import InputError
from rotflex_jax.recording import Recording
from rotflex_jax.recording.samples import even_spacing

N, TS = 2000, 0.01
K = np.arange(N)
RNG = np.random.default_rng(5)
U = RNG.normal(size=N)
U /= np.max(np.abs(U))
WAVE = np.sin(K / 40) + 1e-3 * RNG.normal(size=N)
WAVE /= np.max(np.abs(WAVE))


def kinds(*, u: np.ndarray = U, theta: np.ndarray = WAVE, alpha: np.ndarray = 0.1 * WAVE[::-1]) -> set[str]:
    y = np.column_stack([theta, alpha])
    return {f"{f.kind} {f.channel}" for f in Recording(u=u, y=y, Ts=TS).findings if f.severity != "note"}


@pytest.mark.parametrize(("share", "found"), [(0.999, False), (1.001, True)])
def test_input_beyond_a_hundred_volts_looks_like_millivolts(share: float, found: bool) -> None:
    assert ("units voltage" in kinds(u=100 * share * U)) == found


@pytest.mark.parametrize(("share", "found"), [(0.999, False), (1.001, True)])
def test_deflection_beyond_half_a_turn_looks_like_degrees(share: float, found: bool) -> None:
    assert ("units alpha" in kinds(alpha=np.pi * share * WAVE[::-1])) == found


@pytest.mark.parametrize(
    "volts", [1.0, 10.0]
)  # below and above the voltage at which the limit begins to grow
@pytest.mark.parametrize(("share", "found"), [(0.999, False), (1.001, True)])
def test_speed_per_volt_that_no_servo_reaches_looks_like_degrees(
    volts: float, share: float, found: bool
) -> None:
    speed = np.max(np.abs(WAVE[2:] - WAVE[:-2])) / (2 * TS)  # over 20 ms
    limit = max(60.0, 15.0 * volts)
    assert ("units theta" in kinds(u=volts * U, theta=share * limit / speed * WAVE)) == found


@pytest.mark.parametrize(
    ("late", "said"), [(0.0099, None), (0.0101, "jittery"), (0.499, "jittery"), (0.501, "gap of")]
)
def test_times_are_even_to_a_hundredth(late: float, said: str | None) -> None:
    t = TS * np.arange(100.0)
    t[50:] += late * TS
    if said is None:
        assert even_spacing(t, "Time") == pytest.approx(TS, rel=2e-4)
        return
    with pytest.raises(InputError, match=said):
        even_spacing(t, "Time")


@pytest.mark.parametrize(("volts", "accepted"), [(0.0, False), (1e-13, False), (1e-11, True)])
def test_input_is_constant_below_a_trillionth(volts: float, accepted: bool) -> None:
    u = 1.0 + volts * np.where(K % 2, 0.5, -0.5)
    if accepted:
        assert kinds(u=u) is not None
        return
    with pytest.raises(InputError, match="throughout"):
        kinds(u=u)
