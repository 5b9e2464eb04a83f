"""Room for compiled programs.

Each program holds memory maps, of which Linux gives a process 65 530. Where XLA gets no more it ends the process.
"""

import gc
from pathlib import Path
from typing import Any

import equinox as eqx
import jax

import scalarjit
from linkax.xla.users_line import warn

COMPILING = "/jax/core/compile/backend_compile_duration"  # what JAX tells its listeners before XLA compiles, and after
# Functions that let go of compiled programs, and of what they were made of.
CACHES = [eqx.clear_caches, jax.clear_caches, scalarjit.clear_caches]
ROOM = 10_000  # memory maps; long programs of XLA take some thousand, those of a mechanism fifty
# Programs that have so much room each, and are compiled before maps are counted again: to count 30 000 of them takes
# 25 ms, as long as to compile a small program.
_fitting = [0]
MAPS, LIMIT_OF_MAPS = Path("/proc/self/maps"), Path("/proc/sys/vm/max_map_count")


def watch_memory_maps() -> None:
    """Have `make_room` called before each compilation in this process."""
    jax.monitoring.register_scalar_listener(make_room)


def make_room(event: str = COMPILING, *_time: Any, **_what: Any) -> None:
    """Clear all caches of programs where too few memory maps are left for another program.

    **Raises:** `RuntimeError` where other things hold the maps. XLA would end the process.
    """
    if event != COMPILING:
        return
    if _fitting[0] > 0:
        _fitting[0] -= 1
        return
    if has_room():
        return
    clear_caches()
    limit = _limit_of_maps()
    remedy = f"raise their limit (sysctl -w vm.max_map_count={4 * limit})"
    if not has_room():
        raise RuntimeError(
            f"compiled programs in use and mapped files hold {_maps()} memory maps, of which this process may have "
            f"{limit}: too many to compile another program; hold fewer, {remedy}, or go on in another process"
        )
    warn(
        f"compiled programs held nearly all of the {limit} memory maps that this process may have: JAX's caches have "
        f"been cleared, and what is used again compiles again; to keep more programs {remedy}",
        RuntimeWarning,
    )


def clear_caches() -> None:
    """Let go of all compiled programs that are not in use."""
    for clear in CACHES:
        clear()
    gc.collect()


def has_room(more: int = 0) -> bool:
    """Whether memory maps are left for another program after `more` of them; true where the system does not tell."""
    try:
        limit = _limit_of_maps()
        left = limit - _maps() - min(ROOM, limit // 4)
    except (OSError, ValueError):
        return True
    _fitting[0] = max(left, 0) // ROOM
    return left >= more


def _maps() -> int:
    return MAPS.read_bytes().count(b"\n")


def _limit_of_maps() -> int:
    return int(LIMIT_OF_MAPS.read_text())
