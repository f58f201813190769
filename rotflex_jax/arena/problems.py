"""Records of an arena, drawn from a seed that no method sees, with the truth of each record."""

import pickle
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

import rotflex_jax as rf
from rotflex_jax.arena.simulator.draws import apart
from rotflex_jax.arena.simulator.hidden import ABSORBED, DEFAULTS, OUTSIDE, UNSEEN, parameters
from rotflex_jax.arena.simulator.laws import Place
from rotflex_jax.arena.simulator.records import INPUTS, make_record
from rotflex_jax.fit.dataset import sensor_noise
from rotflex_jax.models.model import Model
from rotflex_jax.recording.quality import ACCEPTABLE

ONE, TWO, NOTHING, OUT, WORLD, MEASURED = (
    "one effect",
    "two effects",
    "nothing hidden",
    "outside the catalogue",
    "wrong world",
    "measured",
)
"""Kinds of records."""

# Kinds of a set of records in their shares; their order is drawn for each set.
_CYCLE = (ONE, NOTHING, OUT, ONE, TWO, WORLD, ONE, ONE, NOTHING, OUT, ONE, ONE)
FS, SHARE, TEST_SECONDS, WINDOW_SECONDS = 500.0, 0.7, 6.0, 2.0
"""Sampling rate [Hz], share of a record for training, length of the test data and of a run in them [s]."""

# Factors within which strengths and widths are drawn log-uniformly, relative to the table of the simulator.
_SIZE, _WIDTH = (0.6, 1.6), (0.7, 1.4)
_WIDTHS = {"presliding", "width", "speed", "frequency", "time"}
# First number of the worlds that are drawn here; no published table has them.
_FIRST_WORLD = 100_000


@dataclass(frozen=True)
class Problem:
    """A record: the data that a method receives, and the truth, which it does not receive.

    Attributes:
        kind: Kind of the record; one of the kinds in this module.
        train: Recordings to fit.
        validation: Recordings for decisions.
        model: The textbook model.
        test: Recordings on which the free run of a model is scored.
        hidden: Effects that should be named.
        forgiven: Names that are neither right nor wrong: those of further errors in a wrong world.
        noise: Standard deviation of the sensor noise of each channel in the test recordings.
        truth: The whole truth, in JSON types.
    """

    kind: str
    train: tuple[rf.Recording, ...]
    validation: tuple[rf.Recording, ...]
    model: Model
    test: tuple[rf.Recording, ...]
    hidden: tuple[Place, ...]
    forgiven: tuple[Place, ...]
    noise: dict[str, float]
    truth: dict[str, Any] = field(default_factory=dict)

    def given(self) -> bytes:
        """Training and validation recordings and the model, and nothing else, as bytes.

        Bytes are copies: an array that is cut from a longer recording would give access to the rest of it.
        """
        return pickle.dumps((list(self.train), list(self.validation), self.model))

    def runs(self) -> list[rf.Recording]:
        """Recordings over which a model is run: test recordings; simulated ones are split into parts."""
        if self.kind == MEASURED:
            return [_alone(r, r.source) for r in self.test]
        found = []
        for r in self.test:
            length = min(r.N, round(WINDOW_SECONDS / r.Ts))
            found += [_alone(r.slice(a, a + length)) for a in range(0, r.N - length + 1, length)]
        return found

    def asked(self) -> bytes:
        """The recordings of `runs` with only the first samples of their outputs, as bytes."""
        return pickle.dumps([_hidden(r) for r in self.runs()])


def _hidden(r: rf.Recording) -> rf.Recording:
    """A recording whose outputs are constant after the samples that a model may use."""
    y = r.y[np.minimum(np.arange(r.N), r.n_init - 1)]
    return replace(r, y=y, accept=ACCEPTABLE)


def _alone(r: rf.Recording, source: str = "arena") -> rf.Recording:
    """A recording without its source and without the part before it."""
    return replace(r, source=source, start=0.0, continues=None, accept=ACCEPTABLE)


def _noise(tests: tuple[rf.Recording, ...], model: Model) -> dict[str, float]:
    noise = sensor_noise(list(tests), model)
    return dict(zip(model.mechanism.channels, map(float, noise), strict=True))


