# ---
# jupyter:
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # Which method follows the joint best?
#
# Physical models, linear state spaces, Volterra series, adaptive filters and sparse regression are usually
# shown on different data. Here all are fitted to the same samples and evaluated on the same others, in *free
# runs*: they get the voltage and the first 0.2 s of the angles, and nothing else.

# %%
import matplotlib.pyplot as plt
import numpy as np

import rotflex_jax as rf

# %matplotlib inline
plt.rcParams.update({"figure.dpi": 80, "figure.constrained_layout.use": True, "axes.grid": True})

recording = rf.data.demo_recording().split(seconds=10)[0]
recording

# %% [markdown]
# The recording (ten seconds of it) comes with the package; it is simulated, with dry friction at the hub
# and a spring that hardens. Two of the methods are physical: `linear` is the textbook joint, and `grey_box`
# the joint with both effects. `rf.compare(recording)` runs all methods, twenty more than here, and
# [docs/compare.md](../docs/compare.md) shows them on a measured joint.

# %%
joint = rf.joints.paper() + rf.effects.Coulomb(at="hub") + rf.effects.CubicSpring(at="joint")
methods = ["grey_box", "linear", "subspace", "volterra_ls", "laguerre3_ridge", "volterra_lms", "sindy_weak"]
table = rf.compare(recording, methods, mechanism=joint)
table

# %% [markdown]
# ## What does the picture say?

# %%
table.plot()

# %% [markdown]
# ## How does the error grow with time?
#
# The error over the time since the start of the run. It grows where the model is wrong: the hub angle
# accumulates the smallest error of torque.

# %%
fig, axes = plt.subplots(1, 2, figsize=(10, 3.4))
styles = ("-", "--", "-.", ":", (0, (5, 1)), (0, (3, 1, 1, 1)), (0, (1, 1)))
for row, style in zip((r for r in table.rows if r.horizon), styles, strict=False):
    for ax, channel in zip(axes, recording.channels, strict=True):
        error = np.rad2deg(row.horizon.rmse[channel])
        ax.loglog(row.horizon.seconds, error, ls=style, lw=1.6, label=row.method)
for ax, channel in zip(axes, recording.channels, strict=True):
    ax.axhline(np.rad2deg(table.noise_floor[channel]), color="#66727f", lw=0.8)
    ax.set(xlabel="time since the start [s]", ylabel=f"rms error of {channel} [deg]")
fig.legend(*axes[0].get_legend_handles_labels(), loc="outside upper left", ncols=7, fontsize=8)
plt.show()

# %% [markdown]
# - The error of the joint **with the right physics** is at the noise of the sensor and stays there. It has
#   seven fitted parameters, and each has a unit.
# - A **sparse equation of motion** (weak SINDy) has the second smallest error, far below the others: its
#   library contains the sign of a speed and the cube of an angle, which are the two hidden effects.
# - The **textbook joint** follows theta better than every Volterra series, although it lacks two effects: in
#   its equations a voltage causes a torque, and a torque an acceleration.
# - **One step ahead** (columns *1 step*) every method has a small error. At this sampling rate the last
#   sample alone predicts the next one well; such an error says nothing about a model.
#
# The last cell checks what the text says.

# %%
best, linear = table["grey_box"], table["linear"]
assert table.best.method == "grey_box" and best.parameters == 7
for channel in recording.channels:
    assert best.rmse[channel] < 1.6 * table.noise_floor[channel]
    assert linear.rmse[channel] > 10 * table.noise_floor[channel]
assert table.rows[1].method == "sindy_weak"
assert linear.rmse["theta"] < min(r.rmse["theta"] for r in table.rows if r.family in ("series", "adaptive"))
ahead = [row.rmse_one_step["alpha"] / row.rmse["alpha"] for row in table.rows if row.family == "linear"]
assert max(ahead) < 0.5
print("All claims hold.")
