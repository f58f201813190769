"""Damaged, hostile and unusual files: each is either read or refused with one sentence."""

import contextlib
import io
import json
import os
import re
import resource
import struct
import subprocess
import sys
import warnings
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pandas as pd
import pytest
import scipy.io
import scipy.sparse

from rotflex_jax.cli.arguments import check_distinct
from rotflex_jax.data import load, save_csv
from rotflex_jax.data.binary import columns_of_parquet, read_mat, table_from_parquet
from rotflex_jax.data.matlab import variables_of_mat
from rotflex_jax.data.tables import distinct
from rotflex_jax.effects import Coulomb
from rotflex_jax.effects.learned import LearnedTorque
from rotflex_jax.errors import InputError
from rotflex_jax.joints import paper
from rotflex_jax.models.model import Model
from rotflex_jax.text.files import write_file

N = 60
K = np.arange(N)
RUN: dict[str, Any] = {
    "t": 0.002 * K,
    "voltage": np.random.default_rng(3).normal(size=N),
    "theta": 0.3 * np.sin(K / 9),
    "alpha": 0.1 * np.cos(K / 4),
}


def refused(do: Callable[[], object], phrase: str) -> None:
    with pytest.raises(InputError) as caught:
        do()
    sentence = str(caught.value)
    assert re.search(phrase, sentence), sentence
    assert sentence.endswith(".") and "\n" not in sentence and len(sentence) < 400, sentence


def mat(values: dict[str, Any] = RUN, **how: Any) -> bytes:
    scipy.io.savemat(out := io.BytesIO(), values, **how)
    return out.getvalue()


RICH: dict[str, Any] = RUN | {
    "log": {"u": RUN["voltage"], "inner": {"name": "joint", "count": np.arange(5, dtype=np.int16)}},
    "cells": np.array([np.ones(3), "text", np.zeros((2, 2))], dtype=object),
    "sparse": scipy.sparse.csc_array(np.eye(4)),
    "z": np.exp(1j * K),
    "flag": np.array([True, False]),
    "words": np.array(["one", "three"]),
    "records": np.array([(1.0, 2), (3.0, 4)], dtype=[("a", "f8"), ("b", "i4")]),
    "none": np.zeros((0, 3)),
    "one": 7.0,
}


# -- MATLAB files up to version 7.2 --------------------------------------------------------------------


def alike(a: Any, b: Any) -> bool:
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(alike(a[k], b[k]) for k in a)
    if isinstance(a, list) or (isinstance(a, np.ndarray) and a.dtype == object):
        return len(a) == len(b) and all(map(alike, a, b))
    return np.array_equal(a, b) and np.asarray(a).dtype == np.asarray(b).dtype


@pytest.mark.parametrize("how", [{}, {"do_compression": True}, {"oned_as": "column"}])
def test_mat_file_is_read_as_scipy_reads_it(how: dict[str, Any], tmp_path: Path) -> None:
    path = tmp_path / "run.mat"
    path.write_bytes(mat(RICH, **how))
    expected = scipy.io.loadmat(path, simplify_cells=True)
    found = read_mat(path)
    assert set(RICH) - set(found) == {"sparse"}  # a sparse matrix is no signal
    for name, value in found.items():
        assert alike(value, expected[name]), name


def test_mat_file_of_version_4_is_read_as_scipy_reads_it(tmp_path: Path) -> None:
    path = tmp_path / "run.mat"
    path.write_bytes(
        mat(RUN | {"z": RICH["z"], "words": "two words", "short": K.astype(np.int16)}, format="4")
    )
    expected = scipy.io.loadmat(path, simplify_cells=True)
    for name, value in read_mat(path).items():
        assert alike(value, expected[name]), name


