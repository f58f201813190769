# ---
# jupyter:
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # Which effect is my model missing?
#
# You have a recording of a rotary flexible joint and a textbook model that does not quite follow
# it. This notebook makes each step by hand once: compare, see where the model fails, add an effect,
# compare again. At the end `rf.discover` does the same in one call.
#
# The recording comes with the package. It is simulated, with two effects hidden in it, so that the
# answer can be checked. To use your own, replace one line: `rf.load("run.csv")`.

# %%
import json
from importlib.resources import files

import matplotlib.pyplot as plt
import numpy as np

import rotflex_jax as rf
from rotflex_jax.discover.localise import missing_acceleration
from rotflex_jax.report import figures

# Models run in double precision by themselves, and nothing depends on chance: runs repeat exactly.
plt.rcParams.update(
    {"figure.dpi": 80, "figure.constrained_layout.use": True, "axes.grid": True, "grid.alpha": 0.3}
)
GREY, RED, AMBER, BLUE = "#9aa5b1", "#c8452f", "#d98e04", "#0f6f86"

# %% [markdown]
# ## The data
#
# The input is the voltage. The outputs are the angle of the hub (theta) and the deflection of the arm
# (alpha). Models are fitted to the first 70 % and evaluated on the rest, to which nothing is fitted.

# %%
recording = rf.data.demo_recording()
train, test = recording.split(0.7)
print(recording)
for finding in recording.findings:
    print("-", finding)

fig, axes = plt.subplots(3, 1, figsize=(10, 5), sharex=True)
signals = {
    "voltage [V]": recording.u,
    "theta [deg]": np.rad2deg(recording.channel("theta")),
    "alpha [deg]": np.rad2deg(recording.channel("alpha")),
}
for ax, (label, values) in zip(axes, signals.items(), strict=True):
    ax.plot(recording.t, values, color="#1f2933", lw=0.7)
    ax.axvspan(test.start, recording.duration, color="#f3efe2")
    ax.set_ylabel(label)
axes[0].set_title("shaded: held out", loc="left")
axes[-1].set_xlabel("time [s]")
axes[-1].set_xlim(0, recording.duration)
plt.show()

# %% [markdown]
# Both encoders count in steps. No model can follow such a sensor more closely than its rounding,
# step / √12: no error below can be smaller than that.

# %%
rounding = {channel: step / np.sqrt(12) for channel, step in recording.resolution.items()}
for channel, value in rounding.items():
    print(f"{channel}: {np.rad2deg(value):.3f} deg rms")

# %% [markdown]
# ## Compare
#
# `rf.joints.paper()` is the textbook joint: two inertias, a linear spring, a motor, viscous
# damping. It is fitted, and then simulated over the held-out part in a free run: it gets the voltage and
# the first 0.2 s of the angles, and nothing else.

# %%
textbook = rf.fit(rf.joints.paper(), train)
print(textbook)


# %%
def show_run(fit, colour):
    """Measured against simulated on the held-out data, and the difference."""
    y_hat = fit.model.simulate(test)
    fig, axes = plt.subplots(2, 2, figsize=(10, 4.4), sharex=True, height_ratios=(1.6, 1))
    for c, channel in enumerate(test.channels):
        above, below = axes[:, c]
        above.plot(test.t, np.rad2deg(test.y[:, c]), color=GREY, lw=4, label="measured")
        above.plot(test.t, np.rad2deg(y_hat[:, c]), color=colour, lw=1, label="simulated")
        below.plot(test.t, np.rad2deg(test.y[:, c] - y_hat[:, c]), color=colour, lw=0.8)
        above.set_ylabel(f"{channel} [deg]")
        below.set(ylabel="error [deg]", xlabel="time [s]", xlim=(test.t[0], test.t[-1]))
    fig.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside upper left", ncols=2)
    plt.show()


show_run(textbook, RED)

