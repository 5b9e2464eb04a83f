"""Cost of the factorisations that a formulation may rest on: LU, row echelon form, pseudo-inverse, QR.

After table 2 of Zhao, Qi, Wang and Xu, Applied Mathematics and Mechanics 47(8), 2026. Random
square matrices; full Q in both QR, which are pivoted. All methods of a row meet the same noise,
in turn, and the smallest time of each counts: compare ratios. `--part` chooses one table:

- `single`: microseconds for one matrix, many one after another in a compiled loop; as a ratio to
  LU, with the paper's ratio beside it; seconds to trace and compile it by itself.
- `batches`: microseconds for each of a batch in one call; as a ratio to LU; seconds to trace and
  compile. The largest matrices in the largest batch are left out, for memory and time.
- `rank-revealing`: milliseconds for one large batch, our QR against LAPACK's and the singular
  value decomposition, which all find ranks; on the device that JAX takes by default.
"""

import os
import time

# Threads of the library that wait for one another, on a shared machine, would cost a thousand times the work.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import jax
import jax.numpy as jnp
import numpy as np

import linkax as lx
from benchmarks.parts import print_parts
from linkax.linalg.row_echelon import row_echelon

METHODS = {
    "LU": jax.scipy.linalg.lu_factor,
    "row echelon form": lambda a: row_echelon(a, len(a) * jnp.finfo(a.dtype).eps),
    "pseudo-inverse": jnp.linalg.pinv,
    "QR of LAPACK": lambda a: jax.scipy.linalg.qr(a, pivoting=True),
    "QR of linkax": lx.pivoted_qr,
}
# Seconds for LU, row echelon form, pseudo-inverse and QR.
PAPER = {
    20: (4.57e-6, 1.73e-3, 6.24e-5, 4.28e-6),
    40: (1.12e-5, 6.63e-3, 2.10e-4, 1.32e-5),
    60: (2.73e-5, 1.43e-2, 8.45e-4, 3.06e-5),
    100: (2.54e-4, 3.94e-2, 1.49e-3, 1.27e-4),
}
ONE_AFTER_ANOTHER = 64
BATCHES = (1, 64, 4096)
BATCH_SIZES = (6, 12, 20, 40, 60, 100)
LARGEST_WORK = 1e9  # matrices times n³
RANK_REVEALING_SIZES = (6, 8, 12, 16, 20)
SECONDS, FEWEST, MOST = 3.0, 3, 100  # for the repeats of all methods of a row


def matrices(count, n):
    return jnp.asarray(np.random.default_rng(n).normal(size=(count, n, n)))


def built(function, argument):
    """The compiled function, and the seconds that took."""
    began = time.perf_counter()
    compiled = jax.jit(function).lower(argument).compile()
    return compiled, time.perf_counter() - began


def fastest(functions, argument):
    """Smallest seconds of each compiled function, called in turn."""

    def once(function):
        began = time.perf_counter()
        jax.block_until_ready(function(argument))
        return time.perf_counter() - began

    def everyone():
        return [once(function) for function in functions.values()]

    everyone()
    rounds = [everyone()]
    repeats = min(max(SECONDS / sum(rounds[0]), FEWEST), MOST)
    while len(rounds) < repeats:
        rounds.append(everyone())
    return dict(zip(functions, np.min(rounds, axis=0), strict=True))


def rounded(number):
    return float(f"{number:.3g}")


def single():
    for n, paper in PAPER.items():
        stack = matrices(ONE_AFTER_ANOTHER, n)
        compiling = {name: built(method, stack[0])[1] for name, method in METHODS.items()}
        loops = {
            name: built(lambda stack, method=method: jax.lax.map(method, stack), stack)[0]
            for name, method in METHODS.items()
        }
        seconds = fastest(loops, stack)
        papers = (*paper, paper[-1])
        for (name, found), published in zip(seconds.items(), papers, strict=True):
            yield {
                "size": f"{n}x{n}",
                "method": name,
                "us": rounded(1e6 * found / ONE_AFTER_ANOTHER),
                "ratio to LU": rounded(found / seconds["LU"]),
                "in the paper": rounded(published / paper[0]),
                "compile s": rounded(compiling[name]),
            }


def batches():
    for count in BATCHES:
        for n in BATCH_SIZES:
            if count * n**3 > LARGEST_WORK:
                continue
            stack = matrices(count, n)
            compiled = {name: built(jax.vmap(method), stack) for name, method in METHODS.items()}
            seconds = fastest({name: function for name, (function, _) in compiled.items()}, stack)
            for name, found in seconds.items():
                yield {
                    "matrices": count,
                    "size": f"{n}x{n}",
                    "method": name,
                    "us each": rounded(1e6 * found / count),
                    "ratio to LU": rounded(found / seconds["LU"]),
                    "compile s": rounded(compiled[name][1]),
                }


def rank_revealing():
    methods = {name: METHODS[name] for name in ("QR of linkax", "QR of LAPACK")}
    methods["singular values"] = jnp.linalg.svd
    for n in RANK_REVEALING_SIZES:
        stack = matrices(BATCHES[-1], n)
        compiled = {name: built(jax.vmap(method), stack) for name, method in methods.items()}
        seconds = fastest({name: function for name, (function, _) in compiled.items()}, stack)
        for name, found in seconds.items():
            yield {
                "device": stack.device.platform,
                "matrices": len(stack),
                "size": f"{n}x{n}",
                "method": name,
                "ms": rounded(1e3 * found),
                "ratio to linkax": rounded(found / seconds["QR of linkax"]),
                "compile s": rounded(compiled[name][1]),
            }


def main():
    # What JAX loads when a method is first used is no part of its compile time.
    for method in (*METHODS.values(), jnp.linalg.svd):
        built(method, matrices(1, 2)[0])
    print_parts(__doc__, {"single": single, "batches": batches, "rank-revealing": rank_revealing})


if __name__ == "__main__":
    main()
