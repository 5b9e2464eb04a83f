"""What linkax asks of XLA, the compiler behind JAX.

XLA makes a kernel of each operation that it cannot fuse with others, and on a CPU it takes some 50 ns to start one:
longer than it runs, where a mechanism is small. A loop on few numbers XLA compiles into one kernel instead. What is
few, and whether products of matrices are left to a library, which such a loop cannot call, are set by flags that
it reads once in a process, when JAX makes its first array.

Most of the time to compile goes into optimisations, which a program that runs once does not earn back.

Each program holds memory maps, of which Linux gives a process 65 530. Where XLA gets no more it ends the process.
"""

import gc
import os
import warnings
from functools import cache
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlib
from jax import lax

WHOLE_LOOP_BYTES = 2**22  # read and written by one pass of a loop
LOOPS = f"--xla_backend_extra_options=xla_cpu_small_while_loop_byte_threshold={WHOLE_LOOP_BYTES}"
PRODUCTS = "--xla_cpu_experimental_ynn_fusion_type="
KNOWN_VERSIONS = ("0.10",)  # a flag that XLA does not know ends the process

COMPILING = "/jax/core/compile/backend_compile_duration"  # what JAX tells its listeners before XLA compiles, and after
ROOM = 10_000  # memory maps; the largest programs of linkax take 4000
MAPS, LIMIT_OF_MAPS = Path("/proc/self/maps"), Path("/proc/sys/vm/max_map_count")


def set_flags():
    """Add to `XLA_FLAGS` what it does not name yet."""
    flags = [LOOPS]
    if jaxlib.__version__.startswith(KNOWN_VERSIONS):
        flags.append(PRODUCTS)
    given = os.environ.get("XLA_FLAGS", "")
    added = [flag for flag in flags if flag.partition("=")[0] not in given]
    os.environ["XLA_FLAGS"] = " ".join([given, *added]).strip()


def quickest_to_compile() -> dict:
    """Options of `jax.jit`: half of the time to compile and less, for a program that is slower."""
    options = {"xla_backend_optimization_level": 0, "xla_llvm_disable_expensive_passes": True}
    if jaxlib.__version__.startswith(KNOWN_VERSIONS):
        options["xla_cpu_use_fusion_emitters"] = False
    return options


@cache
def makes_kernels_of_loops() -> bool:
    """Whether XLA makes one kernel of a loop like those of `linkax.tracing.in_one_kernel`.

    It does not where JAX had made an array before linkax was imported, where `XLA_FLAGS` say otherwise, and
    in versions that know no such kernels.
    """
    with jax.ensure_compile_time_eval():
        step = lambda carry: (carry[0] + 1, jnp.sin(carry[1] @ carry[1]))
        loop = jax.jit(lambda count, matrix: lax.while_loop(lambda carry: carry[0] < 3, step, (count, matrix)))
        program = loop.lower(0, jax.ShapeDtypeStruct((32, 32), jnp.float32)).compile().as_text()
    return "xla_cpu_small_call" in program


def watch_memory_maps():
    """Make room before any program of this process is compiled."""
    jax.monitoring.register_scalar_listener(make_room)


def make_room(event, *_time, **_what):
    """Forget compiled programs where memory maps may not suffice for another one.

    **Raises:** `RuntimeError` where other things hold the maps. XLA would end the process.
    """
    if event != COMPILING or _has_room():
        return
    eqx.clear_caches()
    jax.clear_caches()
    gc.collect()
    limit = _limit_of_maps()
    remedy = f"raise their limit (sysctl -w vm.max_map_count={4 * limit})"
    if not _has_room():
        raise RuntimeError(
            f"compiled programs in use and mapped files hold {_maps()} memory maps, of which this process may have "
            f"{limit}: too many to compile another program; hold fewer, {remedy}, or go on in another process"
        )
    warnings.warn(
        f"compiled programs held nearly all of the {limit} memory maps that this process may have: JAX's caches have "
        f"been cleared, and what is used again compiles again; to keep more programs {remedy}",
        RuntimeWarning,
        stacklevel=2,
    )


def _has_room() -> bool:
    """Whether memory maps suffice for another program; true where nothing tells."""
    try:
        limit = _limit_of_maps()
        return limit - _maps() >= min(ROOM, limit // 4)
    except (OSError, ValueError):
        return True


def _maps() -> int:
    return MAPS.read_bytes().count(b"\n")


def _limit_of_maps() -> int:
    return int(LIMIT_OF_MAPS.read_text())