def test_mat_file_of_the_other_byte_order_is_read(tmp_path: Path) -> None:
    def element(kind: int, content: bytes) -> bytes:
        return struct.pack(">II", kind, len(content)) + content + bytes(-len(content) % 8)

    data = b"MATLAB 5.0 MAT-file".ljust(124) + b"\x01\x00MI"
    for name, values in RUN.items():
        flags, shape = element(6, struct.pack(">II", 6, 0)), element(5, struct.pack(">ii", N, 1))
        data += element(
            14, flags + shape + element(1, name.encode()) + element(9, values.astype(">f8").tobytes())
        )
    path = tmp_path / "run.mat"
    path.write_bytes(data)
    assert np.array_equal(load(path).u, RUN["voltage"])
    assert alike(read_mat(path)["theta"], scipy.io.loadmat(path, simplify_cells=True)["theta"].astype(float))


def test_no_byte_of_a_mat_file_can_do_harm() -> None:
    small = {"x": 1.0, "s": {"a": "text", "c": RICH["cells"]}, "m": RICH["sparse"]}
    for how in ({}, {"format": "4"}):
        data = mat({"x": 1.0, "text": "word"} if how else small, **how)
        for k in range(0 if how else 124, len(data)):
            for byte in (0, 5, 14, 0xFF):
                with contextlib.suppress(ValueError, OverflowError):
                    variables_of_mat(data[:k] + bytes([byte]) + data[k + 1 :], "run.mat", 10_000)


def test_mat_file_that_is_cut_is_refused_wherever_it_is_cut() -> None:
    data = mat({"text": "four words of text"})
    for k in range(129, len(data)):
        with pytest.raises(ValueError, match=r"inside a variable|are there"):
            variables_of_mat(data[:k], "run.mat", 10_000)


def test_nested_mat_file_is_refused(tmp_path: Path) -> None:
    inner: Any = 1.0
    for _ in range(60):
        inner = {"a": inner}
    (tmp_path / "run.mat").write_bytes(mat({"deep": inner}))
    refused(lambda: read_mat(tmp_path / "run.mat"), "too deep or too many")


def test_two_variables_of_one_name_are_refused(tmp_path: Path) -> None:
    data = mat({"x": K})
    (tmp_path / "run.mat").write_bytes(data + data[128:])
    refused(lambda: read_mat(tmp_path / "run.mat"), "two variables 'x'")


# -- what a file unpacks to ------------------------------------------------------------------------------


def npz(parts: dict[str, bytes], how: int = zipfile.ZIP_DEFLATED) -> bytes:
    with zipfile.ZipFile(out := io.BytesIO(), "w", how) as archive, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # about two equal names
        for name, data in parts.items():
            archive.writestr(name, data)
    return out.getvalue()


def npy(header: str, content: bytes = b"") -> bytes:
    text = header.encode() + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text + content


ZEROS = {"t": np.zeros(500_000)}


def zeros_hdf5(path: Path) -> None:
    with h5py.File(path, "w") as file:
        file.create_dataset("t", shape=(10**12,), dtype="f8", chunks=(1000,))  # no value is stored


def block_hdf5(path: Path) -> None:
    with h5py.File(path, "w") as file:
        how = {"maxshape": (None,), "chunks": (10**8,), "compression": "gzip"}
        file.create_dataset("t", shape=(10,), dtype="f8", **how)


PACKED: dict[str, tuple[str, Callable[[Path], object]]] = {
    "npz": ("run.npz", lambda path: np.savez_compressed(path, **ZEROS)),
    "mat": ("run.mat", lambda path: scipy.io.savemat(path, ZEROS, do_compression=True)),
    "hdf5": ("run.mat", zeros_hdf5),
    "hdf5 block": ("run.mat", block_hdf5),
    "parquet": ("run.parquet", lambda path: pd.DataFrame(ZEROS).to_parquet(path)),
    "text": ("run.csv", lambda path: path.write_bytes(b"t\n" + b"0\n" * 600_000)),
}


@pytest.mark.parametrize("kind", PACKED)
def test_what_unpacks_to_too_much_is_refused(kind: str, tmp_path: Path) -> None:
    name, write = PACKED[kind]
    write(tmp_path / name)
    refused(lambda: load(tmp_path / name, max_bytes=1_000_000), r"more than the 0\.001 GB .* max_bytes")


