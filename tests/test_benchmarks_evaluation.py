"""Errors of searches on test data, as the benchmarks compute and list them."""

import math
from types import SimpleNamespace

import numpy as np
import pytest

import evaluation
import rotflex_jax as rf
from B9_measured import with_comparison
from measured_machines.page import best, evaluated as errors_of, held_out, page
from rotflex_jax.arena.measured import MACHINES, halves
from rotflex_jax.arena.simulator.records import make_record
from rotflex_jax.data.registry import DATASETS

JOINT = rf.joints.paper(hub_damping=0.004, joint_damping=0.003)


def drifting(offset: float, seed: int = 7) -> rf.Recording:
    """A recording of a linear joint with an offset of the voltage, by the arena's simulator."""
    made = make_record({("voltage_offset", "input"): {"offset": offset}}, seed=seed, seconds=6.0, perturb=0.0)
    return rf.Recording(u=made["u"], y=made["y"], Ts=made["Ts"])


@pytest.mark.parametrize("model", [rf.Model(JOINT), rf.Model(JOINT + rf.effects.VoltageOffset(offset=0.2))])
def test_calibration_finds_the_offset_of_a_recording(model):
    record = drifting(0.043)
    found = evaluation.calibrated(model, record)
    assert found is not None
    assert found[1] == pytest.approx(0.043, abs=0.004)
    free = model.simulate(record)
    own = evaluation.errors(model, [record])
    assert own["whole"] == rf.metrics.rmse(record, free)
    # Quantisation and jitter are 5e-4 rad; the offset alone causes an error a hundred times as large.
    assert own["whole"]["theta"] > 0.05 > 0.01 > own["whole_calibrated"]["theta"]
    assert own["windows_calibrated"]["theta"] < 0.004 < own["windows"]["theta"]


def test_every_recording_has_an_offset_of_its_own():
    records = [drifting(0.05), drifting(-0.03, 8)]
    found = evaluation.errors(rf.Model(JOINT), records)
    assert found["offsets"] == pytest.approx([0.05, -0.03], abs=0.004)
    each = [evaluation.errors(rf.Model(JOINT), [r])["whole"]["theta"] for r in records]
    assert found["whole"]["theta"] == pytest.approx(math.sqrt(np.mean(np.square(each))))


def test_a_search_that_knows_tests_is_told_of_them(monkeypatch):
    given = {}

    def old(mechanism, train, test, *, window_seconds=2.0, progress=None):
        given["old"] = (train, test)

    def new(mechanism, train, validation, *, test=None, window_seconds=2.0, progress=None):
        given["new"] = (train, validation, test)

    for name, search in (("old", old), ("new", new)):
        monkeypatch.setattr(rf, "discover", search)
        evaluation.searched(JOINT, ["a"], ["b"], ["c"])
        assert given[name] == (["a"], ["b"], ["c"])[: len(given[name])]
    assert len(given["new"]) == 3


def test_rounds_without_a_status_are_established():
    one = {
        "effect": "coulomb",
        "port": "hub",
        "equivalent": [{"effect": "stribeck", "port": "hub"}],
        "evidence": {"held_out_gain_nats": 1.0, "score": 2.0},
    }
    result = SimpleNamespace(to_dict=lambda: {"rounds": [one, {**one, "status": "provisional"}]})
    first, second = evaluation.named(result)
    assert (first["status"], second["status"]) == ("established", "provisional")
    assert first["equivalent"] == [["stribeck", "hub"]]


def test_every_measured_machine_has_its_place():
    assert {m.dataset for m in MACHINES.values()} == set(DATASETS)
    for name, machine in MACHINES.items():
        assert machine.model() is None or set(machine.model().mechanism.channels), name


