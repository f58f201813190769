"""Other methods that find hidden effects in the arena's recordings; each names effects, as the search does.

Every rival gets the same data as the search: training and validation recording, the textbook joint, the names
of the effects. It is fitted to the training recording; the validation recording determines how many effects
it names, or a threshold. Its answer is marked like the answer of the search. For the held-out error, the
package fits the grey-box model with the named effects, so a poor fit by the rival does not count. None of the
rivals can report that something remains unexplained: they do not test their residuals.

* `motion` - smoothed positions, speeds, accelerations, and the torque that the linear joint does not explain;
* `terms` - the effects as columns of torques along this motion;
* `selection` - forward selection by BIC, shared by the methods that regress;
* `balance` - regression of the torque balance (inverse dynamics);
* `residual` - regression of the free-run error on the response of the joint to each term;
* `sindy` - sparse regression of accelerations with pysindy: plain, ensemble, weak;
* `refit` - every effect of the catalogue fitted in turn, the best selected by BIC;
* `neural` - a torque by a neural network, trained in simulation, then explained by forward selection.
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
