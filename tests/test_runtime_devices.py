"""Rows spread over devices and processes: the results are the same, and each device computes its share."""

import json
import os
import socket
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import rotflex_jax as rf
from rotflex_jax.runtime.xla import mesh_of, spread

HERE = Path(__file__).parent
SURROUNDINGS = os.environ | {"PYTHONPATH": str(Path(rf.__path__[0]).parent)}
ROWS = 11


def run(program: str, *arguments: object) -> subprocess.Popen:
    """Start a program in a new process, since the number of devices is fixed for a process."""
    line = [sys.executable, str(HERE / program), *map(str, arguments)]
    return subprocess.Popen(line, env=SURROUNDINGS, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def said(process: subprocess.Popen) -> dict:
    out, err = process.communicate(timeout=300)
    assert process.returncode == 0, err
    return json.loads(out.splitlines()[-1])


def assert_same(found: dict, counts: list[int]) -> None:
    for count in counts:
        # Other shapes on a device may be vectorised in another order.
        np.testing.assert_allclose(found["spread"][str(count)], found["plain"], rtol=1e-10)
        share = -(-ROWS // count)
        assert found["where"][str(count)] == [k // share for k in range(ROWS)]
    assert found["changed"]
    assert found["compiled_again"] == 0


def test_a_sweep_on_two_and_on_eight_devices() -> None:
    assert_same(said(run("sweep_on_devices.py")), [2, 8])


def test_a_sweep_over_two_processes() -> None:
    with socket.socket() as place:
        place.bind(("127.0.0.1", 0))
        port = place.getsockname()[1]
    both = [run("sweep_on_devices.py", process, port) for process in (0, 1)]
    first, second = (said(process) for process in both)
    assert_same(first, [4])
    assert first["spread"] == second["spread"]


def test_fits_on_two_devices_end_where_those_on_one_do() -> None:
    found = said(run("fits_on_devices.py"))
    assert (found["devices"], found["waits"]) == ([2], [])
    for what in ("values", "std", "costs", "cut"):
        # Sums are computed in another order: an offset that is zero up to the noise has fewer equal digits.
        np.testing.assert_allclose(
            found["two"][what], found["one"][what], rtol=1e-7, atol=1e-10, err_msg=what
        )


def test_the_suite_itself_runs_on_one_device() -> None:
    """Programs for several devices set their number for the process, so they must not run when collected."""
    assert len(jax.local_devices()) == 1


def test_one_device_changes_nothing() -> None:
    def double(rows: jax.Array) -> jax.Array:
        return 2 * rows

    assert mesh_of(jax.devices()[:1]) is None
    assert spread(double, None) is double


def test_a_tree_of_rows_and_what_they_share() -> None:
    """On a mesh of one device, which `mesh_of` would not make."""
    mesh = jax.sharding.Mesh(np.array(jax.devices()[:1]), ("rows",))
    rows = {"a": np.arange(6.0).reshape(3, 2), "b": np.arange(3.0)}

    def line(rows: dict, slope: jax.Array) -> dict:
        return {"sum": rows["a"].sum(axis=1) + slope * rows["b"]}

    found = jax.jit(spread(line, mesh))(rows, jnp.float32(10.0))
    np.testing.assert_array_equal(found["sum"], [1.0, 15.0, 29.0])
