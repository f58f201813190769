"""Results are not lost by a full disk, a report that fails, or Ctrl-C at any moment."""

import errno
import json
import os
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import rotflex_jax as rf
from kills import kills
from rotflex_jax.batch import storage
from rotflex_jax.batch.result import Fleet, RecordingRow
from rotflex_jax.batch.task import record
from rotflex_jax.cli import app, terminal
from rotflex_jax.cli.rounds import RoundsSoFar
from rotflex_jax.data import save_csv
from rotflex_jax.discover.checkpoint import milestone
from rotflex_jax.errors import InputError
from rotflex_jax.experiment.result import Experiment
from rotflex_jax.models.model import Model
from rotflex_jax.text.files import UNFINISHED, write_file
from rotflex_jax.text.markup import write_files

PACKAGE = Path(rf.__file__).parent
K = np.arange(60.0)
RUN = rf.Recording(u=np.sin(K), y=np.cos(K / 3), Ts=0.1)
ROW = RecordingRow("run", "run.csv", reason="none")
INPUT: Any = SimpleNamespace(t=K, u=K, Ts=0.1, separates=("a", "b"), input_unit="V")

# Functions that write a file into a folder, and the name of the file.
WRITERS: dict[str, tuple[Callable[[Path], object], str]] = {
    "recording": (lambda folder: save_csv(RUN, folder / "run.csv"), "run.csv"),
    "model": (lambda folder: Model(rf.joints.paper()).save(folder / "model.json"), "model.json"),
    "input": (lambda folder: Experiment.save_csv(INPUT, folder / "input.csv"), "input.csv"),
    "simulation": (
        lambda folder: terminal.save_simulation(folder / "sim.csv", RUN, {"theta": K}),
        "sim.csv",
    ),
    "report": (lambda folder: write_files(folder, {"index.html": "<html>"}), "index.html"),
    "summary": (lambda folder: Fleet((ROW,), 1, {"theta": "rad"}, folder, 0.0).write(), "summary.csv"),
    "row": (
        lambda folder: storage.write(storage.created(folder), {"name": "run", **record("done")}),
        "recordings/run.json",
    ),
    "rounds": (lambda folder: write_file(folder / "r.json", "{}"), "r.json"),
}


class FullDisk:
    """A file on a full disk."""

    def __enter__(self) -> "FullDisk":
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def write(self, data: bytes) -> int:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