# %% [markdown]
# The curves look alike, but the errors are more than ten times the rounding, and they are
# smooth: this is not noise.
#
# ## Where does it fail?
#
# `rf.locate` finds times, frequencies, speeds, deflections and moments after a reversal that
# hold more than their share of the error, and keeps what chance does not explain. It is given the
# training data here, so that the held-out part is used for the comparison only. Free runs start again
# every two seconds, so that earlier errors do not accumulate.


# %%
def look(fit):
    """Where the model fails in the training data, in sentences."""
    error = train.y - fit.model.simulate_windows(train, seconds=2.0)
    places = rf.locate(train, error, train.channels, rounding, fit.model.mechanism, window_seconds=2.0)
    for place in places:
        print("-", place.statement)
    return places


first_look = look(textbook)

# %% [markdown]
# The first lines name the deflection: a large share of the error arises in the short time in which
# the spring is far from its middle. To see its shape, average what the model *lacks*, the
# acceleration of its error, over intervals of the deflection and of the hub speed.


# %%
def show_missing(fit, colour):
    """Mean acceleration that the model lacks, against deflection and hub speed."""
    y_hat = fit.model.simulate_windows(train, seconds=2.0)
    restarts = range(0, train.N, round(2.0 / train.Ts))
    against = {
        "deflection alpha [deg]": ("alpha", 7.5, np.rad2deg(train.channel("alpha"))),
        "speed of the hub, simulated [deg/s]": ("theta", 2.2, np.rad2deg(np.gradient(y_hat[:, 0], train.Ts))),
    }
    axes = plt.subplots(1, 2, figsize=(10, 3.2))[1]
    for ax, (label, (channel, reach, x)) in zip(axes, against.items(), strict=True):
        error = train.channel(channel) - y_hat[:, train.channels.index(channel)]
        lacks, seen = missing_acceleration(error, train, restarts)
        edges = np.linspace(-1, 1, 16) * np.quantile(np.abs(x), 0.98)
        count = np.histogram(x[seen], edges)[0]
        mean = np.histogram(x[seen], edges, weights=lacks[seen])[0] / count
        ax.axhline(0, color="#1f2933", lw=0.8)
        ax.plot((edges[1:] + edges[:-1]) / 2, mean, "o-", color=colour)
        ax.set(xlabel=label, ylabel=f"missing in {channel} [rad/s²]", ylim=(-reach, reach))
    plt.show()


show_missing(textbook, RED)

# %% [markdown]
# Left: far from its middle the real arm is pulled back by more than the torque of the linear spring. In
# between the curve bends the other way, because the fit has made the linear spring stiffer to compensate.
# Right: a step where the hub changes direction. The deflection comes first.
#
# ## Which effect?
#
# Add a candidate with `+`, fit again, compare. Two candidates, one at a time: a hardening spring, and a dead
# zone of the amplifier, which would hold the hub back as friction does.

# %%
suspects = {
    "cubic spring at joint": rf.effects.CubicSpring(at="joint"),
    "dead zone at input": rf.effects.DeadZone(at="input"),
}
fits = {"textbook": textbook}
fits |= {f"+ {name}": rf.fit(textbook.model + e, train) for name, e in suspects.items()}


def held_out(fit):
    """Error of the free run on the held-out data, by channel."""
    return rf.metrics.rmse(test, fit.model.simulate(test))


def show_errors(fits):
    """Errors of free runs, training and held-out."""
    lines = [f"{'rms error [deg]':26}{'training':>16}  {'held out':>16}"]
    lines += [f"{'':26}" + "  ".join(2 * [f"{'theta':>8}{'alpha':>8}"])]
    for name, fit in fits.items():
        a, b, c, d = np.rad2deg((*fit.noise.values(), *held_out(fit).values()))
        lines += [f"{name:26}{a:8.3f}{b:8.3f}  {c:8.3f}{d:8.3f}"]
    print("\n".join(lines))


show_errors(fits)

