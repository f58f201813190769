# ---
# jupyter:
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # Does this work for my machine, and for an effect of my own?
#
# The toolkit is not limited to flexible joints. This notebook describes another machine in a few lines, adds
# an effect that the catalogue lacks, and searches for what is missing with `rf.discover`.
#
# The machine: a motor turns a platter through a belt. An encoder sits on the motor. The platter has only
# a tacho behind a rectifier, which reads the speed without its sign; no sensor shows the platter's angle.

# %%
import dataclasses
from typing import ClassVar

import matplotlib.pyplot as plt

import rotflex_jax as rf
from rotflex_jax import effects as fx
from rotflex_jax.effects import Force, Inertia, Motor, Rectifier, Spring, Viscous, register
from rotflex_jax.parameters import parameter
from rotflex_jax.report import figures

plt.rcParams.update(
    {"figure.dpi": 80, "figure.constrained_layout.use": True, "axes.grid": True, "grid.alpha": 0.3}
)
GREY, RED, BLUE = "#9aa5b1", "#c8452f", "#0f6f86"

# %% [markdown]
# ## The machine
#
# Two coordinates: the angles of motor and platter. A port is a place where a torque can act: the motor, the
# platter, and the belt, whose position is the difference of the two angles. Everything else is an effect at a
# port. The values are from data sheets, up to a quarter off. Those of the motor and of the rectifier are
# trusted, since voltage and angles determine torques only up to one common factor.

# %%
motor = Motor(at="motor", torque_constant=0.03, back_emf=0.03, resistance=2.0, gear_ratio=5.0)
turntable = rf.Mechanism(
    coordinates=["phi", "psi"],
    ports={"motor": (1, 0), "belt": (-1, 1), "platter": (0, 1)},
    effects=[
        *[motor, Inertia(at="motor", inertia=0.0025), Viscous(at="motor")],
        *[Spring(at="belt", stiffness=5.0), Viscous(at="belt")],
        *[Inertia(at="platter", inertia=0.005), Viscous(at="platter")],
        Rectifier(at="tacho", loss=2.0),  # of negative speeds twice their size is lost: it reads |speed|
    ],
    outputs={"encoder": "motor", "tacho": ("platter", "speed")},
    trusted=["tacho.rectifier.loss", *(f"motor.motor.{name}" for name in motor.values)],
)
print(turntable)

# %% [markdown]
# ## The recording
#
# Twelve seconds. The file was written by a simulator that shares nothing with the toolkit, with two
# effects hidden at the platter. The tacho reads a speed, so its unit is given; the encoder is in radians.

# %%
recording = rf.load(
    "turntable.csv", outputs={"encoder": "encoder", "tacho": "tacho"}, units={"tacho": "rad/s"}
)
train, test = recording.split(0.7)
print(recording)

fig, axes = plt.subplots(3, 1, figsize=(10, 4.6), sharex=True)
for ax, label, values in zip(
    axes,
    ("voltage [V]", "encoder [rad]", "tacho [rad/s]"),
    (recording.u, *recording.y.T),
    strict=True,
):
    ax.plot(recording.t, values, color="#1f2933", lw=0.8)
    ax.axvspan(test.start, recording.duration, color="#f3efe2")
    ax.set_ylabel(label)
axes[0].set_title("shaded: held out", loc="left")
axes[-1].set(xlabel="time [s]", xlim=(0, recording.duration))
plt.show()

# %% [markdown]
# ## An effect of my own
#
# Suppose that the platter has a magnetic brake: its torque grows with the speed, reaches its
# largest value at a certain speed, and falls beyond. The catalogue has no such effect. An effect is a small
# class; `@register` puts it into the catalogue, and from then on the search tries it like any other.
#
# `searched` says where, in the words of the flexible joint: at a port with a motor (`hub`), with a spring
# (`joint`), or with neither (`arm`). On this machine these are motor, belt and platter.
# `probes` gives the values with which a first test should try it, relative to the signals at its port.


