"""Fuzz test: damaged files of every input format, damaged results of a fleet, and damaged command lines.

A file must either be read or be refused with an `InputError` of one sentence. A command line must end with
status 0, or with status 2 and one sentence.

    python benchmarks/fuzz_input.py                        # 2,000 files of each format
    python benchmarks/fuzz_input.py --count 200 --formats mat hdf5
    python benchmarks/fuzz_input.py --first 100000         # other files

Small valid files are made and then changed at random, also inside their compressed parts: single bits and
bytes, sizes of blocks, and blocks that are cut out, inserted or repeated. A separate process reads them
under limits of memory and time, because a fault may end it. The table counts the outcomes; the exit status
is 1 if there is any fault.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import io
import json
import os
import pickle
import random
import resource
import signal
import struct
import subprocess
import sys
import tempfile
import time
import zipfile
import zlib
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

SECONDS = 5
"""Longest time for one file [s]."""

MEMORY = 1_500_000_000
"""Largest memory for reading, in addition to that of the imported packages [bytes]."""

MAX_BYTES = 300_000_000
"""Value of `max_bytes` for the reader [bytes]."""

ALL_FAULTS = (
    *("short", "constant_input", "constant", "saturated", "units", "absolute", "swapped"),
    *("slow", "wrapped", "outliers", "frozen"),
)
"""Faults of signals that are accepted, so that reading does not stop at them."""


def columns(samples: int = 60) -> dict[str, np.ndarray]:
    """One small recording."""
    k = np.arange(samples)
    signals = np.random.default_rng(3).normal(size=samples), 0.3 * np.sin(k / 9), 0.1 * np.cos(k / 4)
    return dict(zip(("t", "voltage", "theta", "alpha"), (0.002 * k, *signals), strict=True))


def json_seeds() -> list[bytes]:
    """A list of samples beside a setting, where one value of a sample is a list; and lists under names."""
    found = {name: values.tolist() for name, values in columns().items()}
    samples = [dict(zip(found, row, strict=True)) for row in zip(*found.values(), strict=True)]
    more = [row | {"effort": [0.1, 0.2], "mode": "a"} for row in samples]
    return [json.dumps(content).encode() for content in ({"gain": 4, "entries": more}, found)]


def csv_seeds() -> list[bytes]:
    """With commas; with semicolons, decimal commas and a line of units; with spaces, after comments."""
    rows = np.column_stack(list(columns().values())).tolist()
    plain = ["t,voltage,theta,alpha", *(",".join(f"{x:.6g}" for x in row) for row in rows)]
    german = ["t;voltage;theta;alpha", "s;V;rad;rad", *(line.replace(".", "_") for line in plain[1:])]
    german = [line.replace(",", ";").replace("_", ",") for line in german]
    spaces = ["# a log", "# of a joint", *(line.replace(",", "  ") for line in plain)]
    return ["\n".join(lines).encode() + b"\n" for lines in (plain, german, spaces)]


def npz_seeds() -> list[bytes]:
    """An archive without and one with compression."""
    found = []
    for write in (np.savez, np.savez_compressed):
        write(out := io.BytesIO(), **columns(), log=np.ones((60, 3), np.float32), kind=np.array("run 7"))  # type: ignore[arg-type]
        found.append(out.getvalue())
    return found


def mat_seeds() -> list[bytes]:
    """Version 4; version 5 with structures, cells, text, sparse and complex matrices, also compressed."""
    import scipy.io
    import scipy.sparse

    plain = columns()
    rich = plain | {
        "log": {"u": plain["voltage"], "inner": {"name": "joint", "count": np.arange(5, dtype=np.int16)}},
        "cells": np.array([np.ones(3), "text", np.zeros((2, 2))], dtype=object),
        "sparse": scipy.sparse.csc_array(np.eye(4)),
        "z": np.exp(1j * np.arange(4)),
        "flag": np.array([True, False]),
        "records": np.array([(1.0, 2), (3.0, 4)], dtype=[("a", "f8"), ("b", "i4")]),
    }
    found = []
    for values, how in ((plain, {}), (plain, {"format": "4"}), (rich, {}), (rich, {"do_compression": True})):
        scipy.io.savemat(out := io.BytesIO(), values, **how)  # type: ignore[arg-type]
        found.append(out.getvalue())
    return [*found, timetable_seed()]


def timetable_seed() -> bytes:
    """Version 5 with a timetable and separate signals."""
    import matio
    import pandas as pd

    plain = columns()
    index = pd.to_timedelta(1000 * plain["t"], unit="ms")
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "run.mat"
        matio.save_to_mat(str(file), {"log": pd.DataFrame(plain, index=index), **plain}, version="v7")
        return file.read_bytes()


def hdf5_seeds() -> list[bytes]:
    """A file like those of MATLAB 7.3, and one with chunks, groups, a named type and a compound type."""
    import h5py

    found = []
    for rich in (False, True):
        with h5py.File(out := io.BytesIO(), "w", userblock_size=512) as file:
            for name, value in columns().items():
                chunks = {"chunks": (1, 16), "compression": "gzip", "shuffle": True} if rich else {}
                file.create_dataset(name, data=value[None], **chunks)
                file[name].attrs["MATLAB_class"] = np.bytes_("double")
            if rich:
                file["type"] = np.dtype("f8")
                group = file.create_group("log")
                group.attrs["MATLAB_class"] = np.bytes_("struct")
                group.create_dataset("u", data=np.ones((1, 60)))
                group.create_dataset("z", data=np.ones(3, dtype=[("real", "f8"), ("imag", "f8")]))
                group.create_dataset("words", data=["one", "two"])
                group["soft"] = h5py.SoftLink("/theta")
        found.append(b"MATLAB 7.3 MAT-file".ljust(512) + out.getvalue()[512:])
    return found


def xlsx_seeds() -> list[bytes]:
    """Two sheets, the first one empty, the second with a line of units."""
    import openpyxl

    book = openpyxl.Workbook()
    sheet = book.create_sheet("log")
    sheet.append(list(columns()))
    sheet.append(["s", "V", "rad", "rad"])
    for row in zip(*columns().values(), strict=True):
        sheet.append([float(x) for x in row])
    book.save(out := io.BytesIO())
    return [out.getvalue()]


def parquet_seeds() -> list[bytes]:
    """Columns of numbers; and also of text, lists, dates, and integers with gaps."""
    import pyarrow
    import pyarrow.parquet

    plain = pyarrow.table(columns())
    rich = plain.append_column("word", pyarrow.array(["a", "bc", "a"] * 20))
    rich = rich.append_column("list", pyarrow.array([[1, 2], [], None] * 20))
    rich = rich.append_column("gaps", pyarrow.array([1, None, 3] * 20))
    rich = rich.append_column("when", pyarrow.array([0] * 60, pyarrow.timestamp("us")))
    found = []
    for table, how in ((plain, {}), (rich, {"compression": "gzip"}), (rich, {"compression": "none"})):
        pyarrow.parquet.write_table(table, out := io.BytesIO(), **how)
        found.append(out.getvalue())
    return found


def tdms_seeds() -> list[bytes]:
    """Waveforms; and a channel of times with integers and text."""
    import nptdms

    found = []
    for waveform in (True, False):
        signals = columns() | ({} if waveform else {"count": np.arange(60), "word": ["a", "bc"] * 30})
        about = {"wf_increment": 0.002} if waveform else {"unit_string": "rad"}
        if waveform:
            del signals["t"]
        with nptdms.TdmsWriter(out := io.BytesIO()) as writer:
            for part in (slice(40), slice(40, None)):
                channels = [nptdms.ChannelObject("run", n, x[part], about) for n, x in signals.items()]
                writer.write_segment(channels)
        found.append(out.getvalue())
    return found


def mdf_seeds() -> list[bytes]:
    """One group without compression, and two groups with two kinds of compression."""
    import asammdf

    found = []
    for packed in (0, 1, 2):
        with asammdf.MDF(version="4.10") as file:
            signals = columns()
            t = signals.pop("t")
            file.append([asammdf.Signal(x, t, name=name, unit="rad") for name, x in signals.items()])
            if packed:
                file.append([asammdf.Signal(np.arange(9, dtype=np.int16), np.arange(9.0), name="slow")])
            file.save(out := io.BytesIO(), overwrite=True, compression=packed)
        found.append(out.getvalue())
    return found


def mcap_seeds() -> list[bytes]:
    """Messages with a number and messages with lists, with each kind of compression."""
    from mcap.writer import CompressionType
    from mcap_ros2.writer import Writer

    signals = columns()
    found = []
    for packed in CompressionType:
        writer = Writer(out := io.BytesIO(), compression=packed)
        plain = writer.register_msgdef("std_msgs/msg/Float64", "float64 data")
        lists = writer.register_msgdef("my/msg/Log", "float64[] values\nstring word\nint16[2] pair")
        for k, at in enumerate((1e9 * signals["t"]).astype(int).tolist()):
            for name in ("voltage", "theta", "alpha"):
                message = {"data": float(signals[name][k])}
                writer.write_message(f"/{name}", plain, message, log_time=at, publish_time=at)
            message = {"values": [1.0, 2.0], "word": "x", "pair": [1, 2]}
            writer.write_message("/log", lists, message, log_time=at, publish_time=at)
        writer.finish()
        found.append(out.getvalue())
    return found


def model_seeds() -> list[bytes]:
    """A small joint, and one with an effect, an estimate and a covariance."""
    from rotflex_jax.effects import Coulomb
    from rotflex_jax.joints import paper
    from rotflex_jax.models.model import Model
    from rotflex_jax.models.model_json import Saved, to_dict
    from rotflex_jax.parameters import Estimate

    joint = Model(paper())
    more = joint + Coulomb(at="hub", level=0.01)
    estimate = Estimate("hub.coulomb.level", 0.01, 0.001, (0.008, 0.012), "N m", True, "")
    rich = Saved(more, (estimate,), np.array([[1e-6]]), ("hub.coulomb.level",), 0.002, 20)
    return [json.dumps(to_dict(saved), indent=2).encode() for saved in (Saved(joint), rich)]


def fleet_seeds() -> list[bytes]:
    """Result files of a fleet: of a finished recording, and of a refused one."""
    from rotflex_jax.batch import storage

    parts = []
    for state, reason in (("done", ""), ("refused", "Nothing moves in it.")):
        found = {"name": "run", "source": "run.csv", "digest": DIGEST, "state": state, "reason": reason}
        found |= {"schema": storage.RESULT_SCHEMA, "seconds": 1.5, "result": None}
        if state == "done":
            errors = {"theta": 0.01, "alpha": 0.001}
            stage = {"held_out_rmse": errors, "held_out_rmse_windows": {"seconds": 2.0, **errors}}
            effect = {"effect": "coulomb", "port": "hub", "equivalent": [{"effect": "lugre", "port": "hub"}]}
            found["result"] = {"verdict": "found", "baseline": stage, "rounds": [effect | stage]}
            found["result"]["noise_floor"] = errors
        parts.append(json.dumps(found, indent=1).encode())
    return parts


DIGEST = "0" * 64
"""Digest of the one recording of the fleet."""

LINES = (
    "check run.csv --Ts 0.002 --degrees --accept short",
    "discover run.csv --split 0.7 --joint paper:stiffness=1.2 --json out.json --report page",
    "discover run.csv run.csv --held-out run.csv --test run.csv --calibrate 1.5 --save-model m.json",
    "discover run.csv --each --workers 2 --output theta --output alpha=alpha",
    "compare run.csv --methods arx,grey_box --quick --input voltage --time t",
    "simulate run.csv --add coulomb@hub:level=0.03 --fit run.csv --save sim.csv",
    "experiment --fit run.csv --between delay@input lag@input --voltage 5 --slew 3 --save next.csv",
    "export paper --to c --out model.h --Ts 0.002 --prefix joint",
    "reproduce --set Ts=0.05 --seed 3 --scenario S1",
    "effects --json",
    "data list",
    "--version",
)
TOKENS = (
    "-",
    "--",
    "",
    "=",
    "@",
    ":",
    "nan",
    "inf",
    "-1",
    "1e999",
    "9" * 400,
    "\x1b[2J",
    "\n",
    "[x]",
    "é\ud800",
)
TOKENS += (
    "--json",
    "--report",
    "/dev/null",
    ".",
    "/",
    "no/such",
    "x" * 5000,
    "--help",
    "coulomb@",
    "@hub",
    "paper:",
)


def command_seeds() -> list[bytes]:
    """Lines of the command line, as lists of words."""
    return [json.dumps(line.split()).encode() for line in LINES]


def mutated_command(data: bytes, pick: random.Random, text: bool) -> bytes:
    """A command line with words that are left out, doubled, replaced, changed or inserted."""
    words = json.loads(data)
    others = [word for line in LINES for word in line.split()]
    for _ in range(pick.choice((1, 1, 2, 4))):
        at, kind = pick.randrange(len(words) + 1), pick.randrange(5)
        if kind == 0:
            del words[at : at + 1]
        elif kind == 1:
            words[at:at] = words[at : at + pick.choice((1, 2))]
        elif kind == 2:
            words[at : at + 1] = [pick.choice(others)]
        elif kind == 3:
            words[at:at] = [pick.choice(TOKENS)]
        elif words:
            at %= len(words)
            cut = pick.randrange(len(words[at]) + 1)
            words[at] = words[at][:cut] + pick.choice(TOKENS) + words[at][cut + pick.randrange(3) :]
    # The fuzz test must not download anything.
    return json.dumps([word for word in words if not word.startswith("fetch")]).encode()


SIZES = (0, 1, 7, 0x7F, 0x80, 0xFF, 0xFFFF, 10**6, 2**31 - 1, 2**31, 2**32 - 1, 10**12, 2**63 - 1, 2**64 - 1)
WORDS = (b"1e999", b"-1", b"nan", b"Infinity", b"9" * 400, b"null", b"true", b'"', b"[" * 3000, b"1_0", b"{}")
WORDS += (b"\0", b"\xff\xfe", b",", b";", b"\n", b"x" * 140_000)


def mutated(data: bytes, pick: random.Random, text: bool) -> bytes:
    """One to three changes of a file."""
    found = bytearray(data)
    for _ in range(pick.choice((1, 1, 1, 2, 3))):
        # Headers at the start and the end of a file determine how it is read.
        reach = pick.choice((len(found), len(found), 400))
        at = min(pick.randrange(reach + 1), max(len(found) - 1, 0))
        at = len(found) - 1 - at if pick.random() < 0.25 else at
        width = pick.choice((1, 2, 4, 8, 30, 200))
        kind = pick.randrange(8 if text else 7)
        if kind == 0 and found:
            found[at] ^= 1 << pick.randrange(8)
        elif kind == 1 and found:
            found[at] = pick.choice((0, 1, 5, 9, 14, 15, 0x7F, 0x80, 0xFF, pick.randrange(256)))
        elif kind == 2:
            length, order = pick.choice((1, 2, 4, 8)), pick.choice(("little", "big"))
            at -= at % length if pick.random() < 0.7 else 0
            found[at : at + length] = (pick.choice(SIZES) % 256**length).to_bytes(length, order)  # type: ignore[arg-type]
        elif kind == 3:
            del found[at : None if pick.random() < 0.5 else at + width]
        elif kind == 4:
            found[at:at] = pick.randbytes(width)
        elif kind == 5:
            found[at:at] = found[at : at + width] * pick.choice((1, 2, 50))
        elif kind == 6:
            other = pick.randrange(len(found) + 1)
            found[at : at + width] = found[other : other + width]
        else:
            end = at = max(0, min(at, len(found)))  # the file may be empty
            while at and found[at - 1] not in b",;:[{ \n":
                at -= 1
            while end < len(found) and found[end] not in b",;:]} \n":
                end += 1
            found[at:end] = pick.choice(WORDS)
    return bytes(found)


def mutated_npz(data: bytes, pick: random.Random, text: bool) -> bytes:
    """Changes of the archive, or of a file in it, with a valid checksum."""
    if pick.random() < 0.4:
        return mutated(data, pick, text)
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        parts = {info.filename: archive.read(info) for info in archive.infolist()}
    name = pick.choice(list(parts))
    parts[name] = mutated(parts[name][:128], pick, pick.random() < 0.5) + parts[name][128:]
    with zipfile.ZipFile(out := io.BytesIO(), "w", pick.choice((0, 8))) as archive:
        for name, part in parts.items():
            archive.writestr(name, part)
    return out.getvalue()


def mutated_mat(data: bytes, pick: random.Random, text: bool) -> bytes:
    """Changes of the file, or of a compressed variable in it, with a valid checksum."""
    if pick.random() < 0.4 or struct.unpack("<I", data[128:132])[0] != 15:
        return mutated(data, pick, text)
    found, at, parts = data[:128], 128, []
    while at < len(data):
        size = struct.unpack("<I", data[at + 4 : at + 8])[0]
        parts.append(zlib.decompress(data[at + 8 : at + 8 + size]))
        at += 8 + size
    k = pick.randrange(len(parts))
    parts[k] = mutated(parts[k], pick, text)
    for part in parts:
        packed = zlib.compress(part)
        found += struct.pack("<II", 15, len(packed)) + packed
    return found


@dataclasses.dataclass(frozen=True)
class Format:
    """How files of a format are made and changed.

    Attributes:
        ending: Suffix of the file.
        seeds: Function that makes valid files.
        change: Function that changes a file.
        text: Whether the format is text.
    """

    ending: str
    seeds: Callable[[], list[bytes]]
    change: Callable[[bytes, random.Random, bool], bytes] = mutated
    text: bool = False


FORMATS = {
    "csv": Format(".csv", csv_seeds, text=True),
    "json": Format(".JSON", json_seeds, text=True),  # a file with the suffix .json is read as a model
    "npz": Format(".npz", npz_seeds, mutated_npz),
    "mat": Format(".mat", mat_seeds, mutated_mat),
    "hdf5": Format(".mat", hdf5_seeds),
    "parquet": Format(".parquet", parquet_seeds),
    "xlsx": Format(".xlsx", xlsx_seeds, mutated_npz),
    "tdms": Format(".tdms", tdms_seeds),
    "mdf": Format(".mf4", mdf_seeds),
    "mcap": Format(".mcap", mcap_seeds),
    "model": Format(".json", model_seeds, text=True),
    "fleet": Format(".row", fleet_seeds, text=True),
    "command": Format(".line", command_seeds, mutated_command),
}


def inputs(name: str, start: int, stop: int) -> Iterator[tuple[int, bytes]]:
    """Numbers and contents of changed files; a file depends on its number alone and can be made again."""
    form = FORMATS[name]
    seeds = form.seeds()
    for k in range(start, stop):
        pick = random.Random(f"{name} {k}")
        yield k, form.change(pick.choice(seeds), pick, form.text)


def read(path: Path) -> Any:
    """Reads a file by the function that a user would call."""
    if path.suffix == ".row":
        return read_fleet(path)
    if path.suffix == ".line":
        return run_command(path)
    if path.suffix == ".json":
        from rotflex_jax.models.model_json import read as read_model

        return read_model(path)
    from rotflex_jax.data.files import load

    return load(path, accept=ALL_FAULTS, max_bytes=MAX_BYTES)


def read_fleet(path: Path) -> Any:
    """A fleet that continues from this result file of an earlier call, up to its pages."""
    from types import SimpleNamespace
    from unittest import mock

    import rotflex_jax as rf
    from rotflex_jax.batch import storage

    def search(model: Any, train: Any, test: Any) -> Any:
        return SimpleNamespace(to_dict=lambda: json.loads(fleet_seeds()[0])["result"])

    folder = storage.created(path.with_name("fleet"))
    (folder / "recordings" / "run.json").write_bytes(path.read_bytes())
    run = made_once(path.with_name("run.csv"))
    with (
        mock.patch.object(storage, "digest_of_recording", lambda *_: DIGEST),
        mock.patch("rotflex_jax.batch.run._pickled", lambda *given: pickle.dumps((given[0], None))),
        mock.patch("rotflex_jax.batch.run.carry_out", lambda task: {**storage.record("broken")}),
    ):
        return rf.fleet(rf.joints.paper(), [run], folder=folder, workers=0, search=search)


def made_once(path: Path) -> Path:
    """Writes a valid recording to a file unless it exists, and returns its path."""
    if not path.exists():
        path.write_bytes(csv_seeds()[0])
    return path


def run_command(path: Path) -> Any:
    """Runs a command line in a folder with one recording; searches, fits and simulations are not run."""
    from unittest import mock

    import rotflex_jax as rf
    from rotflex_jax.cli import main
    from rotflex_jax.errors import InputError
    from rotflex_jax.models.model import Model

    def not_run(*given: Any, **options: Any) -> Any:
        raise InputError("That takes too long here.")

    made_once(path.with_name("run.csv"))
    words = json.loads(path.read_bytes())
    long = ("discover", "compare", "fit", "fleet")
    out, err = io.StringIO(), io.StringIO()
    with contextlib.ExitStack() as patched:
        for name in long:
            patched.enter_context(mock.patch.object(rf, name, not_run))
        for name in ("rotflex_jax.batch.fleet", "rotflex_jax.reproduce.reproduce"):
            patched.enter_context(mock.patch(name, not_run))
        patched.enter_context(mock.patch.object(Model, "simulate", not_run))
        patched.enter_context(contextlib.chdir(path.parent))
        patched.enter_context(contextlib.redirect_stdout(out))
        patched.enter_context(contextlib.redirect_stderr(err))
        try:
            main(words)
        except SystemExit as left:
            status = left.code
    if status not in (0, 2) or "Traceback" in err.getvalue():
        raise RuntimeError(f"status {status}: {err.getvalue()[-60:]}")
    last = (err.getvalue().splitlines() or [""])[-1]
    if status == 2 and not (last.startswith("rotflex: ") and last[-1] in ".?"):
        raise RuntimeError(f"no sentence: {last[-60:]}")
    if "\x1b" in err.getvalue() + out.getvalue():
        raise RuntimeError("a code of the terminal")
    return status


def outcome(path: Path) -> str:
    """Outcome of reading a file: "read", "refused", or "fault" with a description."""
    from rotflex_jax.errors import InputError

    try:
        read(path)
        return "read"
    except InputError as error:
        said = str(error)
        return "refused" if len(said) < 1500 and "\n" not in said else "fault: no sentence"
    except BaseException as error:
        where = error.__traceback__
        while (
            where is not None and where.tb_next is not None and "rotflex_jax" in str(where.tb_next.tb_frame)
        ):
            where = where.tb_next
        return f"fault: {type(error).__name__} {str(error)[:80]!r} line {where.tb_lineno if where else 0}"


def work(name: str, start: int, stop: int, folder: Path) -> None:
    """Reads changed files one by one in a worker process, and prints the outcome of each."""
    path = folder / f"input{FORMATS[name].ending}"
    for seed in FORMATS[name].seeds():  # imports the packages before memory is limited
        path.write_bytes(seed)
        assert outcome(path) == "read", (name, outcome(path))
    taken = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (taken + MEMORY, taken + MEMORY))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    for k, data in inputs(name, start, stop):
        path.write_bytes(data)
        print(k, "started", flush=True)
        signal.alarm(SECONDS)  # ends the process even if a library hangs
        said = outcome(path)
        signal.alarm(0)
        print(k, said, flush=True)


def run(name: str, count: int, folder: Path, first: int = 0) -> list[tuple[int, str]]:
    """Number and outcome of `count` files of a format, beginning with the number `first`."""
    found: dict[int, str] = {}
    environment = os.environ | {"JAX_PLATFORMS": "cpu", "PYTHONWARNINGS": "ignore"}
    while len(found) < count:
        arguments = ["--worker", name, str(first + len(found)), str(first + count), str(folder)]
        done = subprocess.run(
            [sys.executable, __file__, *arguments],
            capture_output=True,
            text=True,
            env=environment,
            check=False,
        )
        before = len(found)
        for line in done.stdout.splitlines():
            number, _, said = line.partition(" ")
            found[int(number)] = said
        if done.returncode and len(found) == before:
            raise RuntimeError(f"{name}: the process that reads ended at once: {done.stderr[-2000:]}")
        if done.returncode:
            name_of = signal.Signals(-done.returncode).name if done.returncode < 0 else str(done.returncode)
            found[first + len(found) - 1] = f"fault: process ended by {name_of}"
    return sorted(found.items())


def main() -> int:
    """The command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--count", type=int, default=2000, help="files of each format")
    parser.add_argument("--first", type=int, default=0, help="number of the first file: others are others")
    parser.add_argument("--formats", nargs="+", choices=list(FORMATS), default=list(FORMATS))
    parser.add_argument("--write", nargs=3, metavar=("FORMAT", "NUMBER", "FILE"), help="make one file again")
    parser.add_argument("--worker", nargs=4, help=argparse.SUPPRESS)
    chosen = parser.parse_args()
    if chosen.write:
        name, number, file = chosen.write
        Path(file).write_bytes(next(inputs(name, int(number), int(number) + 1))[1])
        return 0
    if chosen.worker:
        name, start, stop, folder = chosen.worker
        work(name, int(start), int(stop), Path(folder))
        return 0
    faults = 0
    print(f"{'format':10}{'files':>8}{'read':>8}{'refused':>9}{'faults':>8}{'seconds':>9}")
    for name in chosen.formats:
        began = time.perf_counter()
        with tempfile.TemporaryDirectory() as folder:
            ends = run(name, chosen.count, Path(folder), chosen.first)
        kinds = Counter(said.partition(":")[0] for _, said in ends)
        faults += kinds["fault"]
        took = time.perf_counter() - began
        counts = f"{kinds['read']:8}{kinds['refused']:9}{kinds['fault']:8}"
        print(f"{name:10}{len(ends):8}{counts}{took:9.0f}", flush=True)
        for said, often in Counter(s for _, s in ends if s.startswith("fault")).most_common(12):
            first = next(k for k, other in ends if other == said)
            print(f"    {often} times, first {first}: {said}", flush=True)
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main())
