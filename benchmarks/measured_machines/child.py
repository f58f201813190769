"""Runs one direction of one machine in a separate process; the last line that it prints is JSON.

python -c "from measured_machines.child import main; main()" MACHINE DIRECTION cold METHOD...
python -c "from measured_machines.child import main; main()" MACHINE DIRECTION warm
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Sequence
from typing import Any

import rotflex_jax as rf
from evaluation import errors, named, searched
from public_machines.rounds import estimates
from rotflex_jax.arena.measured import MACHINES, MeasuredDirection


def main() -> None:
    """Command line of the process."""
    machine, direction, kind, *methods = sys.argv[1:]
    rf.enable_fast_loops()
    rf.enable_compilation_cache()
    began = time.perf_counter()

    def say(text: str) -> None:
        print(
            f"{machine}, {direction} {time.perf_counter() - began:6.1f} s  {text}",
            file=sys.stderr,
            flush=True,
        )

    print(json.dumps(row(machine, direction, kind == "cold", methods, say)))


def row(
    machine: str, direction: str, all_of_it: bool, methods: Sequence[str], say: Callable[[str], None]
) -> dict[str, Any]:
    """Result of a search, with errors on test data, bands and other methods.

    Without `all_of_it`, only the effects that were found and the times of the search.
    """
    model = MACHINES[machine].model()
    chosen = next(d for d in MACHINES[machine].directions() if d.name == direction)
    clock, processor = time.perf_counter(), time.process_time()
    result = searched(model, chosen.train, chosen.validation, chosen.test, say)
    found: dict[str, Any] = {
        "clock_s": time.perf_counter() - clock,
        "processor_s": time.process_time() - processor,
        "rounds": named(result),
    }
    if not all_of_it:
        return found
    data = result.to_dict()
    last = data["final_fit"] or {}
    say("simulating the test recordings")
    return found | {
        "verdict": data["verdict"],
        "sentence": data["sentence"],
        "notes": data["notes"],
        "laws": last.get("laws", []),
        "left_out": last.get("left_out", []),
        "friction_of_runs": last.get("friction_of_runs", {}),
        "estimates": estimates(result.final),
        # Errors that the search reports. `simulated` has errors on test data by the public interface.
        "reported": {
            "baseline": reported(data["baseline"]),
            "final": reported((data["rounds"] or [data["baseline"]])[-1]),
            # The final fit to training and validation recordings, if the search made one.
            "fitted to all": reported(last) if last else None,
        },
        "simulated": {
            "baseline": errors(result.baseline.model, chosen.test),
            "final": errors(result.final.model, chosen.test),
            "fitted to all": errors(result.model_of, chosen.test) if result.final_fit else None,
        },
        "bands": [bands(result, r) for r in chosen.test],
        "each_test": [errors(result.final.model, [r]) for r in chosen.test] if len(chosen.test) > 1 else None,
        "seconds": {
            part: sum(r.N * r.Ts for r in getattr(chosen, part)) for part in ("train", "validation", "test")
        },
        "others": compared(model, chosen, methods, say) if methods else None,
    }


def bands(result: rf.Discovery, recording: rf.Recording) -> dict[str, Any]:
    """Band of a test recording: share of samples inside, mean half width, and shares of its variance."""
    try:
        return result.prediction_bands(recording).to_dict()
    except rf.InputError as problem:
        return {"error": str(problem)}


def reported(stage: dict[str, Any]) -> dict[str, Any]:
    """Errors of a stage of a search on validation and test data, with their keys in the JSON."""
    return {k: v for k, v in stage.items() if k.startswith(("held_out_rmse", "test_rmse"))}


def compared(
    model: rf.Model, direction: MeasuredDirection, methods: Sequence[str], say: Callable[[str], None]
) -> dict[str, Any]:
    """Other methods, fitted to training and validation recordings and evaluated on the test, best first."""
    began = time.perf_counter()
    table = rf.compare(
        [*direction.train, *direction.validation],
        methods,
        mechanism=model,
        test=list(direction.test),
        progress=say,
    ).to_dict()
    kept = ("method", "status", "reason", "held_out_rmse", "held_out_rmse_windows")
    rows = [{k: r.get(k) for k in kept} for r in table["rows"]]
    return {"rows": rows, "seconds": time.perf_counter() - began}
