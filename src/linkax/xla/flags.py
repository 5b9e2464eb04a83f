"""Flags and options of XLA, the compiler behind JAX.

XLA makes a kernel of each operation that it cannot fuse with others. On a CPU it takes some 50 ns to start one, longer
than it runs, where a mechanism is small. A loop over few numbers becomes one kernel, unless it calls a library, as for
products of matrices. A flag says how many are few: with more than a million bytes XLA takes twice as long to compile,
for no gain. XLA reads it once in a process, when JAX makes its first array, and ends the process for a flag that it
does not know; so this one is an extra option, in a list that XLA does not check. Versions tell too little of what XLA
does, so it is tried. Two more flags are for versions alone that are known to know them. One leaves fewer products to a
library in batches. The other is of LLVM, which computes several members of a batch at once where it can check that what
a kernel reads and writes lies apart: by default in 128 pairs, those of 15 results.

Most of the time to compile goes into optimisations, which a program that runs once does not earn back.
"""

import os
from functools import cache

import jax
import jax.numpy as jnp
from jax import lax
from jaxlib import version as jaxlib

from linkax.xla.users_line import warn

WHOLE_LOOP_BYTES = 2**20  # read and written by one pass of a loop
LOOP_BYTES = "xla_cpu_small_while_loop_byte_threshold"
LOOPS = f"--xla_backend_extra_options={LOOP_BYTES}={WHOLE_LOOP_BYTES}"
MOST_CHECKS = 2500  # of pairs: 70 results; more take long to compile
VECTORS = f",-vectorize-memory-check-threshold={MOST_CHECKS}"
PRODUCTS = "--xla_cpu_experimental_ynn_fusion_type="
KNOWN_VERSIONS = ("0.10.", "0.11.", "0.12.")  # of jaxlib, that know both
QUICK = {  # to compile, not to run
    "xla_backend_optimization_level": 0,
    "xla_llvm_disable_expensive_passes": True,
    "xla_cpu_use_fusion_emitters": False,
}


def set_flags() -> None:
    """Add to the environment's `XLA_FLAGS` the flags that it does not name yet."""
    given, knows = os.environ.get("XLA_FLAGS", ""), jaxlib.__version__.startswith(KNOWN_VERSIONS)
    flags = [LOOPS + VECTORS, PRODUCTS] if knows else [LOOPS]
    added = [flag for flag in flags if flag.partition("=")[0] not in given]
    os.environ["XLA_FLAGS"] = " ".join([given, *added]).strip()


@cache
def quickest_to_compile() -> dict[str, int | bool]:
    """Options of `jax.jit`, as far as XLA knows them: less than half of the time to compile, a slower program."""
    return QUICK if _is_known(QUICK) else {name: value for name, value in QUICK.items() if _is_known({name: value})}


def _is_known(options) -> bool:
    try:
        jax.jit(lambda: 0, compiler_options=options).lower().compile()
    except jax.errors.JaxRuntimeError:
        return False
    return True


@cache
def makes_kernels_of_loops() -> bool:
    """Whether XLA makes one kernel of a loop over few numbers, as straight lines need.

    It does not where JAX had made an array before linkax was imported, where `XLA_FLAGS` say otherwise, and in versions
    without such kernels. Warns where runs on a CPU are slow for that, unless `XLA_FLAGS` ask for it.
    """
    with jax.ensure_compile_time_eval():
        step = lambda carry: (carry[0] + 1, jnp.sin(jnp.sum(carry[1][:, :, None] * carry[1], axis=1)))
        loop = jax.jit(lambda count, matrix: lax.while_loop(lambda carry: carry[0] < 3, step, (count, matrix)))
        program = loop.lower(0, jax.ShapeDtypeStruct((8, 8), jnp.float64)).compile().as_text() or ""
    made, flags = "xla_cpu_small_call" in program, os.environ.get("XLA_FLAGS", "")
    chosen = LOOP_BYTES in flags and LOOPS not in flags
    if not made and not chosen and jax.default_backend() == "cpu":
        warn(
            f"runs take about five times as long as they could: jaxlib {jaxlib.__version__} makes no kernels of loops; "
            f"import linkax before JAX makes its first array, with {LOOPS} in XLA_FLAGS, or install another jaxlib",
            RuntimeWarning,
        )
    return made
