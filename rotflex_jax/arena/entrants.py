"""Methods of the arena itself: the search, regressions, refits, evolution; called like a user's method."""

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from threadpoolctl import threadpool_limits

from rotflex_jax.arena.method import Method
from rotflex_jax.effects import CATALOG
from rotflex_jax.errors import InputError
from rotflex_jax.models.model import Model
from rotflex_jax.recording import Recording

Recordings = Sequence[Recording]
Given = dict[str, Any]


@dataclass(frozen=True)
class Entrant:
    """A method that comes with the arena.

    Attributes:
        title: What it is, in a line.
        method: The method.
    """

    title: str
    method: Method


def search(train: Recordings, validation: Recordings, model: Model) -> Given:
    """The search of this package, `rf.discover`."""
    from rotflex_jax.discover import discover
    from rotflex_jax.discover.verdict import Verdict

    result = discover(model, list(train), list(validation))
    chances = result.probabilities.effects if result.probabilities is not None else {}
    return {
        "effects": [(r.effect, r.port) for r in result.rounds],
        "unexplained": result.verdict is Verdict.UNEXPLAINED,
        "probabilities": chances,
        "model": result.model,
    }


def _named(find: Callable[[], Any], train: Recordings, validation: Recordings, model: Model) -> Given:
    """What a method of `rivals` names; the grey box fits the structure, so that its arithmetic is not scored.

    Such a method has columns for a joint of two angles, and one recording of each kind.
    """
    if model.mechanism.channels != ("theta", "alpha") or len(train) != 1 or len(validation) != 1:
        raise InputError(
            f"This method is made for one recording of theta and alpha, but was given {len(train)} of "
            f"{', '.join(model.mechanism.channels)}; it cannot answer."
        )
    from rotflex_jax.fit import fit

    with threadpool_limits(1):  # small matrices: several threads mostly wait for one another
        answer = find()(train[0], validation[0])
    structure = model
    for name, port in answer.rounds:
        structure = structure + CATALOG[name](at=port)
    return {"effects": answer.rounds, "model": fit(structure, train[0]).model}


def _of_sindy(kind: str) -> Callable[[], Any]:
    def find() -> Any:
        from rotflex_jax.arena.rivals import sindy

        return getattr(sindy, kind)

    return find


def _of_rivals(name: str) -> Callable[[], Any]:
    def find() -> Any:
        from rotflex_jax.arena.rivals import RIVALS

        return RIVALS[name]

    return find


def evolution(train: Recordings, validation: Recordings, model: Model) -> Given:
    """CMA-ES over the catalogue: all effects at once in one model, then what is not needed leaves."""
    from rotflex_jax.arena.evolution import evolved

    return evolved(train, validation, model)


ENTRANTS: dict[str, Entrant] = {
    "search": Entrant("the search of this package", search),
    "refit_bic": Entrant(
        "every effect of the catalogue fitted in turn, chosen by BIC",
        functools.partial(_named, _of_rivals("refit + BIC")),
    ),
    "balance_bic": Entrant(
        "regression of the torque balance, terms chosen by BIC",
        functools.partial(_named, _of_rivals("torque balance + BIC")),
    ),
    "sindy": Entrant("sparse regression of accelerations", functools.partial(_named, _of_sindy("plain"))),
    "sindy_ensemble": Entrant("the same, bagged", functools.partial(_named, _of_sindy("ensemble"))),
    "sindy_weak": Entrant("the same in weak form", functools.partial(_named, _of_sindy("weak"))),
    "cma_es": Entrant("CMA-ES over the parameters of many effects at once, then pruned", evolution),
}
"""By the name under which `rotflex arena` knows them."""