def test_limit_counts_all_variables_of_a_mat_file(tmp_path: Path) -> None:
    values = {f"x{k}": np.zeros(50_000) for k in range(4)}
    scipy.io.savemat(tmp_path / "run.mat", values, do_compression=True)
    refused(lambda: load(tmp_path / "run.mat", max_bytes=1_000_000), "max_bytes")
    assert len(read_mat(tmp_path / "run.mat", 2_000_000)) == 4


# -- NPZ ------------------------------------------------------------------------------------------------

CLAIMED = "{{'descr': '<f8', 'fortran_order': False, 'shape': {}}}"
GOOD_NPY = npy(CLAIMED.format("(60,)"), RUN["t"].tobytes())


def flagged(data: bytes, flag: int) -> bytes:
    """The archive with a flag set in both headers of its first part."""
    found = bytearray(data)
    found[6] |= flag
    found[data.index(b"PK\1\2") + 8] |= flag
    return bytes(found)


def damaged(data: bytes) -> bytes:
    return data[:60] + bytes(b ^ 0xFF for b in data[60:90]) + data[90:]


BAD_NPZ = {
    "compressed part": damaged(npz({"t.npy": GOOD_NPY * 3})),
    "encrypted": flagged(npz({"t.npy": GOOD_NPY}), 1),
    "patched": flagged(npz({"t.npy": GOOD_NPY}), 0x20),
    "header": npz({"t.npy": npy("{'descr': '<f8', 'shape': (60")}),
    "no array": npz({"t.npy": b"hello"}),
    "claimed shape": npz({"t.npy": npy(CLAIMED.format("(1000000000000,)"))}),
    "claimed width": npz({"t.npy": npy("{'descr': '<U999999999', 'fortran_order': False, 'shape': ()}")}),
    "negative shape": npz({"t.npy": npy(CLAIMED.format("(-1, -60)"))}),
    "cut": npz({"t.npy": GOOD_NPY})[:-30],
}


@pytest.mark.parametrize("kind", BAD_NPZ)
def test_npz_that_is_damaged(kind: str, tmp_path: Path) -> None:
    (tmp_path / "run.npz").write_bytes(BAD_NPZ[kind])
    refused(lambda: load(tmp_path / "run.npz"), "cannot be read as an NPZ file")


def test_empty_array_that_claims_columns_is_left_out(tmp_path: Path) -> None:
    claimed = npy(CLAIMED.format("(0, 1000000000000)"))
    (tmp_path / "run.npz").write_bytes(npz({"t.npy": GOOD_NPY, "none.npy": claimed}))
    refused(lambda: load(tmp_path / "run.npz"), "it has t: ")


# -- MATLAB 7.3 -----------------------------------------------------------------------------------------


def hdf5(path: Path, edit: Callable[[Any], object]) -> Path:
    with h5py.File(path, "w") as file:
        for name, value in RUN.items():
            file[name] = value[None]
        edit(file)
    return path


def empty(file: Any) -> None:
    file["nothing"] = np.zeros(2, dtype=np.uint64)  # the shape of the empty array
    file["nothing"].attrs["MATLAB_empty"] = np.uint8(1)


HARMLESS: dict[str, Callable[[Any], object]] = {
    "named type": lambda file: file.__setitem__("type", np.dtype("f8")),
    "words": lambda file: file.create_dataset("words", data=["one", "two"]),
    "empty": empty,
    "nothing stored": lambda file: file.__setitem__("void", h5py.Empty("f8")),
    "soft link": lambda file: file.__setitem__("again", h5py.SoftLink("/theta")),
    "link to nothing": lambda file: file.__setitem__("again", h5py.SoftLink("/no/such")),
}


@pytest.mark.parametrize("kind", HARMLESS)
def test_hdf5_with_more_than_signals_is_read(kind: str, tmp_path: Path) -> None:
    path = hdf5(tmp_path / "run.mat", HARMLESS[kind])
    assert np.array_equal(load(path).u, RUN["voltage"])
    refused(lambda: load(path, input="nothing"), "it has alpha, t, theta, voltage:")


