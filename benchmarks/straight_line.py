"""One corrected evaluation of the equations of motion, on arrays as runs compute it, and as a straight line.

Each row: scalar operations of the straight line, and seconds to go through the traced evaluation; then for one state,
and for a member of a batch of LANES, microseconds of both, their ratio, and seconds to compile each. Zeros, ones and
minus ones in the mechanism's vectors and matrices are known to the straight line, other numbers are inputs. Times are
of this machine, this run: compare ratios.
"""

import time
from collections.abc import Iterator

import equinox as eqx
import jax
import jax.numpy as jnp

import linkax as lx
from benchmarks.evaluation import SMALLEST, seconds_of
from benchmarks.parts import print_parts
from benchmarks.problems import PROBLEMS
from linkax.equations.system import System, system_of
from linkax.straight_line.known import patterns_of
from linkax.straight_line.transform import MOST_OPERATIONS, Traced, straight_line

EVALUATED = ("M1n", "M1a", "M2-1", "M3", "planar-four-bar", "FL3", "rigid-crane")
LANES = 256


def evaluate(system: System, q: jax.Array, v: jax.Array) -> tuple[jax.Array, ...]:
    """v, v̇ and q of the equations of motion, corrected."""
    return lx.TangentSpace().prepared(float).derivative(system, jnp.zeros(()), q, v, True)[:3]


def cost(mechanism: lx.Mechanism, state: lx.State) -> dict:
    """Of an evaluation at a state."""
    system = system_of(mechanism, float)
    given = system, state.q, state.v
    arrays, static = eqx.partition(given, eqx.is_array)
    function = lambda arrays: evaluate(*eqx.combine(arrays, static))
    traced = Traced(jax.make_jaxpr(function)(arrays), patterns_of(given), MOST_OPERATIONS)
    began = time.perf_counter()
    program = traced.program
    walked = time.perf_counter() - began
    found = {"operations": None if program is None else program.graph.count, "walk_s": walked}
    for name, function in (("", lambda function: function), ("straight_", straight_line)):
        for lanes in (1, LANES):
            us, compiling = _measured(function(evaluate), system, state, lanes)
            found |= {f"{name}us_of_{lanes}": us, f"{name}compile_s_of_{lanes}": compiling}
    for lanes in (1, LANES):
        found[f"ratio_of_{lanes}"] = found[f"us_of_{lanes}"] / found[f"straight_us_of_{lanes}"]
    return found


def _measured(evaluate, system, state, lanes):
    """Microseconds for each member, and seconds to compile."""
    if lanes > 1:
        evaluate = eqx.filter_vmap(evaluate, in_axes=(None, 0, 0))
    given = [array if lanes == 1 else jnp.tile(array, (lanes, 1)) for array in (state.q, state.v)]

    @eqx.filter_jit
    def repeated(system, q, v, count):
        def once(_, carry):
            q, v = carry
            found_v, acceleration, found_q = evaluate(system, q, v)
            return q + SMALLEST * found_q, v + SMALLEST * (found_v + acceleration)

        return jax.lax.fori_loop(0, count, once, (q, v))

    began = time.perf_counter()
    program = repeated.lower(system, *given, jnp.asarray(1)).compile()
    compiling = time.perf_counter() - began
    return 1e6 * seconds_of(lambda count: program(system, *given, jnp.asarray(count))) / lanes, compiling


def evaluations() -> Iterator[dict]:
    """Of problems that other benchmarks use."""
    for key in EVALUATED:
        yield {"problem": key, **cost(*PROBLEMS[key].start())}
        jax.clear_caches()


if __name__ == "__main__":
    print_parts(__doc__ or "", {"evaluations": evaluations})