# %%
@register
@dataclasses.dataclass(frozen=True)
class MagneticBrake(Force):
    """tau = -coefficient speed / (1 + (speed / knee)^2)"""

    name: ClassVar[str] = "magnetic_brake"
    title: ClassVar[str] = "magnetic brake"
    equation: ClassVar[str] = "tau = -coefficient * speed / (1 + (speed / knee)**2)"
    amplitudes: ClassVar[tuple[str, ...]] = ("coefficient",)  # at zero the effect is absent
    searched: ClassVar[tuple[str, ...]] = ("hub", "arm")

    coefficient: float = parameter(0.01, unit="N m s/rad", lower=0.0, meaning="torque per slow speed")
    knee: float = parameter(5.0, unit="rad/s", lower=1e-2, meaning="speed of the largest torque")

    def force(self, position, speed, voltage):
        return -self.coefficient * speed / (1 + (speed / self.knee) ** 2)

    @classmethod
    def probes(cls, scale):
        size = 0.1 * scale.torque / scale.speed
        return [[{"coefficient": size, "knee": k * scale.speed}] for k in (0.5, 1.0, 2.0)]


# %% [markdown]
# ## What is missing?
#
# The call is the same as for a joint. Here it gets ten candidates and two rounds, to keep this notebook
# short. Without both arguments the search tries the whole catalogue, the new effect included, at every port
# where it makes sense, until nothing more is gained.

# %%
laws = (fx.Coulomb, fx.Stribeck, fx.QuadraticDrag, MagneticBrake)
candidates = [(law, port) for law in laws for port in ("motor", "platter")]
candidates += [(fx.CubicSpring, "belt"), (fx.Delay, "input")]
result = rf.discover(turntable, train, test, candidates=candidates, rounds=2)
print(result.verdict)
print(result)

# %%
figures.ranking(result)

# %% [markdown]
# The free run over the held-out data, before and after. No fit has used them.

# %%
fig, axes = plt.subplots(2, 2, figsize=(10, 4.6), sharex=True, height_ratios=(1.6, 1))
runs = (("as it was", result.baseline, RED), ("after discovery", result.final, BLUE))
for c, (channel, unit) in enumerate(zip(test.channels, test.units, strict=True)):
    above, below = axes[:, c]
    above.plot(test.t, test.y[:, c], color=GREY, lw=2.5, label="measured")
    for (name, stage, colour), style in zip(runs, ("--", "-"), strict=True):
        y_hat = stage.simulated[0][:, c]
        above.plot(test.t, y_hat, color=colour, lw=1, ls=style, label=name)
        below.plot(test.t, test.y[:, c] - y_hat, color=colour, lw=0.8, ls=style)
    above.set_ylabel(f"{channel} [{unit}]")
    below.set(ylabel=f"error [{unit}]", xlabel="time [s]", xlim=(test.t[0], test.t[-1]))
fig.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside upper left", ncols=3)
plt.show()

# %% [markdown]
# ## Is it true?
#
# The file was simulated, so the true values are known.

# %%
truth = {
    "motor.inertia.inertia": 0.002,
    "platter.inertia.inertia": 0.006,
    "belt.spring.stiffness": 6.0,
    "platter.coulomb.level": 0.03,
    "platter.magnetic_brake.coefficient": 0.03,
    "platter.magnetic_brake.knee": 4.0,
}
before = {e.name: e.value for e in result.baseline.estimates}
after = {e.name: e for e in result.final.estimates}
print(f"{'':36}{'true':>8}{'as it was':>11}{'after discovery':>17}")
for name, value in truth.items():
    first = f"{before[name]:.4g}" if name in before else "-"
    print(f"{name:36}{value:8.4g}{first:>11}{after[name].value:17.4g} {after[name].unit}")

# %% [markdown]
# Without the two effects the fit attributes brake and friction to other parameters: see the platter's inertia
# and the belt's stiffness in the column *as it was*.
#
# ## What next?
#
# The model can be saved, written as equations, or given to a controller as C code, the new effect
# included ([docs/export.md](../docs/export.md)):

# %%
print(rf.export.text(result.model).split("\n\n", 2)[2])

# %% [markdown]
# On the command line, with the machine (and the effect) in a file `my_plant.py`:
#
#     rotflex discover turntable.csv --joint my_plant.py:turntable --save-model turntable.json
#     rotflex export turntable.json --with my_plant.py --to c --out turntable.h
#
# The last cell checks what the text says.

# %%
assert result.verdict == "found"
found = {(r.effect, r.port) for r in result.rounds}
assert found == {("coulomb", "platter"), ("magnetic_brake", "platter")}
for name, value in truth.items():
    assert abs(after[name].value / value - 1) < 0.05
for channel in test.channels:
    assert result.final.held_out_rmse[channel] < result.baseline.held_out_rmse[channel] / 5
wrong = [n for n, v in truth.items() if n in before and abs(before[n] / v - 1) > 0.1]
assert {"platter.inertia.inertia", "belt.spring.stiffness"} & set(wrong)
print("All claims hold.")
