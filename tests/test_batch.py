"""Searches of many recordings: each gives a row, none is lost, and none is repeated without need."""

import csv
import dataclasses
import functools
import html
import json
import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import batch_search
import numpy as np
import pytest

import rotflex_jax as rf
from rotflex_jax.batch import Fleet, fleet, page, storage, workers
from rotflex_jax.batch.result import RecordingRow
from rotflex_jax.batch.task import code_text
from rotflex_jax.errors import InputError
from rotflex_jax.runtime import xla

JOINT = rf.joints.paper()
HERE = os.environ | {"PYTHONPATH": str(Path(rf.__path__[0]).parent)}


def write(file: Path, seed: int, volts: float) -> Path:
    """Write a short recording; the verdict of the replaced search depends on its voltage only."""
    rng = np.random.default_rng(seed)
    u = volts * rng.normal(size=100 + 20 * seed)
    columns = np.c_[0.002 * np.arange(len(u)), u, 1e-3 * np.cumsum(u), 1e-3 * u]
    file.parent.mkdir(exist_ok=True)
    np.savetxt(file, columns, delimiter=",", header="t,voltage,theta,alpha", comments="")
    return file


@pytest.fixture(autouse=True)
def no_page(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Skip the page, which takes longest, except in the tests that read it."""
    if "page" not in request.node.name:
        monkeypatch.setattr(page, "render", lambda fleet: "")


@pytest.fixture
def files(tmp_path: Path) -> list[Path]:
    return [write(tmp_path / f"run_{k}.csv", k, 3.0 if k % 2 else 0.3) for k in range(6)]


@pytest.fixture
def serial(files: list[Path], tmp_path: Path) -> Fleet:
    return fleet(JOINT, files, folder=tmp_path / "serial", workers=0, search=batch_search.quick)


def answers(found: Fleet) -> list[dict]:
    """Rows of the results without their times."""
    rows = found.to_dict()["recordings"]
    return [{k: v for k, v in row.items() if k != "seconds"} for row in rows]


def test_every_recording_is_a_row_and_a_file_and_in_the_page(files, serial) -> None:
    assert [r.name for r in serial.rows] == [f"run_{k}" for k in range(6)]
    loud = [float(np.mean(np.abs(rf.load(f).split(0.7)[0].u))) > 1 for f in files]
    assert [r.verdict == "found" for r in serial.rows] == loud
    assert serial.verdicts == {"found": sum(loud), "nothing_missing": 6 - sum(loud)}
    assert serial.effects == {("coulomb", "hub"): (sum(loud), 0)}
    _, test = rf.load(files[3]).split(0.7)
    rms = float(np.sqrt(np.mean(test.channel("theta") ** 2)))
    with (serial.folder / "summary.csv").open() as file:
        table = list(csv.DictReader(file))
    assert float(table[3]["theta_after"]) == pytest.approx(rms, rel=1e-12)
    kept = json.loads((serial.folder / "recordings" / "run_3.json").read_text())
    assert kept["result"]["rounds"][0]["effect"] == "coulomb"
    text = serial.page.read_text()
    assert all(f"recordings/run_{k}.json" in text for k in range(6))
    # The page needs no other file: pictures and styles are in it.
    assert not re.search(r'(?:src|href)="(?!data:|recordings/)', text)


def test_the_numbers_of_a_row_are_those_of_its_result_on_the_page_too(tmp_path) -> None:
    """Errors of 40 and 2 times the noise; 1 rad is 57.3 deg."""
    first = {"held_out_rmse_windows": {"theta": 0.04, "seconds": 2.0}, "held_out_rmse": {"theta": 0.08}}
    last = {"held_out_rmse_windows": {"theta": 0.002, "seconds": 2.0}, "held_out_rmse": {"theta": 0.003}}
    added = {"effect": "coulomb", "port": "hub", "equivalent": [{"effect": "dahl", "port": "hub"}]}
    result = {"verdict": "ambiguous", "baseline": first, "rounds": [added | last]}
    result |= {"noise_floor": {"theta": 1e-3}}
    row = RecordingRow.of({"name": "a", "source": "a.csv", "reason": "", "seconds": 3.0, "result": result})
    assert row.found == "coulomb@hub or dahl@hub" and row.window_seconds == 2.0
    told = {"before": 0.04, "after": 0.002, "whole_before": 0.08, "whole_after": 0.003, "noise": 1e-3}
    assert {what: row.flat(("theta",))[f"theta_{what}"] for what in told} == told
    alone = dataclasses.replace(row, name="b", effects=(("coulomb", "hub", ()),), after={"theta": 0.0014})
    both = Fleet((row, alone), 2, {"theta": "rad"}, tmp_path, 1.0)
    assert both.effects == {("coulomb", "hub"): (1, 1), ("dahl", "hub"): (0, 1)}
    assert [each["cells"] for each in page.content(both)["rows"]] == [
        [{"before": "2.29", "after": "0.115", "times": "2.00", "ok": False}],
        [{"before": "2.29", "after": "0.0802", "times": "1.40", "ok": True}],  # within 1.5 times the noise
    ]
    figure = page.errors(both)
    assert figure is not None
    points = figure.axes[0].lines[0]
    np.testing.assert_allclose([points.get_xdata(), points.get_ydata()], [[40.0, 40.0], [2.0, 1.4]])


def test_the_order_does_not_matter(files, serial, tmp_path) -> None:
    other = fleet(JOINT, files[::-1], folder=tmp_path / "other", workers=0, search=batch_search.quick)
    assert answers(other)[::-1] == answers(serial)


def test_recordings_in_memory_are_as_good_as_files(files, serial, tmp_path) -> None:
    given = [rf.load(file) for file in files]
    other = fleet(JOINT, given, folder=tmp_path / "other", workers=0, search=batch_search.quick)
    assert [(r.name, r.verdict, r.after) for r in other.rows] == [
        (r.name, r.verdict, r.after) for r in serial.rows
    ]


def test_files_are_read_in_the_units_of_the_machine(files, tmp_path) -> None:
    """A column that is named for the goal of a servo holds the goal; that of the voltage is refused."""
    how = {"workers": 0, "search": batch_search.quick, "outputs": "theta"}
    goal = tmp_path / "goal.csv"
    goal.write_text(files[0].read_text().replace("voltage", "goal"))
    named = fleet(rf.joints.servo(), [goal], folder=tmp_path / "a", input="goal", **how)
    assert named.rows[0].verdict == "nothing_missing"
    unnamed = fleet(rf.joints.servo(), files[:1], folder=tmp_path / "b", **how)
    assert "'voltage' is in V, but the model is driven in rad" in unnamed.rows[0].reason


def test_a_second_call_repeats_only_what_has_changed(files, serial, tmp_path) -> None:
    said: list[str] = []
    again = functools.partial(
        fleet, JOINT, folder=serial.folder, workers=0, search=batch_search.quick, progress=said.append
    )
    assert answers(again(files)) == answers(serial)
    assert said == []
    write(files[2], 2, 3.0)
    write(files[0].with_name("more.csv"), 7, 0.3)
    changed = again([*files, files[0].with_name("more.csv")])
    assert [line.split(": ")[1] for line in said] == ["run_2", "more"]
    assert changed.rows[2].verdict == "found"
    assert [r.known for r in changed.rows] == [True, True, False, True, True, True, False]
    # A truncated result is discarded, and its recording is searched again.
    (serial.folder / "recordings" / "run_4.json").write_text('{"schema": 1, "state": "done", "dig')
    said.clear()
    again(files)
    assert [line.split(": ")[1] for line in said] == ["run_4"]


@pytest.mark.parametrize(
    "change",
    [
        {"mechanism": rf.joints.paper(stiffness=2.0)},
        {"mechanism": JOINT + rf.effects.Coulomb(at="hub")},
        {"split": 0.5},
        {"degrees": True},
        {"search": functools.partial(batch_search.quick, hold="more")},
    ],
    ids=lambda change: "".join(change),
)
def test_other_questions_are_not_answered_from_disk(change, files, tmp_path) -> None:
    asked = {"mechanism": JOINT, "search": batch_search.quick, "accept": ("units",)}
    one = functools.partial(fleet, recordings=files[:1], folder=tmp_path / "out", workers=0)
    assert not one(**asked).rows[0].known
    assert one(**asked).rows[0].known
    assert not one(**{**asked, **change}).rows[0].known


def test_the_digest_is_the_same_in_another_process(files, serial) -> None:
    """Sets have another order in another process; a digest that depends on it would repeat the searches."""
    program = f"""
import batch_search, sys
import rotflex_jax as rf
from rotflex_jax.batch import fleet
rows = fleet(rf.joints.paper(), {list(map(str, files))}, folder={str(serial.folder)!r}, workers=0,
             search=batch_search.quick).rows
sys.exit(0 if all(r.known for r in rows) else 5)
"""
    path = HERE["PYTHONPATH"] + os.pathsep + str(Path(batch_search.__file__).parent)
    assert subprocess.run([sys.executable, "-c", program], env=HERE | {"PYTHONPATH": path}).returncode == 0


def test_functions_among_the_arguments_are_digested_by_their_names() -> None:
    """Addresses differ between processes; with them in the digest, a stopped batch would start again."""

    def asked(say: Any) -> str:
        return storage._named(functools.partial(batch_search.quick, hold=[say, functools.partial(say, 1)]))

    assert asked(print) == asked(print) != asked(repr)
    assert "0x" not in asked(print) + asked(lambda line: None) + asked([].append)


def test_what_is_wrong_with_one_recording_is_a_row_of_the_page(files, tmp_path) -> None:
    (tmp_path / "bad.csv").write_text("t,voltage\n0,1\n")
    loudest = write(tmp_path / "loudest.csv", 1, 6.0)
    call = functools.partial(
        fleet, JOINT, [files[0], tmp_path / "bad.csv", files[1], loudest],
        folder=tmp_path / "out", workers=0, search=batch_search.faulty,
    )  # fmt: skip
    found = call()
    assert [r.verdict for r in found.rows] == ["nothing_missing", "", "", ""]
    assert "theta" in found.rows[1].reason
    assert found.rows[2].reason.startswith("A level above 1 V")
    assert found.rows[3].reason == "ZeroDivisionError: a fault of the program"
    text = html.unescape(found.page.read_text()).replace("\u00a0", " ")
    assert all(r.reason in text for r in found.failed)
    # Refused data are not tried again; a recording with another error is.
    assert [r.known for r in call().rows] == [True, True, True, False]


def test_a_name_that_is_made_collides_with_none_that_is_given(files) -> None:
    given = [rf.load(file) for file in files[:3]]
    named = zip(given, ("run.csv", "run.csv", "run-1.csv"), strict=True)
    named = [dataclasses.replace(r, source=name) for r, name in named]
    assert storage.names_of(named) == ["run-1_", "run-2", "run-1"]


def test_names_that_collide_get_files_of_their_own(tmp_path) -> None:
    twins = [write(tmp_path / part / "run.csv", 1, volts) for part, volts in (("a", 0.3), ("b", 3.0))]
    found = fleet(JOINT, twins, folder=tmp_path / "out", workers=0, search=batch_search.quick)
    assert [r.verdict for r in found.rows] == ["nothing_missing", "found"]
    assert len({r.name for r in found.rows}) == len(list((tmp_path / "out/recordings").iterdir())) == 2


def test_a_process_that_dies_costs_no_recording(files, serial, tmp_path, monkeypatch) -> None:
    """One recording kills its process at the first attempt, another one always."""
    monkeypatch.setattr(workers, "MOST_ATTEMPTS", 2)
    deadly = write(tmp_path / "deadly.csv", 1, 6.0)
    (tmp_path / "marks").mkdir()
    search = functools.partial(batch_search.dying_once, folder=str(tmp_path / "marks"))
    given = [files[0], files[1], deadly, files[2]]
    found = fleet(JOINT, given, folder=tmp_path / "out", workers=2, search=search)
    expected = answers(serial)
    assert [answers(found)[k] for k in (0, 1, 3)] == expected[:3]
    assert len(list((tmp_path / "marks").iterdir())) == 2
    assert "ended its process 2 times" in found.rows[2].reason


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="only Linux tells a process its size")
def test_a_process_that_has_grown_too_large_is_replaced(files, tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(workers, "PROCESS_MEMORY", 1.0)
    (tmp_path / "go").touch()
    search = functools.partial(batch_search.waiting, folder=str(tmp_path))
    found = fleet(JOINT, files[:2], folder=tmp_path / "out", workers=1, search=search)
    assert found.failed == ()
    assert len(set((tmp_path / "running").read_text().split())) == 2


def test_stopping_leaves_a_page_of_what_is_finished(files, tmp_path) -> None:
    def stop(line: str) -> None:
        if line.startswith("2 of 6:"):
            raise KeyboardInterrupt

    call = functools.partial(fleet, JOINT, files, folder=tmp_path / "out", search=batch_search.quick)
    with pytest.raises(KeyboardInterrupt):
        call(workers=0, progress=stop)
    assert "4 more were not finished" in (tmp_path / "out" / "summary.html").read_text()
    assert sum(r.known for r in call(workers=0).rows) == 2


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"recordings": []}, "No recording"),
        ({"split": 1.0}, "above 0 and below 1"),
        ({"workers": -1}, "whole number from 0"),
        ({"workers": 2, "scheduler": "tcp://127.0.0.1:1"}, "one of the two"),
        ({"folder": __file__}, "name another"),
        ({"degree": True}, "did you mean degrees"),
        ({"search": lambda *parts: None}, "function of a Python file"),
        ({"recordings": ["nowhere.csv"]}, "does not exist"),
        ({"recordings": ["."]}, "is a folder"),
        ({"recordings": [__file__, __file__]}, "twice"),
        ({"scheduler": "tcp://127.0.0.1:1"}, "No Dask scheduler answers"),
    ],
)
def test_bad_arguments_are_refused(change, words, files, tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(workers, "SCHEDULER_TIMEOUT", 0.2)
    given = {"recordings": files, "folder": tmp_path / "out", "search": batch_search.quick, **change}
    with pytest.raises(InputError, match=words):
        fleet(JOINT, **given)


@pytest.fixture
def scheduler(tmp_path: Path) -> Iterator[str]:
    """A Dask scheduler and two workers, as separate processes on the loopback interface."""
    pytest.importorskip("distributed")
    contact = tmp_path / "scheduler.json"
    shared = ["--no-dashboard", "--scheduler-file", str(contact)]
    begin = functools.partial(
        subprocess.Popen, env=HERE, cwd=tmp_path, stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL
    )
    dask = [sys.executable, "-m", "dask"]
    started = [begin([*dask, "scheduler", "--host", "127.0.0.1", "--port", "0", *shared])]
    until(contact.exists)
    alone = ["--nthreads", "1", "--no-nanny", "--memory-limit", "0", "--local-directory", str(tmp_path)]
    started += [begin([*dask, "worker", *shared, *alone, "--host", "127.0.0.1"]) for _ in range(2)]
    try:
        yield json.loads(contact.read_text())["address"]
    finally:
        for process in started:
            process.kill()
        for process in started:
            process.wait()


def until(true: Callable[[], object], seconds: float = 60) -> None:
    end = time.monotonic() + seconds
    while not true():
        assert time.monotonic() < end, "nothing happened"
        time.sleep(0.02)


def test_a_cluster_finishes_though_a_worker_is_killed(scheduler, tmp_path) -> None:
    """One worker is killed while both search a recording; its recording is searched again."""
    files = [write(tmp_path / f"run_{k}.csv", k, 3.0 if k % 2 else 0.3) for k in range(50)]
    serial = fleet(JOINT, files, folder=tmp_path / "serial", workers=0, search=batch_search.quick)
    room = tmp_path / "room"
    room.mkdir()
    running = lambda: (room / "running").read_text().split() if (room / "running").exists() else []  # noqa: E731

    def kill() -> None:
        try:
            until(lambda: len(set(running())) == 2)
            os.kill(int(running()[0]), signal.SIGKILL)
        finally:  # also after a failure, since others wait for this
            (room / "go").touch()

    killer = threading.Thread(target=kill)
    killer.start()
    search = functools.partial(batch_search.waiting, folder=str(room))
    found = fleet(JOINT, files, folder=tmp_path / "out", scheduler=scheduler, search=search)
    killer.join()
    assert answers(found) == answers(serial)
    assert len(running()) == len(files) + 1


@pytest.mark.parametrize("moment", ["while recordings are searched", "between recordings"])
def test_a_scheduler_that_dies_is_said_in_one_sentence(moment, scheduler, tmp_path, capfd) -> None:
    from distributed import Client

    files = [write(tmp_path / f"run_{k}.csv", k, 0.3) for k in range(12)]
    with Client(scheduler, set_as_default=False) as client:
        number = client.run_on_scheduler(os.getpid)
    room = tmp_path / "room"
    room.mkdir()
    capfd.readouterr()

    def kill() -> None:
        try:
            until((room / "running").exists)
        finally:  # also after a failure, since others wait for this
            os.kill(number, signal.SIGKILL)

    if moment == "between recordings":
        (room / "go").touch()
        said = lambda line: os.kill(number, signal.SIGKILL) if line.startswith("1 of") else None  # noqa: E731
    else:
        said = lambda line: None  # noqa: E731
        threading.Thread(target=kill, daemon=True).start()
    search = functools.partial(batch_search.waiting, folder=str(room))
    with pytest.raises(InputError, match="went away; start it again and repeat the call"):
        fleet(JOINT, files, folder=tmp_path / "out", scheduler=scheduler, search=search, progress=said)
    assert "Traceback" not in "".join(capfd.readouterr())
    kept = len(list((tmp_path / "out" / "recordings").iterdir()))
    assert (kept > 0) == (moment == "between recordings")


SCRIPT = """
import dataclasses, functools, sys
from typing import ClassVar
import rotflex_jax as rf
from batch_search import quick
from rotflex_jax.effects import Force, register
from rotflex_jax.parameters import parameter
LEVEL = 1.0

def helper(x):
    return x + LEVEL

class Settings:
    share = 0.5
    def of(self, x):
        return x * self.share

@register
@dataclasses.dataclass(frozen=True)
class Drag(Force):
    name: ClassVar[str] = "own_drag"
    title: ClassVar[str] = "drag"
    equation: ClassVar[str] = "tau = -c speed"
    amplitudes: ClassVar[tuple[str, ...]] = ("c",)
    c: float = parameter(1.0, unit="N m s/rad", lower=0.0)

    def force(self, position, speed, voltage):
        return -self.c * speed

def search(model, train, test):
    # a remark
    found = quick(model, train, test)
    found.number = [helper(k) for k in range(3)], Settings().of(2.0), {"a", "b", "c"}
    return found

if __name__ == "__main__":
    rows = rf.fleet(rf.joints.paper(), sys.argv[2:], folder=sys.argv[1], workers=0, search=search).rows
    print("known" if all(row.known for row in rows) else "searched", rows[0].reason)
"""


@pytest.mark.parametrize(
    "damage",
    [
        lambda r: r["result"].pop("baseline"),
        lambda r: r["result"].update(verdict="perhaps"),
        lambda r: r["result"].update(rounds=3),
        lambda r: r["result"]["noise_floor"].update(theta="much"),
        lambda r: r["result"]["baseline"]["held_out_rmse_windows"].update(theta=True),
        lambda r: r.update(seconds=None),
        lambda r: r.update(reason=["none"]),
    ],
)
def test_a_result_that_was_changed_is_no_result(damage, files, tmp_path) -> None:
    row = functools.partial(fleet, JOINT, files[:1], folder=tmp_path, workers=0, search=batch_search.quick)
    row()
    assert row().rows[0].known
    (file,) = (tmp_path / "recordings").iterdir()
    found = json.loads(file.read_text())
    damage(found)
    file.write_text(json.dumps(found))
    assert not row().rows[0].known


def text_of(script: str) -> str:
    """Text for the digest of the search and the effect that a main program defines."""
    names: dict = {"__name__": "__main__"}
    exec(compile(script.replace("@register\n", ""), "main.py", "exec"), names)
    return code_text([names["search"], names["Drag"]])


@pytest.mark.parametrize(
    ("old", "new", "same"),
    [
        ("# a remark", "# another remark", True),
        ("LEVEL = 1.0", "FURTHER = 3\n\nLEVEL = 1.0", True),
        ("LEVEL = 1.0", "LEVEL = 2.0", False),
        ("return x + LEVEL", "return x - LEVEL", False),
        ("range(3)", "range(4)", False),
        ("share = 0.5", "share = 0.6", False),
        ("x * self.share", "x / self.share", False),
        ("-self.c * speed", "-self.c * speed**3", False),
        ("lower=0.0", "lower=1e-3", False),
    ],
)
def test_the_digest_has_what_the_main_program_does(old: str, new: str, same: bool) -> None:
    script = SCRIPT.partition("if __name__")[0]
    assert text_of(script) == text_of(script)
    assert (text_of(script) == text_of(script.replace(old, new))) == same


def test_what_changes_in_the_main_program_is_searched_again(files, tmp_path) -> None:
    script = tmp_path / "main.py"
    path = HERE["PYTHONPATH"] + os.pathsep + str(Path(batch_search.__file__).parent)

    def run(text: str) -> str:
        script.write_text(text)
        line = [sys.executable, str(script), str(tmp_path / "out"), str(files[0])]
        done = subprocess.run(
            line, env=HERE | {"PYTHONPATH": path}, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stderr
        return done.stdout.strip()

    assert run(SCRIPT) == "searched"
    assert run(SCRIPT.replace("# a remark", "# another remark")) == "known"
    assert run(SCRIPT.replace("LEVEL = 1.0", "LEVEL = 2.0")) == "searched"


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="this system places processes itself")
@pytest.mark.parametrize(
    ("of", "shares"),
    [
        (1, [{2, 3, 5, 7, 8}]),
        (2, [{2, 3}, {5, 7, 8}]),
        (5, [{2}, {3}, {5}, {7}, {8}]),
        (7, [{2}, {3}, {5}, {7}, {8}] * 2),
    ],
)
def test_each_process_has_cores_of_its_own(monkeypatch, of, shares) -> None:
    kept = []
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {2, 3, 5, 7, 8})
    monkeypatch.setattr(os, "sched_setaffinity", lambda _, chosen: kept.append(set(chosen)))
    for place in range(of):
        xla.bind_to_cores(place, of)
    assert kept == shares[:of]


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="this system places processes itself")
def test_a_process_that_may_not_choose_its_cores_goes_on(monkeypatch) -> None:
    def refused(_: int, chosen: object) -> None:
        raise PermissionError

    monkeypatch.setattr(os, "sched_setaffinity", refused)
    xla.bind_to_cores(0, 2)


def test_the_number_of_processes_fits_the_machine(monkeypatch) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: range(64), raising=False)
    monkeypatch.setattr(os, "sysconf", {"SC_PHYS_PAGES": 4_000_000, "SC_PAGE_SIZE": 4096}.__getitem__)
    assert workers.workers_here() == int(16.384e9 // workers.PROCESS_MEMORY)
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: range(2), raising=False)
    assert workers.workers_here() == 2