# %% [markdown]
# - The **cubic spring** removes more than half of the error of alpha, and little of the error of theta. So
#   two effects may be missing.
# - The **dead zone** is a warning: it removes more than a third of the *training* error of theta, and
#   more than doubles the held-out error. It imitates friction on the data to which it was fitted, and only
#   there.
#
# Both results point to the spring. Keep it, and look at the errors again.

# %%
spring = fits["+ cubic spring at joint"]
second_look = look(spring)
show_missing(spring, AMBER)

# %% [markdown]
# The deflection is no longer in the list. What is left arises just after the hub reverses. Over the hub
# speed (right; little is left over the deflection) it has the shape of dry friction: it jumps at standstill
# and opposes the motion. The slope beyond the jump is again a parameter that the fit has changed to
# compensate, here the viscous damping. So add Coulomb friction.

# %%
both = rf.fit(spring.model + rf.effects.Coulomb(at="hub"), train)
third_look = look(both)
show_run(both, BLUE)

# %% [markdown]
# ## Did the error reach the sensor?

# %%
steps = {"textbook": textbook, "+ cubic spring\nat joint": spring, "+ coulomb\nat hub": both}
errors = [held_out(fit) for fit in steps.values()]

fig, axes = plt.subplots(1, 2, figsize=(10, 3.2), sharey=True)
for ax, channel in zip(axes, test.channels, strict=True):
    values = np.rad2deg([e[channel] for e in errors])
    ax.semilogy(list(steps), values, color=GREY, zorder=1)
    ax.scatter(list(steps), values, 70, c=[RED, AMBER, BLUE], zorder=2)
    floor = np.rad2deg(rounding[channel])
    ax.axhline(floor, color="#5b6570", ls="--", label="rounding of the encoder")
    for k, value in enumerate(values):
        ax.annotate(f"{value:.3f}", (k, value), (8, 5), textcoords="offset points")
    ax.set_yticks(ticks := (0.03, 0.1, 0.3, 1.0), [f"{tick:g}" for tick in ticks])
    ax.minorticks_off()
    ax.set_title(channel, loc="left")
    ax.margins(x=0.2)
    ax.set_ylim(0.02, 1.2)
axes[0].set_ylabel("held-out rms error [deg]")
axes[1].legend(loc="upper right")
plt.show()

# %% [markdown]
# Nearly: the last error is a little above the rounding of the encoder, and `rf.locate` finds no
# pattern in it. What is left is noise: besides rounding, this encoder has a small jitter.
#
# ## The same in one call
#
# `rf.discover` starts from the textbook model again. It scores all candidates at once, refits the
# best, decides on the held-out data, and repeats; then it checks that each effect is needed.
# `progress=print` shows what it is doing. Here it gets a dozen candidates and two rounds, to keep this
# notebook short. Without both arguments it tries the whole catalogue wherever an effect makes sense, until
# nothing more is gained, as in [this notebook](06_which_effect.ipynb).

# %%
fx = rf.effects
candidates = [
    *[(fx.Coulomb, "hub"), (fx.CoulombAsymmetric, "hub"), (fx.Stribeck, "hub"), (fx.QuadraticDrag, "hub")],
    *[(fx.Coulomb, "joint"), (fx.CubicSpring, "joint"), (fx.QuadraticSpring, "joint")],
    *[(fx.Coulomb, "arm"), (fx.QuadraticDrag, "arm")],
    *[(fx.DeadZone, "input"), (fx.Saturation, "input"), (fx.Delay, "input")],
]
result = rf.discover(rf.joints.paper(), train, test, candidates=candidates, rounds=2)
print(result.verdict)
print(result)

# %% [markdown]
# The ranking shows how much likelier the data would be with each effect, before any was added, in nats
# (units of log-likelihood: ten are strong evidence). It is a first estimate, made without a refit. Laws that
# contain Coulomb friction as a special case stand beside it; their further parameters gained nothing.

# %%
figures.ranking(result)

