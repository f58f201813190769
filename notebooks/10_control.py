# ---
# jupyter:
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # Does the found effect make the joint follow better?
#
# A search of a recording has found dry friction at the hub. How much smaller does it make the tracking error?
# In this notebook a controller is designed from the fitted model, once with the found friction and once
# without, and drives the machine.
#
# The machine is an independent simulator, which integrates in steps of 20 microseconds, counts its angles
# with encoders, and shares no code with the toolkit.

# %%
import sys

import numpy as np

sys.path.insert(0, "../benchmarks")  # the independent simulator

import rotflex_jax as rf
from rotflex_jax import effects as fx
from rotflex_jax.arena.simulator.machine import Machine
from rotflex_jax.arena.simulator.records import make_record
from rotflex_jax.control import close_loop, controller_to_c

record = make_record({("coulomb", "hub"): {"level": 0.1}}, seed=40, seconds=5.0, rms=2.0)
recording = rf.Recording(u=record["u"], y=record["y"], Ts=record["Ts"], source="independent simulator")

# %% [markdown]
# ## The model
#
# The fit uses the recording alone. The friction that is hidden in the machine is 0.1 N m.

# %%
fit = rf.fit(rf.joints.paper() + fx.Coulomb("hub", level=0.03), recording)
print(fit["hub.coulomb.level"])

# %% [markdown]
# ## With and without
#
# Feedback, observer and reference are the same. The only difference is whether the planned motion includes
# the torque of the found friction.

# %%
t = recording.Ts * np.arange(1000)
swing = 0.5 * (1 - np.cos(np.pi * t))
reference = np.concatenate([swing, np.zeros(500), swing, np.zeros(1000)])

runs = {}
for compensate in ("nothing", "feedforward"):
    controller = rf.controller(fit, recording.Ts, compensate=compensate)
    runs[compensate] = close_loop(controller, Machine.of(record), reference)
    print(f"{compensate}: {runs[compensate]}")

# %%
runs["feedforward"].plot(runs["nothing"])

# %% [markdown]
# ## Every model that is still possible
#
# The recording determines the parameters within intervals. The same controller drives models drawn
# from their distribution; the result names the worst case, and each model with which the loop diverges or has
# a limit cycle.

# %%
assessment = rf.assess(controller, fit, reference[:1000], count=8, hold=3.0)
assessment

# %% [markdown]
# A model with which the loop fails: an amplifier with a delay of 14 ms. The assessment says so.

# %%
late = rf.assess(
    controller, {"fitted": fit, "late": fit.model.mechanism + fx.Delay(time=0.014)}, reference[:1000]
)
print(late)

# %% [markdown]
# ## As C code
#
# One header without allocation; with a reference it contains the planned motion as a table.

# %%
print("\n".join(controller_to_c(controller).splitlines()[-38:]))

# %% [markdown]
# [docs/control.md](../docs/control.md) says how it is computed and where it ends. The last cell checks what
# the text says.

# %%
assert abs(fit["hub.coulomb.level"].value - 0.1) < 0.02
assert runs["feedforward"].rms <= 0.5 * runs["nothing"].rms
assert all(run.limit_cycle is None for run in runs.values())
assert assessment.broken == {}
assert list(late.broken) == ["late"]
print("All claims hold.")