def test_hdf5_does_not_lead_to_another_file(tmp_path: Path) -> None:
    other = hdf5(tmp_path / "other.mat", lambda file: None)
    path = hdf5(
        tmp_path / "run.mat", lambda file: file.__setitem__("far", h5py.ExternalLink(other, "/theta"))
    )
    refused(lambda: load(path, input="far"), "no column 'far'")
    with h5py.File(path, "a") as file:
        file.create_virtual_dataset("far2", layout := h5py.VirtualLayout(shape=(N,), dtype="f8"))
        layout[:] = h5py.VirtualSource(other, "theta", shape=(1, N))[0]
        file.create_virtual_dataset("far3", layout)
    refused(lambda: load(path), "keeps '/far.' in another file")


def circle(file: Any) -> None:
    file.create_group("a")["again"] = file["/"]


def deep(file: Any) -> None:
    file.create_group("/".join("a" * 60))


@pytest.mark.parametrize(
    ("edit", "said"), [(circle, "stands in two places|two"), (deep, "within one another")]
)
def test_hdf5_without_end_is_refused(edit: Callable[[Any], object], said: str, tmp_path: Path) -> None:
    refused(lambda: load(hdf5(tmp_path / "run.mat", edit)), said)


# -- Parquet --------------------------------------------------------------------------------------------


def test_long_words_of_parquet_are_not_unpacked_row_by_row(tmp_path: Path) -> None:
    words = ["x" * 100_000] * N
    pd.DataFrame(RUN | {"word": words}).to_parquet(tmp_path / "run.parquet")
    table = table_from_parquet(tmp_path / "run.parquet", 1_000_000)
    assert len({id(word) for word in table.columns["word"]}) == 1


def test_parquet_with_a_damaged_description_does_not_end_the_interpreter(tmp_path: Path) -> None:
    pd.DataFrame(RUN).to_parquet(tmp_path / "run.parquet")
    data = (tmp_path / "run.parquet").read_bytes()
    start = len(data) - 8 - int.from_bytes(data[-8:-4], "little")
    for k in range(start, min(start + 300, len(data) - 8)):
        (tmp_path / "run.parquet").write_bytes(data[:k] + bytes([data[k] ^ 0x14]) + data[k + 1 :])
        with contextlib.suppress(ValueError):
            columns_of_parquet(tmp_path / "run.parquet")


def test_whole_numbers_that_no_float_holds_are_refused() -> None:
    frame = pd.DataFrame(RUN)
    frame["theta"] = [10**400] * N
    refused(lambda: load(frame), "'theta' holds '1000+' at row 0")


# -- text -----------------------------------------------------------------------------------------------


def text(digits: str = "%.6f", end: str = "\n") -> str:
    out = io.StringIO()
    np.savetxt(out, np.column_stack(list(RUN.values())), digits, ",", header=",".join(RUN), comments="")
    return out.getvalue().rstrip("\n") + end


LINES = text().splitlines()
BAD_TEXT: dict[str, tuple[bytes, str]] = {
    "long cell": (
        text().replace("0.002000", '"' + "x" * 140_000 + '"').encode(),
        "field larger than field limit",
    ),
    "long header": (("x" * 140_000 + "," + text()).encode(), "field larger than field limit"),
    "long name": (("x" * 100_000 + "\n1\n").encode(), r"it has x{37}\.\.\.:"),
    "400 digits": (text().replace("0.004000", "9" * 400).encode(), "'t' is inf at line 4"),
    "underscore": (text().replace("0.004000", "0.00_4").encode(), "holds '0.00_4' at line 4"),
    "UTF-16": (text().encode("utf-16"), "UTF-16"),
    "UTF-16 without mark": (text().encode("utf-16-le"), "UTF-16"),
    "UTF-16 of the other order": (text().encode("utf-16-be"), "UTF-16"),
    "Latin-1": (
        text().replace("theta", "theta [°]").encode("latin-1"),
        "line 1 has the byte 0xb0, .*; save it as UTF-8",
    ),
    "Latin-1 below": ((text() + "0,0,0,ü\n").encode("latin-1"), "line 62 has the byte 0xfc, .*as UTF-8"),
    "no text at all": (b"\x01\xb0\x02" * 99, r"cannot be read as text in UTF-8 \(.*damaged"),
    "zero byte": (text().replace("0.004000", "0.0\0").encode(), "zero byte in line 4"),
    "cut number": (text(end="")[:-2].encode(), r"ends inside line 61, with '-?0\.\d{4}' .* 6 decimals"),
    "cut exponent": (text("%.3e", end="")[:-1].encode(), "ends inside line 61"),
    "without exponent": (text("%.3e", end="")[:-4].encode(), "ends inside line 61"),
    "cut row": (text(end="").rsplit(",", 1)[0].encode(), "has 3 cells in line 61"),
}


