"""Compiled programs on disk: another process loads them, but only if nothing on which they depend differs."""

import dataclasses
import gc
import hashlib
import json
import os
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pooch
import pytest
import scipy
from jax.experimental import serialize_executable

import rotflex_jax as rf
from rotflex_jax.basis import Delays, Orthonormal, Volterra
from rotflex_jax.basis.bank import Bank, Traced
from rotflex_jax.effects import Coulomb, LuGre
from rotflex_jax.effects.base import Force
from rotflex_jax.mechanism import Exponential
from rotflex_jax.mechanism.quantity import Units
from rotflex_jax.parameters import parameter
from rotflex_jax.runtime import persistent_jit, program_files
from rotflex_jax.runtime.persistent_jit import (
    PersistentJit,
    clear_compilation_caches,
    loaded_ahead,
    make_ahead,
    performance,
    program_counts,
    release_programs,
)
from rotflex_jax.runtime.program_files import keep_programs, programs_folder, static_key
from rotflex_jax.runtime.xla import double_precision

traced = []


def new() -> PersistentJit:
    """A `PersistentJit` as in a new process: none of its programs is in memory."""

    def line(slope: float, x: jax.Array) -> jax.Array:
        traced.append(slope)
        return slope * x

    return PersistentJit(line, static=1)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """An empty cache folder, and source files that are older than the process."""
    before = jax.config.values["jax_compilation_cache_dir"]
    jax.config.update("jax_compilation_cache_dir", str(tmp_path))
    monkeypatch.delenv(program_files.FOLDER_VARIABLE, raising=False)
    monkeypatch.setattr(program_files, "_LOADED", time.time() + 3600.0)
    # In a process that has run many tests, it takes a second each time.
    monkeypatch.setattr(persistent_jit, "_return_memory", lambda: None)
    traced.clear()
    yield tmp_path
    jax.config.update("jax_compilation_cache_dir", before)


def files(folder: Path) -> list[Path]:
    return [f for f in folder.glob("programs/*/*") if f.is_file()]


@pytest.mark.parametrize(("given", "expected"), [({}, None), ({"optimisation_level": 1}, 1)])
def test_the_compiler_gets_the_level(folder: Path, monkeypatch, given, expected) -> None:
    levels, jit = [], jax.jit

    def noted(function, **options):
        if function.__name__ == "flat":
            levels.append(options["compiler_options"].get("xla_backend_optimization_level"))
        return jit(function, **options)

    monkeypatch.setattr(jax, "jit", noted)
    PersistentJit(lambda slope, x: slope * x, static=1, **given)(2.0, jnp.ones(2))
    assert levels == [expected]


def test_a_second_process_does_not_trace(folder: Path) -> None:
    x = np.arange(3.0)
    with double_precision():
        first = new()(2.0, x)
        again = new()(2.0, x)  # nothing in memory, as in a new process
    np.testing.assert_array_equal(first, again)
    np.testing.assert_array_equal(first, [0.0, 2.0, 4.0])
    assert traced == [2.0] and len(files(folder)) == 1


class Held:
    """A program whose tracing waits until `go` is set; if `fails`, the first tracing raises an error."""

    def __init__(self, fails: bool = False) -> None:
        self.begun, self.go, self.threads = threading.Semaphore(0), threading.Event(), []

        def line(slope: float, x: jax.Array) -> jax.Array:
            self.threads.append(threading.current_thread().name)
            self.begun.release()
            assert self.go.wait(30.0)
            if fails and len(self.threads) == 1:
                raise ValueError("first")
            return slope * x

        self.program = PersistentJit(line, static=1)


X = np.arange(3.0, dtype=np.float32)


@pytest.mark.parametrize("fails", [False, True])
def test_a_program_that_two_threads_need_is_made_by_one(folder: Path, fails: bool) -> None:
    held = Held(fails)
    with ThreadPoolExecutor(2) as pool:
        first = pool.submit(held.program, 2.0, X)
        assert held.begun.acquire(timeout=30.0)
        second = pool.submit(held.program, 2.0, X)
        assert not held.begun.acquire(timeout=0.3)  # the second thread waits
        held.go.set()
        np.testing.assert_array_equal(second.result(30.0), 2 * X)
        if fails:  # then the waiting thread makes the program
            with pytest.raises(ValueError, match="first"):
                first.result(30.0)
        else:
            np.testing.assert_array_equal(first.result(30.0), 2 * X)
    assert len(held.threads) == 1 + fails and len(held.program) == 1


