"""Methods of the arena itself: search, regressions, refits, evolution; called like a method of a user."""

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
    """A method of the arena itself.

    Attributes:
        title: Description in one line.
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
    """Effects named by a method of `rivals`; the grey box fits this structure, and only this fit is scored.

    Such a method is made for a joint with two angles, and for one recording of each kind.
    """
    if model.mechanism.channels != ("theta", "alpha") or len(train) != 1 or len(validation) != 1:
        raise InputError(
            f"This method is made for one recording of theta and alpha, but was given {len(train)} of "
            f"{', '.join(model.mechanism.channels)}; it cannot answer."
        )
    from rotflex_jax.fit import fit

    with threadpool_limits(1):  # for small matrices, several threads mostly wait for each other
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
    """CMA-ES over the catalogue: all effects in one model, from which effects not needed are removed."""
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
"""Name in `rotflex arena` -> entrant."""