@pytest.mark.parametrize("kind", BAD_TEXT)
def test_text_that_is_damaged(kind: str, tmp_path: Path) -> None:
    content, phrase = BAD_TEXT[kind]
    (tmp_path / "run.csv").write_bytes(content)
    refused(lambda: load(tmp_path / "run.csv"), phrase)


def test_last_number_that_may_be_cut_is_a_note(tmp_path: Path) -> None:
    path = tmp_path / "run.csv"
    for digits in ("%.6f", "%.17g", "%.3e", "%g"):
        path.write_text(text(digits, end=""))
        note = load(path).findings[-1]
        assert (note.kind, note.channel, note.severity) == ("cut", "alpha", "note")
        assert LINES[-1][-3:] in note.message or digits != "%.6f"
        assert "cut" not in [f.kind for f in load(path).slice(0, 55).findings]
        path.write_text(text(digits))
        assert "cut" not in [f.kind for f in load(path).findings]


def test_time_that_hardly_advances_is_refused() -> None:
    stamps = 5e-324 * K
    without = pd.DataFrame(RUN).drop(columns="t")
    refused(lambda: load(without.assign(t=stamps)), "positive number of seconds, but is 5e-324")
    refused(lambda: load(without, Ts=5e-324), "positive number of seconds, but is 5e-324")
    stamps[-1] = 1.0
    refused(lambda: load(without.assign(t=stamps)), "'t' has a gap of 1 s")


class Counted(str):
    """Text that counts how often it is compared."""

    compared = 0

    def __eq__(self, other: object) -> bool:
        Counted.compared += 1
        return str(self) == str(other)

    __hash__ = str.__hash__


def test_header_is_checked_in_proportion_to_its_length() -> None:
    names = [Counted(f"x{k}") for k in range(2000)]
    assert distinct(names, "run.csv") == names
    assert Counted.compared < 10 * len(names)
    refused(lambda: distinct([*names, "x7"], "run.csv"), "more than one column 'x7'")


# -- paths ----------------------------------------------------------------------------------------------


def test_paths_that_are_no_file(tmp_path: Path) -> None:
    (tmp_path / "a.csv").symlink_to(tmp_path / "b.csv")
    (tmp_path / "b.csv").symlink_to(tmp_path / "a.csv")
    refused(lambda: load(tmp_path / "a.csv"), "a.csv does not exist .*links")
    check_distinct([tmp_path / "a.csv"], [])
    refused(lambda: load(tmp_path / ("x" * 300 + ".csv")), "does not exist|name too long")
    refused(lambda: load("run\0.csv"), "does not exist")
    os.mkfifo(tmp_path / "pipe.csv")
    refused(lambda: load(tmp_path / "pipe.csv"), "is a device or a pipe")


# -- models ---------------------------------------------------------------------------------------------


def saved_model(path: Path) -> dict[str, Any]:
    model = Model(paper()) + Coulomb(at="hub", level=0.01) + LearnedTorque(at="arm", count=(1, 4))
    return json.loads(model.save(path).read_text())


