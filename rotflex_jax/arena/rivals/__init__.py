"""Other ways to find a hidden effect, on the arena's records: each names effects as the search does.

Every rival gets what the search gets: training and validation recording, the textbook joint, the names of
the effects. It fits to the first and decides on the second how many effects or which threshold. Its answer is
marked like the search's, and the structure that it names is fitted by the package's own grey box for the
held-out error, so that a rival is never marked down for a poor fit. None of them can say that something stays
unexplained: a regression has no measure of what it leaves.

* `motion` - smoothed positions, speeds, accelerations, and the torque that the linear joint misses;
* `terms` - what the named effects look like as columns over that motion;
* `selection` - forward selection by BIC, shared by all that regress;
* `balance` - regression of the torque balance (inverse dynamics);
* `residual` - regression of the free-run error on the joint's answer to each term;
* `sindy` - sparse regression of accelerations through pysindy: plain, ensemble, weak;
* `refit` - every effect of the catalogue refitted, the best taken by BIC;
* `neural` - a network torque learnt through the simulation, then read by sparse regression.
"""

from rotflex_jax.arena.rivals.answer import NamedEffects, Rival
from rotflex_jax.arena.rivals.balance import balance
from rotflex_jax.arena.rivals.neural import neural
from rotflex_jax.arena.rivals.refit import refit
from rotflex_jax.arena.rivals.residual import residual
from rotflex_jax.arena.rivals.sindy import ensemble, plain, weak

RIVALS: dict[str, Rival] = {
    "refit + BIC": refit,
    "torque balance + BIC": balance,
    "free-run residual + BIC": residual,
    "SINDy": plain,
    "SINDy ensemble": ensemble,
    "SINDy weak": weak,
    "neural torque + BIC": neural,
}

__all__ = ["NamedEffects", "RIVALS", "Rival"]