def test_a_program_made_ahead_is_there_when_it_is_needed(folder: Path) -> None:
    held, beyond, none_left = Held(), [], lambda: persistent_jit._ahead().submit(int).result(30.0)
    make_ahead(held.program, 2.0, X)
    assert held.begun.acquire(timeout=30.0)
    held.go.set()
    np.testing.assert_array_equal(held.program(2.0, X), 2 * X)
    none_left()
    assert len(held.threads) == 1 and held.threads[0].startswith("programs")
    make_ahead(lambda: beyond.append(held.program(2.0, X)))  # already in memory, so the call ends early
    make_ahead(lambda: beyond.append(held.program(3.0, X)))
    none_left()
    np.testing.assert_array_equal(beyond, [3 * X])


@pytest.mark.parametrize("kept", [True, False])
@pytest.mark.parametrize("was_on", [True, False])
def test_garbage_is_not_searched_for_while_programs_are_made(
    folder: Path, monkeypatch: pytest.MonkeyPatch, kept: bool, was_on: bool
) -> None:
    """Several threads make programs, and one fails; afterwards the setting of the user holds again."""
    seen: list[bool] = []
    if not kept:
        monkeypatch.setattr(program_files, "programs_folder", lambda: None)

    def line(slope: float, x: jax.Array) -> jax.Array:
        seen.append(gc.isenabled())
        time.sleep(0.02 * slope)
        if slope == 3:
            raise ValueError("no such line")
        return slope * x

    program = PersistentJit(line, static=1)
    (gc.enable if was_on else gc.disable)()
    try:
        with ThreadPoolExecutor(3) as pool:
            made = [pool.submit(program, slope, jnp.ones(2)) for slope in (1, 2, 3)]
        assert [m.exception() is None for m in made] == [True, True, False]
        assert seen == [False] * len(seen) and len(seen) >= 3
        assert gc.isenabled() == was_on
    finally:
        gc.enable()


def test_what_goes_wrong_ahead_goes_wrong_where_it_is_needed(folder: Path) -> None:
    held = Held(fails=True)
    held.go.set()
    make_ahead(held.program, 2.0, X)
    persistent_jit._ahead().submit(int).result(30.0)
    assert len(held.threads) == 1
    np.testing.assert_array_equal(held.program(2.0, X), 2 * X)
    with pytest.raises(TypeError):
        make_ahead(held.program, 2.0, "text")
        held.program(2.0, "text")


def test_what_differs_is_another_program(folder: Path) -> None:
    program = new()
    with double_precision():
        program(2.0, np.arange(3.0))
        program(2.0, np.arange(4.0))
        program(3.0, np.arange(3.0))
        assert program(2.0, np.arange(3.0) + 1)[0] == 2.0  # other values need no other program
    single = program(2.0, np.arange(3, dtype=np.float32))
    assert single.dtype == np.float32
    assert traced == [2.0, 2.0, 3.0, 2.0] and len(files(folder)) == len(program) == 4


def test_programs_are_counted_and_one_that_is_loaded_runs_once(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    x, before, runs = np.arange(3.0, dtype=np.float32), program_counts(), []
    load = serialize_executable.deserialize_and_load

    def watched(*given: Any) -> Any:
        program = load(*given)
        return lambda *leaves: (runs.append(leaves), program(*leaves))[1]

    monkeypatch.setattr(serialize_executable, "deserialize_and_load", watched)
    for program in (new(), new()):
        for _ in range(3):
            np.testing.assert_array_equal(program(7.25, x), 7.25 * x)
    found = program_counts()
    assert (found.compiled - before.compiled, found.loaded - before.loaded) == (1, 1)
    assert found.seconds > before.seconds and len(runs) == 3  # the first run checks the program


@pytest.fixture
def loads(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, str]]:
    """Thread and file of each program that is read."""
    read, found = persistent_jit.read_program, []

    def watched(file: Path) -> Any:
        found.append((threading.current_thread().name.partition("_")[0], file.name))
        return read(file)

    monkeypatch.setattr(persistent_jit, "read_program", watched)
    return found


