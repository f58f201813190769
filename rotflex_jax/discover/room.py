"""Room for compiled code: a process may hold only so many memory maps, and each program takes hundreds."""

from pathlib import Path

import jax

from rotflex_jax.mechanism import programs

# Linux allows 65530 unless told otherwise; beyond that the compiler ends the process. One search may add
# some 30000 where it tries many different structures.
MOST = 30_000


def make_room(most: int = MOST) -> bool:
    """Let go of all compiled code where the process holds many memory maps; it is compiled anew if needed.

    Args:
        most: Maps the process may hold.

    Returns:
        Whether code was let go. Never where the system does not tell (anywhere but on Linux).
    """
    maps = Path("/proc/self/maps")
    if not maps.exists() or maps.read_bytes().count(b"\n") < most:
        return False
    programs.forget()
    jax.clear_caches()
    return True