def test_what_judges_was_not_learnt_from():
    """Test data of the measured machines do not overlap with training and validation data."""
    record = drifting(0.0)
    half = halves(record)
    assert sum(r.N for part in (half.train, half.validation, half.test) for r in part) == record.N
    for machine in MACHINES.values():
        try:
            directions = machine.directions()
        except (rf.InputError, OSError):
            continue
        assert len({w.name for w in directions}) == len(directions)
        for w in directions:
            seen = {(r.y.tobytes(), r.start) for r in (*w.train, *w.validation)}
            assert w.test and not seen & {(r.y.tobytes(), r.start) for r in w.test}
            ends = {r.source: r.start + r.N * r.Ts for r in (*w.train, *w.validation)}
            # Within one run, test data come after all training and validation data.
            assert all(r.start >= ends.get(r.source, 0.0) - 1e-9 for r in w.test)


def test_page_takes_what_the_search_reports_and_says_so():
    error = lambda v: {"theta": v, "alpha": v / 2}  # noqa: E731
    kinds = ("whole", "windows", "whole_calibrated", "windows_calibrated")
    simulated = dict.fromkeys(kinds, error(math.radians(1.0)))
    keys = ("test_rmse", "test_rmse_windows", "test_rmse_calibrated", "test_rmse_windows_calibrated")
    validated = {"held_out_rmse": error(0.1), "held_out_rmse_windows": {"seconds": 2.0, **error(0.2)}}
    row = {
        "machine": "rotflex",
        "direction": "A to B",
        "verdict": "found",
        "rounds": [{"effect": "lag", "port": "input", "equivalent": [], "status": "provisional"}],
        "cold": {"clock_s": 100.0, "processor_s": 200.0},
        "warm": {"clock_s": 10.0, "processor_s": 20.0},
        "same_again": True,
        "commit": "abc",
        "clean": False,
        "others": {"rows": [{"method": "arx", "status": "ok", **validated}]},
        "reported": {
            "baseline": validated,
            "final": validated | {k: {"seconds": 2.0, **error(math.radians(3.0))} for k in keys},
        },
        "simulated": {"baseline": simulated, "final": simulated},
    }
    assert errors_of(row, "baseline")[1] == "the benchmark" and errors_of(row, "final")[1] == "the search"
    assert held_out(row, "baseline")["windows"] == error(0.2)
    assert best(row)[0] == "arx"
    text = page({"rows": {"rotflex: A to B": row}, "left_out": {"so101": "no model"}})
    one, three = "1 / 0.5", "3 / 1.5"
    assert f"| rotflex | A to B | deg | baseline | {one} | {one} | {one} | {one} | 11.5 / 5.73 | the" in text
    assert f"|  |  |  | final | {three} | {three} | {three} | {three} | 11.5 / 5.73 | the search |" in text
    assert "| (lag@input) | 100 / 200 | 10 / 20 | yes | abc, changed |" in text
    assert "- so101: left out, no model" in text
    used = [{"found": ["dahl", "hub"], "used": ["lugre", "hub"]}]
    row |= {"laws": used, "reported": row["reported"] | {"fitted to all": row["reported"]["final"]}}
    row |= {"left_out": [{"effect": "voltage_offset", "port": "input"}]}
    row |= {"friction_of_runs": {"hub.lugre.level": [0.01, 0.02]}}
    text = page({"rows": {"rotflex: A to B": row}})
    changes = "lugre@hub for dahl@hub, without voltage_offset@input, hub.lugre.level separate for each run"
    assert f"|  |  |  | fitted to all, {changes} | {three} | {three} | {three} |" in text


def test_a_search_that_is_run_again_keeps_the_comparison_with_its_commit():
    before = {"commit": "a1", "others": {"seconds": 1.0, "rows": []}}
    again = with_comparison({"sentence": "", "others": None}, before)
    assert again["others"] == {"commit": "a1", "seconds": 1.0, "rows": []}
    # A third run names the commit of the comparison, not that of the second.
    assert with_comparison({"others": None}, again | {"commit": "b2"})["others"] == again["others"]
    compared = {"others": {"seconds": 2.0, "rows": []}}
    assert with_comparison(compared, before) == compared
    assert with_comparison({"error": "stopped"}, before) == {"error": "stopped"}
    assert with_comparison({"others": None}, {}) == {"others": None}