def test_programs_of_the_last_block_alike_are_loaded_on_threads(
    folder: Path, loads: list[tuple[str, str]]
) -> None:
    slopes, first = (6.125, 5.125, 4.125), new()
    with loaded_ahead("a search", (1, 2)):
        for slope in slopes:
            first(slope, X)
    loads.clear()
    second = new()
    with loaded_ahead("another", (1, 2)):
        assert not persistent_jit._coming
    release_programs()
    with loaded_ahead("a search", (1, 2)):
        for future in list(persistent_jit._coming.values()):
            assert future.result(30.0) is not None
        for slope in slopes[1:]:
            np.testing.assert_array_equal(second(slope, X), slope * X)
    assert traced == [*slopes] and not persistent_jit._coming
    assert len(loads) == 3 and {thread for thread, _ in loads} == {"loading"}
    loads.clear()
    second.release_programs()
    with loaded_ahead("a search", (1, 2)):  # only the first such block of a process loads
        assert not persistent_jit._coming
    release_programs()
    with loaded_ahead("a search", (1, 2)):  # the last such block used no programs
        assert not persistent_jit._coming
    assert not loads


def test_a_list_of_programs_that_is_damaged_or_names_none_does_no_harm(
    folder: Path, loads: list[tuple[str, str]]
) -> None:
    with loaded_ahead("a search"):
        new()(3.375, X)
    (listed,) = folder.glob("programs/*/used/*")
    (name,) = listed.read_text().split()
    for text in (b"\xff\xfe", b"../../passwords", f"{'0' * 64}\n{name}\n{name[:-1]}".encode()):
        listed.write_bytes(text)
        release_programs()
        with loaded_ahead("a search"):
            np.testing.assert_array_equal(new()(3.375, X), 3.375 * X)
        assert listed.read_text() == name
    assert traced == [3.375] and performance().programs == 1