def drawn(
    records: int, seed: int, seconds: float = 20.0, say: Callable[[str], None] = lambda _: None
) -> list[Problem]:
    """Simulated records: half have one hidden effect, the others are of the other kinds.

    Effects, strengths, widths, inputs, constants of the machine and noise are drawn from the seed. The order
    of the kinds is drawn too, so that the position of a record reveals nothing.

    Args:
        records: Number of records.
        seed: Seed of all draws.
        seconds: Length of the data that a method receives, training and validation together [s].
        say: Called with a line of progress.
    """
    rng = np.random.default_rng([seed, 20])
    kinds = [_CYCLE[k % len(_CYCLE)] for k in range(records)]
    rng.shuffle(kinds)
    inside, outside = _in_turn([p for p in DEFAULTS if p not in ABSORBED], rng), _in_turn(list(OUTSIDE), rng)
    found = []
    for k, kind in enumerate(kinds):
        say(f"record {k + 1} of {records} is simulated")
        if kind == WORLD:
            found.append(_world(rng))
            continue
        hidden = {ONE: 1, TWO: 2}.get(kind, 0)
        places: list[Place] = [next(outside)] if kind == OUT else [next(inside) for _ in range(hidden)]
        while len(places) == 2 and not apart(*places):
            places[1] = next(inside)
        found.append(_record(kind, places, seconds, rng))
    return found


def _in_turn(places: list[Place], rng: np.random.Generator) -> Iterator[Place]:
    """All places in a drawn order, then again in another order, without end."""
    while True:
        for k in rng.permutation(len(places)):
            yield places[int(k)]


def _log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def _record(kind: str, places: list[Place], seconds: float, rng: np.random.Generator) -> Problem:
    """A record with an input that can show the hidden effects."""
    hidden = {}
    for place in places:
        values = parameters(place, _log_uniform(rng, *_SIZE))
        hidden[place] = {n: v * _log_uniform(rng, *_WIDTH) if n in _WIDTHS else v for n, v in values.items()}
    blind = {i for place in places for i in UNSEEN.get(place, ())}
    signal = str(rng.choice([i for i in INPUTS if i not in blind]))
    r = make_record(hidden, kind=signal, seed=int(rng.integers(2**31)), seconds=seconds + TEST_SECONDS, fs=FS)
    whole = rf.Recording(u=r["u"], y=r["y"], Ts=r["Ts"], source="arena", accept=ACCEPTABLE)
    N, M = round(seconds * FS), round(seconds * SHARE * FS)
    train, validation, test = whole.slice(0, M), whole.slice(M, N), _alone(whole.slice(N, whole.N))
    model = Model(rf.joints.paper())
    return Problem(
        kind,
        (train,),
        (validation,),
        model,
        (test,),
        tuple(places),
        (),
        _noise((test,), model),
        {"record": "simulated", **r["truth"]},
    )


def _world(rng: np.random.Generator) -> Problem:
    """A record from a wrong world."""
    from rotflex_jax.arena.wrong_worlds import world

    w = world(int(rng.integers(_FIRST_WORLD, 2**31)))
    model, test = Model.of(w.model), _alone(w.test)
    besides = tuple(p for b in w.besides for p in b.names)
    truth = {"record": w.kind, "world": w.seed, "hidden": w.hidden, "parameters": w.parameters, **w.truth}
    return Problem(
        WORLD,
        (_alone(w.train),),
        (_alone(w.validation),),
        model,
        (test,),
        () if w.hidden is None else (w.hidden,),
        besides,
        _noise((test,), model),
        {**truth, "besides": [[b.name, b.values] for b in w.besides]},
    )


def measured(say: Callable[[str], None] = lambda _: None) -> list[Problem]:
    """Every direction of every measured machine whose recordings are available here.

    Their truth is unknown; the free run over test recordings is scored.

    Args:
        say: Called with a line for each direction, and for each machine that is left out.
    """
    from rotflex_jax.arena.measured import MACHINES

    found = []
    for name, machine in MACHINES.items():
        model = machine.model()
        try:
            directions = machine.directions()
        except (rf.InputError, OSError) as problem:
            say(f"{name} is left out: {problem}")
            continue
        for direction in directions:
            train, validation, test = direction.train, direction.validation, direction.test
            say(f"{name}, {direction.name}")
            truth = {
                "machine": name,
                "direction": direction.name,
                "unit": machine.unit,
                "factor": machine.factor,
            }
            found.append(
                Problem(MEASURED, train, validation, model, test, (), (), _noise(test, model), truth)
            )
    return found
