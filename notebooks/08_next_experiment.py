# ---
# jupyter:
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # What should I record next?
#
# Sometimes two effects explain a recording equally well. A delay of the voltage and a lag of the
# amplifier are such a pair: for slow motions they are the same. Then the question is which voltage to play
# next, within the limits of the machine, so that the new recording decides between the two.
#
# The machine here is an independent simulator that hides a delay of 1.2 ms.

# %%
import sys

import numpy as np

sys.path.insert(0, "../benchmarks")  # the independent simulator

import rotflex_jax as rf
from rotflex_jax import effects as fx
from rotflex_jax.arena.simulator.records import make_record

HIDDEN = {("delay", "input"): {"time": 0.0012}}


def play(**what):
    """What the machine answers to an input."""
    r = make_record(HIDDEN, seed=110, **what)
    return rf.Recording(u=r["u"], y=r["y"], Ts=r["Ts"], source="independent simulator")


# %% [markdown]
# ## Delay or lag?
#
# Fit the joint with the one, and with the other, to an ordinary recording with noise as its input. The
# difference of the two log-likelihoods is the evidence, in nats.

# %%
rivals = {"delay": fx.Delay(time=0.0006), "lag": fx.Lag(time=0.0006)}


def evidence(recording):
    """Log-likelihood of the delay less that of the lag, each at its best [nat]."""
    found = {name: rf.fit(rf.joints.paper() + effect, recording) for name, effect in rivals.items()}
    logs = {n: recording.N * sum(np.log(s) for s in fit.noise.values()) for n, fit in found.items()}
    return logs["lag"] - logs["delay"], found["delay"]


ordinary = play(seconds=8.0)
before, fitted = evidence(ordinary)
print(f"{before:.1f} nat in favour of the delay")

# %% [markdown]
# ## Which input tells them apart?
#
# The limits are 6 V, 90 degrees of travel and 10 degrees of deflection. The worth of an input is what the
# best fit of the rival leaves of the run, for the worse of the two cases (one effect is true, or the other).
# The standard inputs are ranked, and the best one is improved by the gradient through both simulations.

# %%
limits = rf.Limits(voltage=6.0, travel=np.deg2rad(90), deflection=np.deg2rad(10))
designed = rf.next_experiment(
    fitted,
    "delay@input",
    "lag@input",
    limits=limits,
    seconds=8.0,
    reference=ordinary.u,
    starts=1,
    evaluations=12,
)
print(designed)

# %%
designed.plot()

# %% [markdown]
# The input is within the limits, and it resembles none of the standard inputs. Where the deflection is the
# active limit, it leaves out the resonance and uses the voltage at frequencies where the two effects differ.
#
# ## Was it worth it?
#
# Play it on the machine, with new noise of the sensors, and fit both models again.

# %%
answer = play(played=designed.u)
after, _ = evidence(answer)
print(f"ordinary recording {before:6.1f} nat")
print(f"designed input     {after:6.1f} nat, promised {designed.chosen.nats:.0f}")
print(f"largest deflection {np.rad2deg(np.abs(answer.channel('alpha')).max()):.1f} deg")

# %% [markdown]
# The same length of time, several times the evidence.
# [docs/next_experiment.md](../docs/next_experiment.md) says how it is computed, how to play it with care,
# and when not to trust it. The last cell checks what the text says.

# %%
assert np.abs(designed.u).max() <= 6.0 + 1e-9
assert np.rad2deg(np.abs(answer.channel("alpha")).max()) <= 10.0
assert np.rad2deg(np.abs(answer.channel("theta")).max()) <= 90.0
assert designed.chosen.nats >= designed.standard.nats
assert after > 3 * max(before, 1.0) and after > 50
print("All claims hold.")