def test_programs_not_used_for_longest_leave_the_memory(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(persistent_jit, "MOST_HELD", 6)
    monkeypatch.setattr(persistent_jit, "LEFT_HELD", 4)
    release_programs()
    program, other, x = new(), new(), np.ones(2, np.float32)
    for slope in range(12):
        program(float(slope), x)
        np.testing.assert_array_equal(other(0.5, x), 0.5 * x)  # always in use
        assert len(persistent_jit._recent) <= 6
    # 13 programs were made and at most six stay; the one that is always in use was made once.
    assert len(program) <= 5 and len(other) == 1
    assert (program.programs_made, other.programs_made) == (12, 1)
    assert traced.count(0.5) == 1 and len(files(folder)) == 13
    np.testing.assert_array_equal(program(0.0, x), 0 * x)  # loaded again
    assert traced.count(0.0) == 1


def test_released_programs_leave_the_memory(folder: Path) -> None:
    release_programs()
    one, other, x = new(), new(), np.ones(2, np.float32)
    one(1.5, x)
    other(1.5, x)
    one.release_programs()
    assert (len(one), len(other)) == (0, 1)
    assert [held.place for held in persistent_jit._recent] == [other._held]


@pytest.mark.parametrize("damage", ["cut", "a bit", "empty", "something else"])
def test_a_damaged_file_is_replaced(folder: Path, damage: str) -> None:
    x = np.arange(3, dtype=np.float32)
    new()(2.0, x)
    (file,) = files(folder)
    whole = file.read_bytes()
    flipped = bytearray(whole)
    flipped[len(whole) // 2] ^= 1
    file.write_bytes({"cut": whole[:40], "a bit": bytes(flipped), "empty": b""}.get(damage, b"text" * 100))
    np.testing.assert_array_equal(new()(2.0, x), 2 * x)
    assert len(traced) == 2 and files(folder) == [file]
    digest, content = file.read_bytes()[:32], file.read_bytes()[32:]
    assert hashlib.sha256(content).digest() == digest


def test_two_machines_with_other_units_have_other_programs() -> None:
    texts = [static_key(Units("m", "N", 10.0, size)) for size in (1e-3, 2e-3)]
    assert all(texts) and texts[0] != texts[1]


def test_folders_of_somebody_else_stay(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(program_files.FOLDER_VARIABLE, raising=False)
    monkeypatch.setattr(program_files, "_LOADED", time.time() + 3600.0)
    others = [tmp_path / name for name in ("thesis", "photos", "data", "more", "a", "b", "c")]
    for other in others:
        other.mkdir()
    keep_programs(tmp_path)
    try:
        new()(2.0, np.ones(1))
    finally:
        keep_programs(True)
    assert all(other.is_dir() for other in others) and len(list(tmp_path.iterdir())) == len(others) + 1


def test_what_was_not_used_for_long_is_deleted_first(folder: Path) -> None:
    program, x = new(), np.ones(2, np.float32)
    for slope in (2.0, 3.0, 4.0):
        program(slope, x)
    oldest, newer, newest = sorted(files(folder), key=lambda f: f.stat().st_mtime_ns)
    for age, file in enumerate((oldest, newest, newer)):
        os.utime(file, (1e9 + age, 1e9 + age))
    program_files._shrink(oldest.parent, newer.stat().st_size + newest.stat().st_size)
    assert set(files(folder)) == {newer, newest}


def test_what_jax_has_cached_is_stored_so_that_it_can_be_used(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """JAX may have cached a program of another version of this package, or one whose file here is lost."""
    x = np.arange(3.0, dtype=np.float32)

    def loaded() -> int:
        before = program_counts().loaded
        np.testing.assert_array_equal(new()(7.25, x), 7.25 * x)
        return program_counts().loaded - before

    assert [loaded() for _ in range(2)] == [0, 1]
    for version in ("another", "a third"):
        monkeypatch.setattr(program_files, "_SOURCE", version)
        # The first process gets the program from JAX, and cannot store it; the second one compiles it.
        assert [loaded() for _ in range(3)] == [0, 0, 1]


def test_a_program_with_linear_algebra_runs_in_a_process_that_has_compiled_none(tmp_path: Path) -> None:
    """Such a program calls a library that JAX registers only when it lowers a call of it."""
    code = """
import sys, json, numpy as np, jax.numpy as jnp
from rotflex_jax.runtime import persistent_jit, program_files
program_files._LOADED += 3600.0
program_files.keep_programs(sys.argv[1])
program = persistent_jit.PersistentJit(lambda A, b: jnp.linalg.solve(A, b), static=0)
A = np.array([[2.0, 1.0], [1.0, 3.0]], np.float32)
print(json.dumps(program(A, np.array([3.0, 4.0], np.float32)).tolist()))
"""
    for _ in range(2):
        run = subprocess.run(
            [sys.executable, "-c", code, str(tmp_path)], capture_output=True, text=True, check=True
        )
        np.testing.assert_allclose(json.loads(run.stdout), [1.0, 1.0], rtol=1e-6)
    assert len([f for f in tmp_path.glob("*/*") if f.is_file()]) == 1


def test_nothing_is_kept_of_source_that_changed_under_the_process(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(program_files, "_LOADED", 0.0)
    assert new()(2.0, np.ones(1))[0] == 2.0
    assert not files(folder)


def test_nothing_is_stored_where_none_is_to_be_kept(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    keep_programs(False)
    try:
        assert new()(2.0, np.ones(1))[0] == 2.0
    finally:
        keep_programs(True)
    monkeypatch.setenv("ROTFLEX_PROGRAMS", "off")
    assert new()(2.0, np.ones(1))[0] == 2.0
    assert not files(folder)


@pytest.mark.parametrize("kept", [True, False])
def test_a_program_runs_on_constants_inside_of_another_program(folder: Path, kept: bool) -> None:
    keep_programs(folder if kept else False)
    try:
        program = new()
        for x in (1.0, 2.0):  # made in the first trace, in memory in the second
            outer = jax.jit(lambda given, x=x: given + program(x, np.ones(1))[0])
            assert outer(1.0) == 1.0 + x
    finally:
        keep_programs(True)


def test_a_folder_may_be_chosen_and_the_usual_one_is_the_users(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv(program_files.FOLDER_VARIABLE, raising=False)
    monkeypatch.setattr(program_files, "_LOADED", time.time() + 3600.0)
    before = jax.config.values["jax_compilation_cache_dir"]
    jax.config.update("jax_compilation_cache_dir", None)
    try:
        usual = programs_folder()
        assert usual is not None and usual.parents[1] == Path(pooch.os_cache("rotflex_jax"))
        keep_programs(tmp_path)
        new()(2.0, np.ones(1))
        assert len([f for f in tmp_path.glob("*/*") if f.is_file()]) == 1
        found = performance()
        assert (found.folder, found.programs) == (tmp_path, 1) and found.size > 0
        assert str(tmp_path) in str(found)
    finally:
        keep_programs(True)
        jax.config.update("jax_compilation_cache_dir", before)


LOOPS = """
import sys, os
if "first" in sys.argv:
    import jax, jax.numpy as jnp
    loop = jax.jit(lambda c: jax.lax.scan(lambda c, _: (jnp.tanh(c), None), c, None, length=1000))
    print("small_call" in loop.lower(jnp.ones(400)).compile().as_text())
import rotflex_jax as rf
print(rf.performance().fast_loops)
print("XLA_FLAGS" in os.environ)
"""


@pytest.mark.parametrize("when", ["last", "first"])
def test_loops_are_fast_unless_jax_has_started_before(when: str) -> None:
    """If JAX has started before, its own default holds; newer versions fuse small loops by default."""
    clean = {k: v for k, v in os.environ.items() if k != "XLA_FLAGS"}
    run = subprocess.run(
        [sys.executable, "-c", LOOPS, when], capture_output=True, text=True, check=True, env=clean
    )
    *alone, found, left = run.stdout.split()
    assert [found] == (alone or ["True"]) and left == "False"


def test_old_versions_are_deleted(folder: Path) -> None:
    for age in range(9):
        old = folder / "programs" / f"{age:032x}"
        old.mkdir(parents=True)
        os.utime(old, (1e9 - age, 1e9 - age))
    new()(2.0, np.ones(1))
    left = {f.name for f in (folder / "programs").iterdir()}
    assert {f"{age:032x}" for age in range(5)} < left and len(left) == 6


def test_the_text_of_a_structure_identifies_it() -> None:
    joint = rf.joints.paper()
    mechanisms = [
        joint,
        joint + Coulomb(at="hub"),
        joint + Coulomb(at="arm"),
        joint + LuGre(at="hub"),
        dataclasses.replace(joint, outputs=joint.outputs[:1]),
    ]
    texts = [static_key(m.structure) for m in mechanisms]
    assert all(texts) and len(set(texts)) == len(texts)
    numbers = joint.with_values(2 * joint.values)
    assert static_key(numbers.structure) == texts[0]  # the text does not depend on values of parameters
    assert static_key(Exponential(order=2)) != static_key(Exponential(order=4))


@dataclasses.dataclass(frozen=True)
class Own(Force):
    name = "own"
    factor: float = parameter(1.0, unit="N m")

    def force(self, position, speed, voltage):
        return -self.factor * speed


def test_nothing_is_kept_of_a_law_from_elsewhere() -> None:
    assert not static_key((rf.joints.paper() + Own(at="hub")).structure)


def in_two_processes(script: str, folder: Path) -> list[Any]:
    """What a script prints as JSON in two processes, one after the other, with one folder of programs."""
    command = [sys.executable, "-c", script, str(folder)]
    runs = [subprocess.run(command, capture_output=True, text=True, check=True) for _ in range(2)]
    return [json.loads(run.stdout.splitlines()[-1]) for run in runs]


class Doubled(Bank):
    """A bank of a user: its law is not in the source of this package."""

    factor: float = eqx.field(static=True)
    size = property(lambda self: 1)
    names = property(lambda self: ("twice",))
    reach = property(lambda self: 1)

    def respond(self, u: jax.Array) -> jax.Array:
        return self.factor * u[:, None]


def test_the_structure_of_an_argument_is_part_of_its_program(folder: Path) -> None:
    u = np.random.default_rng(0).normal(size=20)
    bases = [Delays(3), Delays(3, first=1), Volterra(Delays(3), 1), Volterra(Delays(3), 2)]
    bases += [Orthonormal((0.5,)), Orthonormal((0.5, 0.4))]

    def respond(part: Traced, u: jax.Array) -> jax.Array:
        return part.respond(u)

    with double_precision():
        for _ in range(2):  # from the source, then from disk
            program = PersistentJit(respond, static=0)
            for basis in bases:
                np.testing.assert_allclose(program(basis, u), basis.respond(jnp.asarray(u)), atol=1e-12)
            assert len(files(folder)) == len(program) == len(bases)
        # Only numbers differ, so that the program is the same.
        np.testing.assert_allclose(program(Orthonormal((0.7,)), u)[:, 0], 0.51**0.5 * ar(0.7, u), atol=1e-12)
        assert len(program) == len(bases)
        for bank in (Doubled(2.0), Volterra(Doubled(3.0), 1)):
            np.testing.assert_allclose(program(bank, u)[:, -1], (2.0 + isinstance(bank, Volterra)) * u)
        assert len(program) == len(bases) + 2 and len(files(folder)) == len(bases)
    tree = jax.tree.structure({Rule(1): 0.0})
    assert "Rule" in str(tree) and not program_files.tree_key(tree)


@dataclasses.dataclass(frozen=True, order=True)
class Rule:
    """A static value of a user."""

    a: int


DEVICES = """
import jax
jax.config.update("jax_num_cpu_devices", 2)
import numpy as np
import rotflex_jax as rf
from rotflex_jax.basis import Orthonormal
u, bank = np.arange(4.0), Orthonormal((0.5,))
on = [bank.with_parameters(jax.device_put(bank.parameters, d)).outputs(u) for d in jax.devices()]
print(len(on), np.array_equal(*on))
"""


def test_arrays_on_another_device_run_there() -> None:
    done = subprocess.run([sys.executable, "-c", DEVICES], capture_output=True, text=True, check=False)
    assert done.stdout.strip() == "2 True", done.stderr


def ar(a: float, u: np.ndarray) -> np.ndarray:
    """y[t] = a y[t-1] + u[t-1]"""
    return scipy.signal.lfilter([0.0, 1.0], [1.0, -a], u)


SERIES = """
import json, sys
import numpy as np
import rotflex_jax as rf
from rotflex_jax.basis import optimise_poles
from rotflex_jax.runtime import persistent_jit, program_files
program_files._LOADED += 3600.0
rf.keep_programs(sys.argv[1])
rng = np.random.default_rng(1)
u = rng.normal(size=(2, 400))
y = np.stack([np.cumsum(0.1 * u, axis=1), u], axis=2)
recordings = [rf.Recording(u=a, y=b, Ts=0.002) for a, b in zip(u, y)]
methods = ["volterra_lms", "volterra_lms_gradient", "volterra_kalman"]
found = rf.compare(recordings, methods, window_seconds=0.05)
bank, _ = optimise_poles(u[0], y[0, :, 0], [0.5], starts=1)
counts = persistent_jit.program_counts()
errors = {r.method: r.rmse for r in found.rows}
print(json.dumps([errors, bank.poles[0].real, counts.compiled, counts.loaded]))
"""


def test_a_comparison_of_series_in_a_second_process_compiles_nothing(tmp_path: Path) -> None:
    (*first, made, none), (*second, again, loaded) = in_two_processes(SERIES, tmp_path)
    assert first == second and len(first[0]) == 3
    assert none == again == 0 and loaded == made > 8


SECOND = """
import json, sys
import numpy as np
import rotflex_jax as rf
from rotflex_jax.runtime import program_files
program_files._LOADED += 3600.0
rf.enable_compilation_cache(sys.argv[1])
u = np.random.default_rng(1).normal(size=300)
model = rf.Model(rf.joints.paper())
from rotflex_jax.mechanism import step
count = []
advance = step._advance_smooth
step._advance_smooth = lambda *given: count.append(1) or advance(*given)
recording = rf.Recording(u=u, y=np.stack([np.cumsum(u), u], axis=1), Ts=0.002)
print(json.dumps([model.simulate(recording)[-1].tolist(), len(count)]))
"""


def test_a_simulation_in_a_second_process_is_the_same_and_traces_no_step(tmp_path: Path) -> None:
    (first, steps), (second, none) = in_two_processes(SECOND, tmp_path)
    assert first == second and steps > 0 and none == 0


class Pair(NamedTuple):
    twice: jax.Array
    left: jax.Array | None


def test_a_named_tuple_comes_back_from_disk_as_one(folder: Path) -> None:
    def pair(x: jax.Array) -> Pair:
        return Pair(2 * x, None)

    x = np.arange(3, dtype=np.float32)
    PersistentJit(pair, static=0)(x)
    assert len(files(folder)) == 1
    found = PersistentJit(pair, static=0)(x)
    assert isinstance(found, Pair) and found.left is None
    np.testing.assert_array_equal(found.twice, 2 * x)


def test_a_compiler_without_these_choices_compiles_as_it_likes(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    wished, known = persistent_jit._FOR_COMPILER, persistent_jit._options()
    assert known and known.items() <= wished.items()  # a version of XLA may have removed an option
    monkeypatch.setattr(persistent_jit, "_FOR_COMPILER", {"xla_no_such_option": False, **wished})
    persistent_jit._options.cache_clear()
    assert persistent_jit._options() == known
    np.testing.assert_array_equal(new()(2.0, np.ones(2, np.float32)), [2.0, 2.0])
    persistent_jit._options.cache_clear()


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="only Linux tells a process its maps")
def test_compiled_code_is_released_and_compiled_again():
    traces = []

    @jax.jit
    def double(x):
        traces.append(x)
        return 2 * x

    double(jnp.ones(3))
    assert not clear_compilation_caches(10**9)
    double(jnp.ones(3))
    assert len(traces) == 1
    assert clear_compilation_caches(1)
    assert double(jnp.ones(3)).tolist() == [2.0, 2.0, 2.0]
    assert len(traces) == 2
