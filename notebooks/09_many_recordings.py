# ---
# jupyter:
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # What if I have many recordings?
#
# There may be a recording of one machine from every week, or of every machine of a batch: what has changed,
# and how? `rf.fleet` searches every recording separately and summarises the results. Here are eight
# recordings, made by the independent simulator: each is of another machine, which is healthy, has dry
# friction at the hub, or has a spring that hardens. A ninth file is damaged.

# %%
import functools
import sys
import tempfile
from collections import Counter
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

sys.path.insert(0, "../benchmarks")  # the independent simulator

import rotflex_jax as rf
from rotflex_jax import effects as fx
from rotflex_jax.arena.simulator.records import make_record

# %matplotlib inline
plt.rcParams.update({"figure.dpi": 80, "figure.constrained_layout.use": True, "axes.grid": True})

HIDDEN = {"healthy": [], "rubbing": [("coulomb", "hub")], "stiffening": [("cubic_spring", "joint")]}
folder = Path(tempfile.mkdtemp())
for k in range(8):
    state = ("rubbing", "healthy", "stiffening")[k % 3]
    made = make_record(HIDDEN[state], seed=111 + k, seconds=6.0)
    table = np.column_stack([made["Ts"] * np.arange(len(made["u"])), made["u"], made["y"]])
    name = folder / f"{k:02}_{state}.csv"
    np.savetxt(name, table, delimiter=",", header="t,voltage,theta,alpha", comments="")
(folder / "08_broken.csv").write_text("t,voltage,theta,alpha\n0,1,0,0\n0.002,nan,0,0\n0.004,1,0,0\n")
files = sorted(folder.glob("*.csv"))
print(*(file.name for file in files), sep="\n")

# %% [markdown]
# ## One call
#
# The search is `rf.discover`; here with three candidates, to keep this page short. `workers=0` keeps it
# in this process; without it, the cores of the machine share the recordings, and `scheduler=` takes a
# Dask cluster.

# %%
CANDIDATES = [(fx.Coulomb, "hub"), (fx.CubicSpring, "joint"), (fx.Delay, "input")]
search = functools.partial(rf.discover, candidates=CANDIDATES)
fleet = functools.partial(
    rf.fleet, rf.joints.paper(), files, folder=folder / "result", workers=0, search=search
)
result = fleet()
print(result)
for row in result.rows:
    print(f"{row.name:16} {row.verdict or 'failed':16} {row.found or row.reason}")

# %% [markdown]
# A file that cannot be used is a row with the reason, and the call continues. Finished results are on disk:
# the same call again has nothing left to do, and if files are added it searches only these.

# %%
again = fleet()
print(Counter("known" if row.known else "searched" for row in again.rows))

# %% [markdown]
# ## What has changed?

# %%
seen = [row for row in result.rows if row.verdict]
fig, axes = plt.subplots(1, 2, figsize=(10, 3.4), sharey=True)
for ax, channel in zip(axes, ("theta", "alpha"), strict=True):
    before, after = (
        np.rad2deg([getattr(row, when)[channel] for row in seen]) for when in ("before", "after")
    )
    place = np.arange(len(seen))
    ax.hlines(place, after, before, color="#9aa5b1")
    ax.plot(before, place, "s", color="#c8452f", label="textbook joint")
    ax.plot(after, place, "o", color="#0f6f86", label="with what was found")
    ax.axvline(np.rad2deg(seen[0].noise[channel]), ls="--", color="#5b6570", label="noise of the sensor")
    ax.set(xscale="log", xlabel=f"held-out rms error of {channel}, runs of 2 s [deg]")
axes[0].set_yticks(place, [f"{row.name}: {row.found or 'nothing'}" for row in seen])
fig.legend(*axes[0].get_legend_handles_labels(), loc="outside upper left", ncols=3)
plt.show()

# %% [markdown]
# The page `summary.html` in the folder of the result shows the same for hundreds of recordings, `summary.csv`
# has the numbers, and `models/` a model for each. On the command line it is
# `rotflex discover data/*.csv --each`; [docs/many_recordings.md](../docs/many_recordings.md) says how to
# stop, continue, and use several machines.
#
# When not to use it: recordings of *one* machine in *one* state belong together. `rf.discover(joint, [a,
# b], validation)` fits them with the same parameters and finds more than two searches. The last cell checks
# what the text says.

# %%
EXPECTED = {"healthy": "", "rubbing": "coulomb@hub", "stiffening": "cubic_spring@joint"}
for row in seen:
    assert row.found == EXPECTED[row.name.split("_")[1]], row
    assert all(row.after[c] < 1.5 * row.noise[c] for c in row.after)
assert [row.name for row in result.failed] == ["08_broken"] and "nan" in result.failed[0].reason.lower()
assert all(row.known for row in again.rows if row.verdict)
assert result.page.is_file()
print("All claims hold.")
