"""The same work on several devices: rows of one array, spread over a mesh."""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

_ROWS = "rows"


def mesh_of(devices: Sequence[Any] | None = None) -> Mesh | None:
    """A row of devices, for `spread`.

    Args:
        devices: those of this process if None, unless `jax.default_device` names one. With
            `jax.distributed`, `jax.devices()` are those of all processes; then every process must make the
            same call with the same numbers.

    Returns:
        The mesh; None for a single device, which needs none.

    >>> mesh_of(jax.devices()[:1]) is None
    True
    """
    if devices is None and jax.config.values["jax_default_device"] is not None:
        return None
    chosen = jax.local_devices() if devices is None else list(devices)
    return Mesh(np.array(chosen), (_ROWS,)) if len(chosen) > 1 else None


def spread(function: Callable[..., Any], mesh: Mesh | None) -> Callable[..., Any]:
    """The same function, each device with its part of the rows of the first argument.

        spread(f, mesh)(rows, *shared) = f(rows, *shared)   to rounding

    For use inside `jax.jit`, with `mesh` static. The rows must not know of each other, and `function`
    must take any number of them. They are padded by the last one to a multiple of the devices, so a few
    rows more than devices cost a second turn of all. Not for rows that take microseconds: sending
    them costs more.

    Devices of one process do not wait for each other where they divide the rows. Otherwise, and over several
    processes, all get the whole at the end; XLA ends a program where one waits for another longer than a
    minute, so such rows must take alike.

    Args:
        function: of rows (K, ...) and of what all rows share; its results have one entry a row, (K, ...).
        mesh: from `mesh_of`; None leaves the function as it is.

    Returns:
        A function whose results every process has as a whole; between devices of one process they may lie in
        parts.
    """
    if mesh is None:
        return function

    def run(rows: Any, *shared: Any) -> Any:
        K = len(jax.tree.leaves(rows)[0])
        full = jnp.minimum(jnp.arange(-(-K // mesh.size) * mesh.size), K - 1)
        parts = jax.shard_map(
            function,
            mesh=mesh,
            in_specs=(PartitionSpec(_ROWS), *(PartitionSpec() for _ in shared)),
            out_specs=PartitionSpec(_ROWS),
            check_vma=False,  # a scan inside begins with the same carry on all devices
        )(jax.tree.map(lambda x: jnp.asarray(x)[full], rows), *shared)
        alone = all(device.process_index == jax.process_index() for device in mesh.devices.flat)
        if alone and len(full) == K:
            return parts
        whole = jax.lax.with_sharding_constraint(parts, NamedSharding(mesh, PartitionSpec()))
        return jax.tree.map(lambda x: x[:K], whole)

    return run
