"""Limits of the checks of a recording from both sides; an absolute arm angle is told from a deflection."""

from collections.abc import Callable

import numpy as np
import pytest
from scipy.signal import StateSpace, lsim

import rotflex_jax as rf
from rotflex_jax.arena.simulator.records import INPUTS, make_record
from rotflex_jax.errors import InputError
from rotflex_jax.recording import Recording
from rotflex_jax.recording.quality import is_absolute
from rotflex_jax.recording.samples import even_spacing

# Effects that could look like it: they hold the arm, pull it, bend an angle, or act while nothing moves.
HIDDEN = [
    (("coulomb", "arm"), "steps"),
    (("gravity", "arm"), "sweep"),
    (("joint_play", "joint"), "noise"),
    (("sensor_gain", "theta"), "prbs"),
    (("second_mode", "arm"), "multisine"),
]


def warned(recording: rf.Recording) -> bool:
    return any(f.kind == "absolute" and f.severity == "warning" for f in recording.findings)


@pytest.mark.parametrize(("place", "kind"), [*HIDDEN, *((None, kind) for kind in INPUTS)])
def test_the_angle_in_the_room_is_told_from_a_deflection(place, kind) -> None:
    made = make_record([place] if place else [], kind=kind, seed=113, seconds=8.0, fs=250.0)
    theta, alpha = made["y"].T
    room = theta + alpha
    for arm, absolute in ((alpha, False), (-alpha, False), (room, True), (room - 0.7, True)):
        r = rf.Recording(u=made["u"], y=np.column_stack([theta, arm]), Ts=made["Ts"])
        assert warned(r) == absolute
        # Parts of the recording are no reason to doubt a deflection either.
        assert not any(warned(r.slice(k, k + 250)) for k in range(0, 1750, 250)) or absolute


def deflection(theta: np.ndarray, t: np.ndarray, hertz: float, damping: float) -> np.ndarray:
    """The deflection of an arm on a spring whose hub is moved as given: a'' + 2 d w a' + w^2 a = -theta''."""
    w = 2 * np.pi * hertz
    system = StateSpace([[0, 1], [-(w**2), -2 * damping * w]], [[0], [1]], [[1, 0]], [[0]])
    return lsim(system, -np.gradient(np.gradient(theta, t), t), t)[1]


@pytest.mark.parametrize("hertz", [0.3, 1.0, 3.0, 10.0])
def test_no_motion_of_the_hub_makes_a_deflection_look_so(hertz: float) -> None:
    """Sines where the deflection is as large as theta, drifts, steps, noise: on soft and on stiff springs."""
    t = np.arange(0, 10, 0.004)
    rng = np.random.default_rng(7)
    equal = np.sin(2 * np.pi * hertz / np.sqrt(2) * t)
    motions: list[Callable[[], np.ndarray]] = [
        lambda: equal,
        lambda: equal + 0.3 * t,
        lambda: equal + 0.2 * np.sin(2 * np.pi * 0.13 * t),
        lambda: np.tanh(20 * np.sin(2 * np.pi * 0.4 * t)),
        lambda: np.cumsum(rng.standard_normal(len(t))) * 0.02,
        lambda: np.convolve(rng.standard_normal(len(t)), np.blackman(80), mode="same"),
    ]
    for motion in motions:
        theta = motion()
        alpha = deflection(theta, t, hertz, 0.03)
        assert not is_absolute(theta, alpha)
        for start in range(0, len(t) - 500, 500):
            assert not is_absolute(theta[start : start + 500], alpha[start : start + 500])


def test_measured_joints_raise_no_doubt(measured) -> None:
    for r in [*measured("rotflex"), *measured("rotary_arm")[:1]]:
        assert not warned(r)
    for r in measured("rotflex"):
        theta, alpha = r.y.T
        assert warned(rf.Recording(u=r.u, y=np.column_stack([theta, theta + alpha]), Ts=r.Ts))


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
