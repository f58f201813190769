"""C code of a model gives the outputs of the simulator, for every effect and rule of integration."""

import ctypes
import dataclasses
import importlib.util
import shutil
import subprocess
import sys
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rotflex_jax.effects import (
    CATALOG,
    Actuation,
    Coulomb,
    CubicSpring,
    Delay,
    Force,
    Lag,
    LuGre,
    Motor,
    PeriodicDisturbance,
    Stribeck,
)
from rotflex_jax.errors import InputError
from rotflex_jax.export import to_c
from rotflex_jax.joints import paper, servo as hobby_servo
from rotflex_jax.mechanism import Exponential, Mechanism, SmoothRK4, simulate
from rotflex_jax.mechanism.quantity import Units
from rotflex_jax.models.model import Model
from rotflex_jax.parameters import parameter

Ts, N = 0.002, 5000
gcc = shutil.which("gcc") or shutil.which("cc")
needs_compiler = pytest.mark.skipif(gcc is None, reason="no C compiler on this machine")


@dataclasses.dataclass(frozen=True)
class MagneticBrake(Force):
    """A user's own effect, never registered."""

    name: ClassVar[str] = "magnetic_brake"
    title: ClassVar[str] = "magnetic brake"
    equation: ClassVar[str] = "tau = -coefficient * speed / (1 + (speed / knee)**2)"

    coefficient: float = parameter(0.01, unit="N m s/rad", lower=0.0)
    knee: float = parameter(2.0, unit="rad/s", lower=1e-3)

    def force(self, position, speed, voltage):
        return -self.coefficient * speed / (1 + (speed / self.knee) ** 2)


@dataclasses.dataclass(frozen=True)
class LateMean(Actuation):
    """A user's own effect on the input: the mean of the last three commands, zero before the first."""

    name: ClassVar[str] = "late_mean"
    title: ClassVar[str] = "moving mean"
    equation: ClassVar[str] = "v = mean of three"

    share: float = parameter(1.0, unit="")

    def drive(self, voltage, Ts):
        before = jnp.concatenate([jnp.zeros(2), voltage])
        mean = (before[2:] + before[1:-1] + before[:-2]) / 3
        return voltage + self.share * (mean - voltage)


@dataclasses.dataclass(frozen=True)
class LooksAhead(Actuation):
    name: ClassVar[str] = "looks_ahead"
    title: ClassVar[str] = "clairvoyance"
    equation: ClassVar[str] = "v(t) = u(t + Ts)"

    def drive(self, voltage, Ts):
        return jnp.concatenate([voltage[1:], voltage[-1:]])


@dataclasses.dataclass(frozen=True)
class Iterates(Force):
    name: ClassVar[str] = "iterates"
    title: ClassVar[str] = "torque by iteration"
    equation: ClassVar[str] = "tau = cos(tau + position)"

    def force(self, position, speed, voltage):
        return 0 * jax.lax.while_loop(lambda t: jnp.all(t < 9), lambda t: t + 1 + speed**2, position)


def command() -> np.ndarray:
    """Ten seconds of input: slow, fast, constant, and beyond the 5 V of `Saturation`."""
    rng = np.random.default_rng(3)
    t = Ts * np.arange(N)
    u = 3 * np.sin(3.1 * t) + 2 * np.sin(19 * t + 1) + 0.5 * rng.normal(size=N)
    u[1500:1900] = 0.0
    return u + 1.0


def sized(cls, at: str):
    """An effect without an amplitude at zero, so that it acts."""
    other = {
        n: s.typical for n, s in cls.declared().items() if n in cls.amplitudes and not getattr(cls, n, None)
    }
    return cls(at=at, **other)


