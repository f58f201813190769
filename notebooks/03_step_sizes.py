# ---
# jupyter:
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # How large should the steps of LMS be?
#
# A second-order Volterra model adapted by LMS has two step sizes: one for its linear weights, one for the
# products. If they are too small, the record ends before the weights have settled; if they are too large, the
# weights never settle, or diverge. Usually they are set by hand. Here they are leaves of a pytree: the
# derivative of the final error with respect to the step sizes is computed through every step of the filter,
# and a descent by this derivative finds them.
#
# The joint is simulated, with friction, a dead zone and an amplifier with an offset of 0.3 V; five delays of
# 0.1 s, as in the [paper this began with](01_what_the_paper_did.ipynb).

# %%
import matplotlib.pyplot as plt
import numpy as np

import rotflex_jax as rf
from rotflex_jax import adaptive
from rotflex_jax.reproduce.plants import plant, response

# %matplotlib inline
plt.rcParams.update({"figure.dpi": 80, "figure.constrained_layout.use": True, "axes.grid": True})

Ts, blocks = 0.1, 8
u = rf.data.excitation.noise(32_080, Ts, bandwidth=2.0, seed=0)
alpha = response(plant("S6"), u, Ts, step=0.01)[:, 1]
alpha = alpha + 1e-3 * np.random.default_rng(1).standard_normal(len(u))  # the sensor
N = len(u) // blocks
recordings = [
    rf.Recording(u[k : k + N], alpha[k : k + N], Ts, channels="alpha", n_init=10)
    for k in range(0, blocks * N, N)
]
train, test = recordings[:4], recordings[4:]
recordings[0]

# %% [markdown]
# ## How large may they be?
#
# For a regressor with given moments there is an exact bound on the step size, beyond which the *mean
# square* of the weights grows without limit. It is lower than the bound that textbooks give for the mean
# alone.

# %%
basis = rf.basis.Volterra(rf.basis.Delays(5))
moments = adaptive.Moments.of_regressors(np.concatenate([basis.regressors(r.u) for r in train]))
mean, mean_square = adaptive.mean_bound(moments), adaptive.mean_square_bound(moments)
print(f"one step size for all weights: {mean:.4f} by the mean, {mean_square:.4f} by the mean square")

# %% [markdown]
# ## How does the error depend on the step sizes?
#
# First a map, with which the descent can be compared. It shows the error of the final, frozen weights on
# records to which they were not adapted, relative to the least error that any weights of this model have
# (0.1 means 10 % more squared error).


# %%
def two_steps(settings):
    """LMS with one step size for constant and linear weights, another for the products."""
    return adaptive.LMS(basis.step_sizes({0: settings["mu1"], 1: settings["mu1"], 2: settings["mu2"]}))


axes = {"mu1": np.geomspace(5e-4, 0.15, 15), "mu2": np.geomspace(1e-5, 6e-3, 15)}
tried = adaptive.grid(two_steps, axes, basis, train, "alpha", objective="final", test=test)
print(tried)

# %% [markdown]
# ## Descent by the gradient, from four starts

# %%
corners = [{"mu1": a, "mu2": b} for a in (1e-3, 0.03) for b in (1e-4, 2e-3)]
tuned = adaptive.tune(two_steps, corners, basis, train, "alpha", objective="final", test=test)
print(tuned)

# %%
fig, ax = plt.subplots(figsize=(7, 4.4))
shown = np.ma.masked_invalid(np.log10(tried.values.T))
levels = np.linspace(shown.min(), min(shown.max(), 1.0), 12)
filled = ax.contourf(*axes.values(), shown, levels, cmap="Greys", extend="max")
for path, style in zip(tuned.paths, ("o-", "s--", "^-.", "d:"), strict=True):
    ax.plot(path.points["mu1"], path.points["mu2"], style, ms=4, lw=1.2, color="#c8452f")
ax.plot(*tuned.settings.values(), "*", ms=16, color="#0f6f86", label="where all four end")
ax.set(xscale="log", yscale="log", xlabel="step size of linear weights [1/V²]")
ax.set_ylabel("step size of the products [1/V⁴]")
bar = fig.colorbar(filled, label="final excess error, share of the least [-]")
bar.set_ticks(ticks := np.log10([0.02, 0.05, 0.1, 0.3, 1, 3]), labels=[f"{10**t:.2g}" for t in ticks])
ax.legend(loc="upper left")
ax.set_title("lighter is better", loc="left")
plt.show()

# %% [markdown]
# All four descents end at the same point. Its error is not larger than that of the best of the 225 points of
# the grid, and they needed less than a third of its filter runs. The last line of the table compares the step
# sizes with the bound: the filter is stable.
#
# ## Is the filter the right tool?
#
# Step sizes are a property of LMS, not of the data. Least squares has none, and uses the same record
# once.

# %%
series = {
    "LMS, tuned": rf.adaptive.identify(tuned.filter, basis, train[0], "alpha").model,
    "RLS": rf.adaptive.identify(rf.adaptive.RLS(), basis, train[0], "alpha").model,
    "least squares": rf.least_squares(basis, train[0], "alpha"),
}
rms = {
    name: np.sqrt(
        np.mean([rf.metrics.rmse(r, getattr(m, "model", m).simulate(r))["alpha"] ** 2 for r in test])
    )
    for name, m in series.items()
}
for name, error in rms.items():
    print(f"{name:14} {np.rad2deg(error):.4f} deg rms on the four records of the test")

# %% [markdown]
# The last cell checks what the text says.

# %%
assert mean_square < mean
assert tried.evaluations == 225 and tuned.evaluations <= 75
for path in tuned.paths:
    assert path.values[-1] <= tried.value
    assert abs(path.values[-1] / tuned.value - 1) < 1e-3
assert tuned.stability.stable
assert rms["least squares"] < rms["LMS, tuned"]
print("All claims hold.")