@pytest.mark.parametrize("kind", WRITERS)
def test_full_disk_leaves_the_old_file_and_names_the_new_one(
    kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write, name = WRITERS[kind]
    write(tmp_path)
    before = (tmp_path / name).read_bytes()
    files = sorted(tmp_path.rglob("*"))
    opened = Path.open

    def full(path: Path, mode: str = "r", *rest: Any, **options: Any) -> Any:
        if "w" not in mode:
            return opened(path, mode, *rest, **options)
        opened(path, mode, *rest, **options).close()  # a full disk still has room for an empty file
        return FullDisk()

    monkeypatch.setattr(Path, "open", full)
    with pytest.raises(InputError, match=f"{re.escape(name)} cannot be written .No space left on device"):
        write(tmp_path)
    assert (tmp_path / name).read_bytes() == before
    assert sorted(tmp_path.rglob("*")) == files
    assert not UNFINISHED


def test_every_file_is_written_by_one_function() -> None:
    direct = r"\.write_text\(|\.write_bytes\(|\bopen\([^)]*[\"'][wax]"
    direct += r"|savefig\((?!picture|buffer|file)|json\.dump\(|np\.save\w*\((?!text)|\.to_csv\([^)]"
    # The second file writes compiled programs, by a temporary file that is renamed.
    allowed = {PACKAGE / "text" / "files.py", PACKAGE / "runtime" / "program_files.py"}
    found = {
        f"{path.relative_to(PACKAGE)}: {line.strip()}"
        for path in sorted({*PACKAGE.rglob("*.py")} - allowed)
        for line in path.read_text().splitlines()
        if re.search(direct, line)
    }
    assert not found


def searched(**changed: Any) -> SimpleNamespace:
    return SimpleNamespace(
        to_dict=lambda: {"schema": 1, "verdict": "found"},
        **{
            "save": lambda path: write_file(path, "{}"),
            "report": lambda folder: write_file(folder / "index.html", "<html>"),
            **changed,
        },
    )


@pytest.mark.parametrize("fails", ["json", "model", "report"])
def test_what_cannot_be_written_costs_nothing_else(
    fails: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    places = {"json": tmp_path / "r.json", "model": tmp_path / "m.json", "report": tmp_path / "page"}
    places["report"].mkdir()
    written = {**places, "report": places["report"] / "index.html"}
    # A link into a missing folder: the file does not exist yet and cannot be written.
    written[fails].symlink_to(tmp_path / "gone" / "file")
    monkeypatch.setattr(rf, "discover", lambda *_, **__: searched())
    monkeypatch.setattr(terminal, "print_discovery", lambda _: print("The rounds explain the record."))
    monkeypatch.setattr("rotflex_jax.runtime.xla.enable_fast_start", lambda: None)
    with pytest.raises(InputError, match=re.escape(str(written[fails]))):
        app._discover(None, [], [], places["report"], places["json"], places["model"])
    assert "The rounds explain the record." in capsys.readouterr().out
    assert {kind for kind, path in written.items() if path.exists()} == set(places) - {fails}


def test_rounds_are_kept_until_the_search_has_ended(tmp_path: Path) -> None:
    said: list[str] = []
    kept = RoundsSoFar(tmp_path / "found.json")
    follow = kept.following(said.append)
    for number, label in enumerate(("as it is", "+ coulomb at hub")):
        follow(milestone(label, ["theta"], {"theta": "rad"}, np.array([0.1 / (number + 1)]), np.ones(1)))
        follow("refitting")
    found = json.loads((tmp_path / "found.stopped.json").read_text())
    assert found["stopped"] is True
    assert found["stages"] == [
        {"model": "as it is", "held_out_rmse_windows": {"theta": 0.1}},
        {"model": "+ Coulomb friction at hub", "held_out_rmse_windows": {"theta": 0.05}},
    ]
    assert len(said) == 4
    kept.remove()
    assert not list(tmp_path.iterdir())
    RoundsSoFar(Path("-")).following(said.append)(
        milestone("as it is", ["theta"], {"theta": "rad"}, np.ones(1), np.ones(1))
    )
    assert len(said) == 5


def test_rounds_of_an_earlier_start_are_not_overwritten_by_fewer(tmp_path: Path) -> None:
    """A continued search reports its rounds again; if it is killed after one of them, none is lost."""
    file = tmp_path / "found.stopped.json"

    def reached(*labels: str, digest: str = "a") -> list[str]:
        follow = RoundsSoFar(tmp_path / "found.json").following(lambda _: None)
        for label in labels:
            line = milestone(label, ["theta"], {"theta": "rad"}, np.ones(1), np.ones(1))
            line.kept = {"digest": digest}
            follow(line)
        return [stage["model"] for stage in json.loads(file.read_text())["stages"]]

    three = reached("as it is", "+ coulomb at hub", "+ lag at input")
    assert len(three) == 3
    assert reached("as it is") == reached("as it is", "+ coulomb at hub") == three
    assert len(reached("as it is", "+ coulomb at hub", "+ lag at input", "+ delay at input")) == 4
    # A search with other rounds or another digest replaces the file.
    assert len(reached("as it is", "+ lag at input")) == 2
    assert reached("as it is", digest="b") == ["as it is"]
    file.write_text("{")
    assert reached("as it is") == ["as it is"]


@pytest.mark.slow
def test_killed_at_random_moments_nothing_is_lost(tmp_path: Path) -> None:
    """A short run of `benchmarks/kills.py`, with the compiled programs of other tests."""
    programs = Path(__file__).resolve().parents[1] / ".pytest_cache" / "compiled" / "programs"
    assert len(list(kills(2, 1, tmp_path, programs, kinds=("search",)))) == 2


SCRIPT = """
import os, signal, sys, threading, zlib
import rotflex_jax as rf
from rotflex_jax.cli import main

def search(*given, progress, **options):
    import hashlib, numpy as np
    from rotflex_jax.discover.checkpoint import milestone
    from rotflex_jax.text.files import UNFINISHED
    progress(milestone("as it is", ["theta"], {"theta": "rad"}, np.ones(1), np.ones(1)))
    progress(milestone("+ coulomb at hub", ["theta"], {"theta": "rad"}, np.ones(1), np.ones(1)))
    part = __import__("pathlib").Path("half.part")
    part.write_text("half")
    UNFINISHED.add(part)
    threading.Timer(0.2, os.kill, (os.getpid(), signal.SIGINT)).start()
    WAIT

rf.discover = search
sys.argv = ["rotflex", "demo", "--report", "page", "--json", "found.json"]
main()
"""
# What the main thread does when the signal arrives: a loop of Python, compiled code that runs for minutes, or
# a loop that catches and ignores every exception.
WAITS = {
    "python": "while True: pass",
    "compiled code": 'hashlib.pbkdf2_hmac("sha256", b"", b"", 10**9)',
    "swallowed": """
    while True:
        try:
            while True: pass
        except BaseException: pass
""",
}


def in_a_process(script: str, folder: Path) -> "subprocess.CompletedProcess[str]":
    """Run a script to its end in a new process, in a folder."""
    environment = os.environ | {"PYTHONPATH": str(PACKAGE.parent), "XDG_CACHE_HOME": str(folder / "cache")}
    return subprocess.run(
        [sys.executable, "-c", script],
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )


@pytest.mark.parametrize("where", WAITS)
def test_stopped_at_any_moment_with_the_rounds_that_were_finished(where: str, tmp_path: Path) -> None:
    (tmp_path / "found.json").write_text("of an earlier search")
    script = SCRIPT.replace("WAIT", WAITS[where])
    done = in_a_process(script, tmp_path)
    assert done.returncode == 130, done.stderr
    assert "Traceback" not in done.stderr and "Exception" not in done.stderr
    last = done.stderr.splitlines()[-1]
    assert last.startswith("rotflex: stopped; ") and "found.stopped.json" in last
    assert [s["model"] for s in json.loads((tmp_path / "found.stopped.json").read_text())["stages"]] == [
        "as it is",
        "+ Coulomb friction at hub",
    ]
    assert (tmp_path / "found.json").read_text() == "of an earlier search"
    assert not (tmp_path / "half.part").exists()


STOPPED_IN_MAIN_THREAD = """
import hashlib, importlib.machinery, os, signal, sys, threading
from rotflex_jax.cli import main
from rotflex_jax.cli.stopping import STOP

def without_end():
    threading.Timer(0.2, os.kill, (os.getpid(), signal.SIGINT)).start()
    hashlib.pbkdf2_hmac("sha256", b"", b"", 20_000_000)  # takes no signal for some seconds
    while True: pass

heard = STOP.listen
def listen():
    heard()
    HOLD
STOP.listen = listen
sys.argv = ["rotflex", "effects"]
main()
"""
# What the main thread holds while the other thread ends the process: the lock of an import, or an output
# whose flush never returns.
HELD = {
    "a module that is imported": """
    import multiprocessing
    import rotflex_jax.text.files as files
    loader = importlib.machinery.SourceFileLoader("multiprocessing", multiprocessing.__file__)
    execute = loader.exec_module
    loader.exec_module = lambda module: (execute(module), without_end())
    spec = importlib.machinery.ModuleSpec("multiprocessing", loader, is_package=True)
    finder = type("Finder", (), {"find_spec": lambda name, *_: spec if name == "multiprocessing" else None})
    sys.meta_path.insert(0, finder)
    del sys.modules["multiprocessing"]
    import multiprocessing""",
    "an output that nobody reads": """
    sys.stdout = type("Full", (), {"flush": lambda self: threading.Event().wait()})()
    without_end()""",
}


@pytest.mark.parametrize("held", HELD)
def test_stopped_while_the_main_thread_holds(held: str, tmp_path: Path) -> None:
    done = in_a_process(STOPPED_IN_MAIN_THREAD.replace("HOLD", HELD[held]), tmp_path)
    assert (done.returncode, done.stderr) == (130, "rotflex: stopped\n")


def test_the_signal_is_heard_before_anything_large_is_loaded(tmp_path: Path) -> None:
    loaded = in_a_process(
        "import sys, rotflex_jax.cli.stopping\nprint(*sys.modules)", tmp_path
    ).stdout.split()
    assert "rotflex_jax.cli.stopping" in loaded
    own = {name for name in loaded if name.startswith("rotflex_jax")}
    assert own == {"rotflex_jax", "rotflex_jax.cli", "rotflex_jax.cli.stopping"}
    assert not {"numpy", "jaxtyping", "asyncio", "importlib.metadata", "json"} & set(loaded)


def test_stopped_while_it_is_loaded(tmp_path: Path) -> None:
    """The signal arrives during the import of compiled modules, which may replace an exception by another."""
    script = (
        "import os, signal, sys, threading\nfrom rotflex_jax.cli import main\n"
        "from rotflex_jax.cli.stopping import STOP\nheard = STOP.listen\n"
        "def listen():\n    heard()\n"
        "    threading.Timer(0.05, os.kill, (os.getpid(), signal.SIGINT)).start()\n"
        "STOP.listen = listen\nsys.argv = ['rotflex', 'demo', '--report', 'page']\nmain()\n"
    )
    done = in_a_process(script, tmp_path)
    assert (done.returncode, done.stderr) == (130, "rotflex: stopped\n")