def models() -> dict[str, Model]:
    """Models with every effect of the catalogue, several at a time, and with every rule of integration."""
    start = paper(hub_damping=0.01, inductance=2e-4)
    present = {"inertia", "spring", "motor", "viscous"}
    # A machine has one gear. Disturbances need the phase or the signal of a recording, which C code lacks.
    loop, disturbances = (
        {"pid_servo", "current_meter", "duty_meter"},
        {"periodic_disturbance", "measured_disturbance"},
    )
    todo = sorted(set(CATALOG) - present - loop - {"elastic_backlash"} - disturbances)
    found = {}
    for k in range(4):
        m = start if k % 2 else paper()
        for name in todo[k::4]:
            cls = CATALOG[name]
            places = [p for p in cls.searched if p in (*m.port_vectors, *m.channels, "input")]
            m = m + sized(cls, places[-1] if places else "input" if issubclass(cls, Actuation) else "hub")
        found[f"catalogue {k}"] = Model(m)
    full = hobby_servo("xl330", 0.007, integral=100, weight=0.4, sensors="theta+current+duty")
    found["a servo with its readings"] = Model(full)
    found["elastic teeth"] = Model(start + CATALOG["elastic_backlash"]("hub") + Coulomb("hub"))
    assert {e.name for m in found.values() for e in m.mechanism.effects} == {*CATALOG} - disturbances
    dry = paper() + Coulomb("hub", level=0.03) + Coulomb("joint", level=0.01) + Stribeck("arm")
    found["three contacts, two steps a sample"] = Model(dry, Exponential(substeps=2))
    found["fourth order"] = Model(paper() + CubicSpring("joint", stiffness=9.0), Exponential(order=4))
    found["Runge-Kutta"] = Model(paper() + Coulomb("hub", level=0.02), SmoothRK4(substeps=4))
    found["own effects"] = Model(paper() + MagneticBrake("arm") + LateMean() + Delay(time=0.0131) + Lag())
    found["switched off"] = Model(paper() + Coulomb("hub") + LuGre("hub"), gates=(*[1.0] * 6, 0.0, 1.0))
    found["other machine"] = Model(
        Mechanism(
            ("x",),
            {"axis": (1.0,)},
            [
                CATALOG["inertia"]("axis", inertia=3.0),
                Motor("axis", torque_constant=8.0, back_emf=0.0, gear_ratio=1.0),
            ],
            {"v": ("axis", "speed")},
            units=Units("m", "N"),
        )
    )
    return found


@pytest.fixture(scope="module")
def source():
    """All models as C code, each with a function that this test calls."""
    text = []
    for k, model in enumerate(models().values()):
        C = len(model.mechanism.channels)
        text.append(to_c(model, Ts, prefix=f"m{k}"))
        text.append(
            f"void run{k}(const double *x0, const double *u, double *y, int n)\n"
            f"{{ m{k}_state s; m{k}_init(&s); s.x[0] = x0[0];\n"
            f"  for (int i = 0; i < n; i++) m{k}_step(&s, u[i], y + {C} * i); }}\n"
        )
    return "\n".join(text)


@pytest.fixture(scope="module")
def library(source, tmp_path_factory):
    """All models, compiled with warnings as errors."""
    folder = tmp_path_factory.mktemp("c")
    (folder / "all.c").write_text(source)
    flags = ["-std=c99", "-pedantic", "-Wall", "-Wextra", "-Werror", "-O1", "-shared", "-fPIC"]
    assert gcc is not None
    subprocess.run([gcc, *flags, "all.c", "-o", "all.so", "-lm"], cwd=folder, check=True)
    return ctypes.CDLL(str(folder / "all.so"))


def run(library, k: int, u: np.ndarray, channels: int, first: float = 0.0) -> np.ndarray:
    y, x0, u = np.zeros((len(u), channels)), np.array([first]), np.ascontiguousarray(u)
    pointers = [a.ctypes.data_as(ctypes.c_void_p) for a in (x0, u, y)]
    getattr(library, f"run{k}")(*pointers, len(u))
    return y


