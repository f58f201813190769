"""Times of the same work on one and on two JAX devices of the processor, each in new processes, in turn."""

from __future__ import annotations

import json
import tempfile

from speed.processes import process

WORK = "from speed.devices import work; work({count}, {seconds}, {starts}, {recordings})"


def devices(seconds: float, starts: int, recordings: int) -> dict[str, float]:
    """Seconds on one and on two devices, the least of three processes each, and their ratios."""
    facts: dict[str, float] = {}
    with tempfile.TemporaryDirectory() as cache:
        for _ in range(3):
            for count in (1, 2):
                code = WORK.format(count=count, seconds=seconds, starts=starts, recordings=recordings)
                found = process(code, cache=cache)
                for what, seconds_here in found.items():
                    if what not in ("clock", "processor"):
                        name = f"{what}, {count} device{'s' * (count > 1)}, seconds"
                        facts[name] = min(seconds_here, facts.get(name, seconds_here))
    for name in [n for n in facts if "1 device," in n]:
        what = name.partition(", 1 device")[0]
        facts[f"{what}, gain of the second device"] = facts[name] / facts[f"{what}, 2 devices, seconds"]
    return facts


def work(count: int, seconds: float, starts: int, recordings: int) -> None:
    """Work of the new process: runs each task on `count` devices and prints its least time as JSON."""
    import rotflex_jax as rf

    rf.enable_fast_loops()
    import jax

    jax.config.update("jax_num_cpu_devices", count)
    from speed import filters, fits
    from speed.machine import smooth
    from speed.rounds import least

    several = [fits.recording(seconds, seed) for seed in range(recordings)]
    joint = smooth(p=fits.start(0.3, 1))
    sweep = filters.sweep(round(1000 * seconds))
    found = {
        "2000 pairs of step sizes": least(sweep, 3)[0],
        f"{starts} starts": least(
            lambda: rf.many_starts(smooth(), several[0], starts=starts, short_seconds=None), 3
        )[0],
        f"a fit of {recordings} recordings": least(lambda: rf.fit(joint, several), 3)[0],
    }
    print(json.dumps(found))
