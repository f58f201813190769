"""Every method on the same recordings: measured joints, public benchmarks, a simulated joint with friction.

    python benchmarks/B5_compare.py            all data sets that are there and not done yet
    python benchmarks/B5_compare.py emps       one of them, anew
    python benchmarks/B5_compare.py --all-methods arena   with the methods that search for minutes

Needs the recordings of `rotflex data fetch`, or a folder named by `ROTFLEX_DATA`; what is missing is left
out with its reason. Writes `results/B5/NAME.json`, `NAME.md` and two figures each, so that an interrupted
run goes on where it stopped.
"""

import json
import pathlib
import sys
from collections.abc import Callable

import rotflex_jax as rf
from rotflex_jax.compare import QUICK
from rotflex_jax.report.comparison_figures import horizons, ranks
from rotflex_jax.report.page import save

HERE = pathlib.Path(__file__).parent
RESULTS = HERE / "results" / "B5"
# Longer recordings are learnt from in part: a regression gains nothing more, and a fit takes minutes.
LONGEST = 16_000


def measured(which: str) -> tuple:
    """The rotary flexible joint: one run learnt from and the other judged on, or the ends of both."""
    A, B = rf.data.load_dataset("rotflex")
    joint = rf.joints.quanser_2010()
    if which == "mixed":
        parts = [r.split(0.7) for r in (A, B)]
        return joint, [a for a, _ in parts], [b for _, b in parts]
    return (joint, [A], [B]) if which == "AB" else (joint, [B], [A])


def public(name: str) -> tuple:
    """A public benchmark with its official recordings to judge on."""
    benchmark = rf.data.benchmark(name)
    train = benchmark.train
    return getattr(rf.joints, name)(), [train.slice(0, min(train.N, LONGEST))], list(benchmark.tests.values())


def arm() -> tuple:
    """A geared motor with a rigid arm, measured: one controller learnt from, another judged on."""
    rigid = [r for r in rf.data.load_dataset("rotary_arm") if "rigid" in r.source]
    return rf.joints.rotary_arm(), rigid[:1], rigid[1:2]


def arena() -> tuple:
    """A simulated joint with dry friction at the hub, from the independent simulator, tuning seed 101."""
    from arena.records import make_record

    made = make_record([("coulomb", "hub")], seconds=20.0, seed=101)
    train, test = rf.Recording(u=made["u"], y=made["y"], Ts=made["Ts"], source="arena 101").split(0.7)
    return rf.joints.paper(), [train], [test]


SETS: dict[str, Callable[[], tuple]] = {
    "rotflex_mixed": lambda: measured("mixed"),
    "rotflex_AB": lambda: measured("AB"),
    "rotflex_BA": lambda: measured("BA"),
    "arena": arena,
    "rotary_arm": arm,
    "emps": lambda: public("emps"),
    "silverbox": lambda: public("silverbox"),
}


def run(name: str, everything: bool) -> None:
    """One data set: table, JSON, figures."""
    try:
        joint, train, test = SETS[name]()
    except (rf.InputError, OSError) as error:
        print(f"{name}: left out, {error}", flush=True)
        return
    methods = None if everything else QUICK
    result = rf.compare(
        train, methods, mechanism=joint, test=test, progress=lambda s: print(f"  {s}", flush=True)
    )
    print(f"\n{name}\n{result}\n", flush=True)
    write(name, result)


def write(name: str, result: rf.Comparison) -> None:
    """Table, JSON and figures of a comparison."""
    save(
        RESULTS,
        {f"{name}.json": json.dumps(result.to_dict(), indent=1) + "\n", f"{name}.md": result.to_markdown()},
    )
    for label, figure in (("ranks", ranks(result)), ("horizon", horizons(result))):
        figure.savefig(RESULTS / f"{name}_{label}.png", dpi=90)


def main() -> None:
    """Data sets that were named, or all that are not done."""
    rf.enable_fast_loops()
    named = [a for a in sys.argv[1:] if not a.startswith("--")]
    for name in named or [n for n in SETS if not (RESULTS / f"{n}.json").exists()]:
        if name not in SETS:
            sys.exit(f"There is no data set called {name}; choose from {', '.join(SETS)}.")
        run(name, "--all-methods" in sys.argv)


if __name__ == "__main__":
    main()