@needs_compiler
@pytest.mark.parametrize("name", list(models()))
def test_c_code_equals_the_simulator(library, name):
    k, model = list(models()).index(name), models()[name]
    u, kept = command(), model.mechanism
    if model.gates is not None:
        kept = kept.without("coulomb", "hub")
    y = run(library, k, u, len(kept.channels), first=0.3)
    expected = simulate(kept, u, Ts, x0=np.array([0.3]), solver=model.solver)
    assert np.ptp(expected, axis=0).min() > 0.05  # it moves
    np.testing.assert_allclose(y, expected, rtol=0, atol=1e-10 * np.abs(expected).max())


ALLOCATIONS = {"malloc", "calloc", "realloc", "free", "alloca", "aligned_alloc"}


def cross_compiler() -> tuple[list[str], str]:
    """A 32-bit compiler, of GNU or of the package ziglang, and a program that lists symbols."""
    if arm := shutil.which("arm-none-eabi-gcc"):
        return [arm, "-mcpu=cortex-m4", "-mthumb"], "arm-none-eabi-nm"
    if importlib.util.find_spec("ziglang") and (nm := shutil.which("nm")):
        return [sys.executable, "-m", "ziglang", "cc", "-target", "arm-linux-musleabi"], nm
    pytest.skip("neither arm-none-eabi-gcc nor the package ziglang on this machine")


def undefined_names(source: str, compiler: list[str], nm: str, folder) -> set[str]:
    """Undefined symbols in the object code of all models."""
    (folder / "all.c").write_text(source)
    strict = ["-std=c99", "-pedantic", "-Wall", "-Wextra", "-Werror", "-Os", "-c", "all.c", "-o", "all.o"]
    subprocess.run([*compiler, *strict], cwd=folder, check=True)
    done = subprocess.run([nm, "-u", "all.o"], cwd=folder, check=True, capture_output=True, text=True)
    return {line.split()[-1].lstrip("_") for line in done.stdout.splitlines() if line.strip()}


@needs_compiler
def test_allocates_nothing(source, tmp_path):
    assert gcc is not None
    names = undefined_names(source, [gcc], "nm", tmp_path)
    assert {"exp", "tanh"} <= names and not names & ALLOCATIONS


def test_compiles_for_a_microcontroller_of_32_bits_without_allocation(source, tmp_path):
    names = undefined_names(source, *cross_compiler(), tmp_path)
    assert {"exp", "tanh", "aeabi_dadd"} <= names and not names & ALLOCATIONS


def test_says_which_effect_it_cannot_write():
    with pytest.raises(InputError, match=r"^torque by iteration at hub \(Iterates\) cannot .* 'while'"):
        to_c(Model(paper() + CubicSpring("joint") + Iterates("hub")), Ts)
    with pytest.raises(InputError, match=r"^clairvoyance at input \(LooksAhead\) cannot be written as C"):
        to_c(Model(paper() + Coulomb("hub") + LooksAhead()), Ts)
    with pytest.raises(
        InputError, match=r"^periodic disturbance at input .* cannot .* the time since the start"
    ):
        to_c(Model(paper() + PeriodicDisturbance(sine=0.1)), Ts)


@pytest.mark.parametrize("period", [0.0, -1.0, float("nan"), float("inf")])
def test_refuses_a_sampling_period_that_is_none(period):
    with pytest.raises(InputError, match="`Ts` must be a finite number above 0"):
        to_c(Model(paper()), period)


def test_refuses_a_prefix_that_begins_no_name():
    with pytest.raises(InputError, match="begins no name in C"):
        to_c(Model(paper()), Ts, prefix="2fast; int")


@pytest.mark.parametrize("between", ["smooth", "switched"])
def test_c_code_takes_a_voltage_that_is_held(between):
    with pytest.raises(InputError, match=f"{between} between samples"):
        to_c(Model(paper(), Exponential(between=between)), Ts=0.002)