BAD_MODEL: dict[str, Callable[[dict[str, Any]], object]] = {
    "text for a number": lambda d: d["data"].update(Ts="0.002"),
    "negative period": lambda d: d["data"].update(Ts=-1.0),
    "fraction of a sample": lambda d: d["data"].update(n_init=1.5),
    "flag for a number": lambda d: d["mechanism"]["effects"][0]["parameters"]["inertia"].update(value=True),
    "number for a flag": lambda d: d["mechanism"]["effects"][0]["parameters"]["inertia"].update(trusted=1),
    "list for an object": lambda d: d.update(mechanism=[]),
    "list for a name": lambda d: d["mechanism"]["effects"][0].update(effect=["inertia"]),
    "many substeps": lambda d: d["solver"].update(substeps=10**9),
    "no substeps": lambda d: d["solver"].update(substeps=0),
    "unknown input": lambda d: d["solver"].update(between="sometimes"),
    "unknown solver setting": lambda d: d["solver"].update(speed=3),
    "many splines": lambda d: d["mechanism"]["effects"][-1]["settings"].update(count=[1, 10**9], weights=[]),
    "units": lambda d: d["mechanism"].update(units=["rad", "N m", 1.0]),
    "gates": lambda d: d.update(gates=["on"]),
    "covariance": lambda d: d.update(covariance={"names": ["a"], "matrix": [["x"]]}),
}


@pytest.mark.parametrize("kind", BAD_MODEL)
def test_model_file_that_was_changed(kind: str, tmp_path: Path) -> None:
    data = saved_model(tmp_path / "model.json")
    BAD_MODEL[kind](data)
    (tmp_path / "model.json").write_text(json.dumps(data))
    refused(lambda: Model.load(tmp_path / "model.json"), "incomplete or was changed by hand")


def test_model_file_with_a_value_beyond_a_float(tmp_path: Path) -> None:
    data = saved_model(tmp_path / "model.json")
    data["mechanism"]["effects"][0]["parameters"]["inertia"].update(value=10**400)
    (tmp_path / "model.json").write_text(json.dumps(data))
    refused(lambda: Model.load(tmp_path / "model.json"), "model.json: .*inertia=10+.* needs a finite value")


@pytest.mark.parametrize("content", ["[" * 100_000, '{"kind": ' + "9" * 5000 + "}", "\udcff", '{"a": 1'])
def test_model_file_that_is_no_json(content: str, tmp_path: Path) -> None:
    (tmp_path / "model.json").write_bytes(content.encode(errors="surrogateescape"))
    refused(lambda: Model.load(tmp_path / "model.json"), "is not JSON")


def test_model_file_that_cannot_be_read(tmp_path: Path) -> None:
    refused(lambda: Model.load(tmp_path), "cannot be read")
    with (tmp_path / "model.json").open("wb") as file:
        file.truncate(60_000_000)
    refused(lambda: Model.load(tmp_path / "model.json"), "too large for a model file")


# -- writing --------------------------------------------------------------------------------------------


def test_old_file_stays_where_the_new_one_finds_no_room(tmp_path: Path) -> None:
    recording = load(pd.DataFrame(RUN))
    path = save_csv(recording, tmp_path / "run.csv")
    before = path.read_bytes()
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, limits[1]))
    try:
        refused(lambda: save_csv(recording, path), "run.csv cannot be written .*make space")
        refused(lambda: Model(paper()).save(path), "run.csv cannot be written")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert path.read_bytes() == before
    assert os.listdir(tmp_path) == ["run.csv"]


def test_file_is_written_through_a_link_and_into_a_device(tmp_path: Path) -> None:
    (tmp_path / "real.txt").write_text("old")
    (tmp_path / "real.txt").chmod(0o640)
    (tmp_path / "link.txt").symlink_to("real.txt")
    write_file(tmp_path / "link.txt", "new")
    assert (tmp_path / "real.txt").read_text() == "new"
    assert (tmp_path / "real.txt").stat().st_mode & 0o777 == 0o640
    assert (tmp_path / "link.txt").is_symlink()
    write_file(os.devnull, b"gone")
    refused(lambda: write_file("/dev/full", "x"), "/dev/full cannot be written")
    refused(lambda: write_file(tmp_path, "x"), "cannot be written")
    refused(
        lambda: Model(paper()).save(tmp_path / "none" / "a.json"),
        "a.json cannot be written, since the folder .*none does not exist; create it or name another",
    )


# -- random changes ------------------------------------------------------------------------------------------


def test_changed_files_are_read_or_refused() -> None:
    script = Path(__file__).resolve().parents[1] / "benchmarks" / "fuzz_input.py"
    done = subprocess.run(
        [sys.executable, str(script), "--count", "40"], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