# %% [markdown]
# ## Is it true?
#
# Here it can be checked, since the recording was simulated. The column of the textbook fit shows the second
# consequence of missing physics: not only are its errors large, two of its **parameters are far off, and
# their intervals do not contain the true values**. The fit has put the missing friction into the damping of
# the hub, and the hardening into the stiffness.

# %%
truth = json.loads((files("rotflex_jax.data") / "demo_truth.json").read_text())
hidden = {e["effect"]: next(iter(e["parameters"].values())) for e in truth["effects"]}
true_values = {
    "hub.inertia.inertia": truth["plant"]["J_hub"],
    "joint.spring.stiffness": truth["plant"]["K"],
    "hub.motor.torque_constant": truth["plant"]["k_t"],
    "hub.viscous.coefficient": truth["plant"]["B_hub"],
    "joint.viscous.coefficient": truth["plant"]["B_joint"],
    "hub.coulomb.level": hidden["coulomb"],
    "joint.cubic_spring.stiffness": hidden["cubic_spring"],
}
before = {e.name: e for e in textbook.parameters}
after = {e.name: e for e in result.final.estimates}


def with_interval(estimate):
    """Value and 95 % interval."""
    if estimate is None:
        return "-"
    low, high = estimate.ci95
    return f"{estimate.value:.4g} [{low:.4g}, {high:.4g}]"


print(f"{'':30}{'true':>9}  {'textbook fit':30}{'after discovery':30}unit")
for name, value in true_values.items():
    columns = (with_interval(before.get(name)), with_interval(after[name]))
    print(f"{name:30}{value:9.4g}  {columns[0]:30}{columns[1]:30}{after[name].unit}")

# %% [markdown]
# Everything, with more figures, goes into one HTML page that you can send to a colleague:

# %%
print(result.report("rotflex-report").as_posix())

# %% [markdown]
# ## What to expect of your own recording
#
# - The errors of a real machine rarely end at the noise. The verdict is then `unexplained`, and the report
#   still shows where the remaining error lies.
# - `ambiguous` names effects between which your recording cannot decide; `not_excited` names those that it
#   could not have shown. Another experiment helps, another algorithm does not.
# - The held-out part has helped to choose the effects, so its errors are not unbiased any more. Where the
#   error falls tenfold this does not matter; where the decision is close, record again.
# - All torques are relative to one trusted constant, here the arm's inertia: if it is 10 % off, so are
#   stiffness and friction.
#
# The last cell checks what the text says.

# %%
start, end = errors[0], errors[-1]
for channel in test.channels:
    assert start[channel] > 10 * rounding[channel]  # more than ten times the rounding
    assert end[channel] < start[channel] / 10  # and it fell to a little above it
    assert end[channel] < 1.5 * rounding[channel]
assert first_look[0].kind == "deflection"
assert {p.kind for p in second_look} & {"reversal", "speed"}
assert "deflection" not in {p.kind for p in second_look}
assert third_look[0].statement.startswith("The error is spread evenly")

alone = {name: held_out(fit) for name, fit in fits.items()}
assert alone["+ cubic spring at joint"]["alpha"] < 0.45 * start["alpha"]
dead_zone = "+ dead zone at input"
assert fits[dead_zone].noise["theta"] < 0.65 * textbook.noise["theta"]
assert alone[dead_zone]["theta"] > 2 * start["theta"]

assert result.verdict == "found"
found = {(r.effect, r.port) for r in result.rounds}
assert found == {("coulomb", "hub"), ("cubic_spring", "joint")}
for channel in test.channels:
    assert abs(result.final.held_out_rmse[channel] / end[channel] - 1) < 0.05
for name, value in true_values.items():
    assert abs(after[name].value / value - 1) < 0.02  # every parameter is right
    assert abs(after[name].value / both[name].value - 1) < 0.02  # by hand as well
for name in ("joint.spring.stiffness", "hub.viscous.coefficient"):
    assert before[name].ci95[0] > true_values[name]  # the textbook's interval misses the truth
print("All claims hold.")
