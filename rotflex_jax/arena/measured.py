"""The measured machines: their models, and all choices of recordings to fit and to evaluate on."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import rotflex_jax as rf
from rotflex_jax.data.readers import stages_together

# Share of a run for training; the rest is for validation.
SHARE = 0.7
# A quarter of the training record of the Silverbox suffices for three or four effects, as in benchmark B3.
SILVERBOX_SAMPLES = 16_000


@dataclass(frozen=True)
class MeasuredDirection:
    """Which recordings are fitted, which decide, and on which the result is evaluated.

    Args:
        name: name of the direction.
        train: recordings to fit.
        validation: recordings for decisions.
        test: recordings used for no fit and no choice.
    """

    name: str
    train: tuple[rf.Recording, ...]
    validation: tuple[rf.Recording, ...]
    test: tuple[rf.Recording, ...]


@dataclass(frozen=True)
class Machine:
    """A measured machine.

    Args:
        dataset: name in the registry.
        preset: name of its mechanism in `rotflex_jax.joints`.
        make_directions: function from the recordings of the data set to all directions.
        options: options of the preset.
        unit: unit of the errors that are reported.
        factor: factor from the unit of the channel to this unit.
        solver: integration rule, if it is not the default.
        with_signals: whether its recordings have signals in addition to the input.
        released: trusted parameters of the mechanism whose values are not known for its recordings.
    """

    dataset: str
    preset: str
    make_directions: Callable[[list[rf.Recording]], list[MeasuredDirection]]
    options: Mapping[str, Any] = field(default_factory=dict)
    unit: str = "deg"
    factor: float = math.degrees(1.0)
    solver: rf.Exponential | None = None
    with_signals: bool = False
    released: tuple[str, ...] = ()

    def model(self) -> rf.Model:
        """The textbook model."""
        mechanism = getattr(rf.joints, self.preset)(**self.options).release(*self.released)
        return rf.Model(mechanism) if self.solver is None else rf.Model(mechanism, self.solver)

    def directions(self) -> list[MeasuredDirection]:
        """All directions; this loads the recordings."""
        return self.make_directions(rf.data.load_dataset(self.dataset))


def learned(name: str, runs: Sequence[rf.Recording], test: Sequence[rf.Recording]) -> MeasuredDirection:
    """Fit to the beginnings of runs, validation on their ends, and evaluation on other recordings."""
    parts = [r.split(SHARE) for r in runs]
    return MeasuredDirection(name, tuple(a for a, _ in parts), tuple(b for _, b in parts), tuple(test))


def halves(run: rf.Recording) -> MeasuredDirection:
    """Learn from the first half of a run and evaluate on the second half."""
    first, second = run.split(0.5)
    return learned("first half to second half", [first], [second])


def together(runs: Sequence[rf.Recording]) -> MeasuredDirection:
    """Learn from the beginnings of all runs and evaluate on their ends."""
    parts = [r.split(SHARE) for r in runs]
    return learned(
        f"first {100 * SHARE:g} % of all to the rest", [a for a, _ in parts], [b for _, b in parts]
    )


def crossed(runs: Mapping[str, rf.Recording]) -> list[MeasuredDirection]:
    """From each run to the others, then all runs together.

    With two runs, the end of the first is for validation and the other run is the test; or the first half of
    the other run is for validation and its second half is the test. With three runs, the next one is for
    validation and the third is the test.
    """
    names, directions = list(runs), list[MeasuredDirection]()
    for k, name in enumerate(names):
        run, following = runs[name], names[(k + 1) % len(names)]
        if len(names) == 2:
            other = runs[following]
            directions.append(learned(f"{name} to {following}", [run], [other]))
            decides, tests = other.split(0.5)
            directions.append(
                MeasuredDirection(f"{name} and half of {following} to the rest", (run,), (decides,), (tests,))
            )
        else:
            last = {n: r for n, r in runs.items() if n not in (name, following)}
            title = f"{name}, decided on {following}, to {' and '.join(last)}"
            directions.append(MeasuredDirection(title, (run,), (runs[following],), tuple(last.values())))
    return [*directions, together(list(runs.values()))]


def _emps(_: list[rf.Recording]) -> list[MeasuredDirection]:
    # The test record has force pulses, which the training record lacks. It is used for the errors only.
    official = rf.data.benchmark("emps")
    return [
        learned("official", [official.train], list(official.tests.values())),
        halves(official.train),
    ]


def _silverbox(_: list[rf.Recording]) -> list[MeasuredDirection]:
    official = rf.data.benchmark("silverbox")
    train = official.train.slice(0, SILVERBOX_SAMPLES)
    return [learned("official", [train], list(official.tests.values())), halves(train)]


def by_itself(name: str, run: rf.Recording) -> MeasuredDirection:
    """Learn from the first half of a run, validate on the part after it, and evaluate on the end."""
    train, rest = run.split(0.5)
    decides, tests = rest.split(2 * SHARE - 1)
    return MeasuredDirection(f"{name}, first half to its end", (train,), (decides,), (tests,))


def _two_runs(runs: Sequence[rf.Recording]) -> list[MeasuredDirection]:
    """Two runs of the serial link, with LQR and with state feedback: each run alone, and across the runs.

    The runs are fifteen years apart, with different friction and amplifiers. A single run shows what a model
    can do; across the runs the machine has changed as well.
    """
    named: dict[str, rf.Recording] = dict(zip(("lqr", "feedback"), runs, strict=True))
    return [*(by_itself(name, run) for name, run in named.items()), *crossed(named)]


def _stage(stage: int, beside_the_other: bool) -> Callable[[list[rf.Recording]], list[MeasuredDirection]]:
    """One stage of the serial link, with or without the acceleration of the other link as a signal."""

    def directions(runs: list[rf.Recording]) -> list[MeasuredDirection]:
        own = runs[stage - 1 :: 2]
        return _two_runs(own if beside_the_other else [r.with_signals({}) for r in own])

    return directions


def _both_stages(runs: list[rf.Recording]) -> list[MeasuredDirection]:
    """Both stages of the serial link as one machine."""
    return _two_runs([stages_together(*runs[k : k + 2]) for k in (0, 2)])


def _by_gain(runs: list[rf.Recording]) -> list[MeasuredDirection]:
    """Servo with four gains and three motions for each: from the lower gains to the highest, and back."""
    low, high = runs[:9], runs[9:]
    return [
        learned("gains 100 to 400 to gain 800", low, high),
        learned("gain 800 to gains 100 to 400", high, low),
    ]


def _elbow(runs: list[rf.Recording]) -> list[MeasuredDirection]:
    """One servo of the arm: from random motion to steps, and back."""
    own = {r.source.split(",")[0]: r for r in runs if ", Elbow" in r.source}
    random = [own["multisine"], own["prbs_excitation"]]
    return [
        learned("random motion to steps", random, [own["step_response"]]),
        learned("steps to random motion", [own["step_response"]], random),
    ]


MACHINES: dict[str, Machine] = {
    "rotflex": Machine("rotflex", "quanser_2010", lambda r: crossed(dict(zip("AB", r, strict=True)))),
    "emps": Machine("emps", "emps", _emps, unit="mm", factor=1e3),
    "silverbox": Machine(
        "silverbox",
        "silverbox",
        _silverbox,
        unit="mV",
        factor=1e3,
        solver=rf.Exponential(order=4, substeps=2, between="smooth"),
    ),
    "rigid_arm": Machine(
        "rotary_arm",
        "rotary_arm",
        lambda r: crossed(dict(zip(("gain 6", "gain 8", "gains 1 and 3"), r[1:], strict=True))),
    ),
    "flexible_arm": Machine("rotary_arm", "rotary_arm", lambda r: [halves(r[0])], {"flexible": True}),
    "two_dof_link_1": Machine("two_dof_link", "two_dof_link", _stage(1, False), {"stage": 1}),
    "two_dof_link_2": Machine("two_dof_link", "two_dof_link", _stage(2, False), {"stage": 2}),
    "two_dof_link_1_beside_2": Machine(
        "two_dof_link", "two_dof_link", _stage(1, True), {"stage": 1}, with_signals=True
    ),
    "two_dof_link_2_beside_1": Machine(
        "two_dof_link", "two_dof_link", _stage(2, True), {"stage": 2}, with_signals=True
    ),
    "two_stage_link": Machine("two_dof_link", "two_stage_link", _both_stages, with_signals=True),
    "bam_xl330": Machine("bam_xl330", "xl330_pendulum", _by_gain),
    "so101": Machine(
        "so101",
        "sts3215",
        _elbow,
        {"gain": 16.0},
        solver=rf.Exponential(substeps=4),  # of 20 ms
        released=("hub.position_servo.gain",),
    ),
}
