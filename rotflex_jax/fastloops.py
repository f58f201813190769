"""Two settings that make JAX several times quicker on a CPU, for programs to switch on.

Both are global, so importing rotflex_jax never touches them: the command line calls them, and so
may a benchmark or the first cell of a notebook.
"""

import os
from pathlib import Path

_OPTION = "xla_cpu_small_while_loop_byte_threshold"


def enable_fast_loops(limit: int = 262144) -> bool:
    """Ask XLA to compile a small loop on the CPU into one function, not one call per operation.

    A scan over the samples of a recording spends most of its time starting operations. XLA fuses a
    whole loop as long as one turn touches fewer bytes than a limit, 1024 unless told otherwise.
    Raising the limit makes simulating and fitting a joint five to twelve times faster.

    Do not call it in a library: `XLA_FLAGS` holds for the whole process. XLA reads it at the first
    use of a device, so a call after the first array is without effect.

    Args:
        limit: Bytes one turn of a loop may touch [bytes]. Far larger values slow down loops with
            big matrix products.

    Returns:
        True if `XLA_FLAGS` now carries the option. A value the user chose is kept, and nothing is
        changed where `XLA_FLAGS` names a file of flags.

    Example:
        >>> import os
        >>> kept = os.environ.pop("XLA_FLAGS", None)
        >>> enable_fast_loops()
        True
        >>> os.environ["XLA_FLAGS"]
        '--xla_backend_extra_options=xla_cpu_small_while_loop_byte_threshold=262144'
        >>> _ = os.environ.pop("XLA_FLAGS") if kept is None else os.environ.update(XLA_FLAGS=kept)
    """
    flags = os.environ.get("XLA_FLAGS", "").strip()
    if _OPTION in flags:
        return True
    if flags and not flags.startswith("-"):
        return False
    # XLA merges several --xla_backend_extra_options, so the user's own stay in force.
    os.environ["XLA_FLAGS"] = f"{flags} --xla_backend_extra_options={_OPTION}={limit}".strip()
    return True


def enable_compilation_cache(folder: str | Path | None = None) -> Path | None:
    """Keep what JAX compiles on disk, so that the next run of the program starts quickly.

    Do not call it in a library: the setting holds for the whole process. Old entries are not
    removed; deleting the folder is safe at any time.

    Args:
        folder: Where to keep compiled code; the user's cache folder unless given. A folder that the
            user chose before (`JAX_COMPILATION_CACHE_DIR`) is kept, and so is the shortest compilation
            that is worth keeping (`JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS`); all are without it.

    Returns:
        The folder in use, or None where it cannot be written (then nothing is changed).
    """
    import jax

    chosen = jax.config.values["jax_compilation_cache_dir"]
    if folder is not None or not chosen:
        if folder is None:
            import pooch

            folder = Path(pooch.os_cache("rotflex_jax")) / "compiled"
        folder = Path(folder)
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError:
            return None
        if not os.access(folder, os.W_OK):
            return None
        jax.config.update("jax_compilation_cache_dir", str(folder))
    # Most programs compile in less than the second that JAX asks for, and a search needs dozens of them.
    if "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS" not in os.environ:
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    return Path(folder or chosen)


def quicken() -> None:
    """Both settings, for a program of its own, before it computes."""
    enable_fast_loops()
    enable_compilation_cache()
