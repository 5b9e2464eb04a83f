"""Code that LLVM makes: again with more care, with the same bits, in memory that holds anything at first, in parts."""

import gc
import os
import pickle
import re
import subprocess
import sys
import time
import weakref
from concurrent.futures import ThreadPoolExecutor

import equinox.internal as eqxi
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from agreement import agrees, numbers
from jax import lax
from test_control import FUNCTIONS, SHAPES, known_for_a_while, scanned

from scalarjit import clear_caches, handlers, machine, pieces, scalarised, units
from scalarjit.compiler import CARE, object_code
from scalarjit.emission import emitted
from scalarjit.functions import function_of
from scalarjit.graph import Buffer, Copy, For, Graph, If, Store, While
from scalarjit.machine import Compiled
from scalarjit.memory import Memory

PATIENCE = 60.0  # seconds, where others work too


def test_what_runs_often_is_compiled_again_to_the_same_bits(monkeypatch):
    loaded = []

    def load(self, *code, load=Compiled.load):
        load(self, *code)
        loaded.append(self)

    monkeypatch.setattr(Compiled, "load", load)
    monkeypatch.setattr(machine, "OFTEN", 2000)
    monkeypatch.setattr(machine, "_watched", weakref.WeakKeyDictionary())  # no other function comes before
    function = scalarised(lambda x: lax.fori_loop(0, 100, lambda k, x: jnp.cos(x @ x.T / 3) + k / 7, x))
    x = numbers(3, 3)
    first = np.asarray(function(x))
    times = len(loaded)
    end = time.monotonic() + PATIENCE
    again = lambda: [made for made in loaded[times:] if made in loaded[:times]]
    while not again() and time.monotonic() < end:
        found = function(x)
        time.sleep(0.01)
    assert again(), f"none of level {CARE}"
    np.testing.assert_array_equal(function(x), first)
    np.testing.assert_array_equal(found, first)


@pytest.mark.parametrize("shape", SHAPES, ids=str)
@pytest.mark.parametrize("function", FUNCTIONS)
def test_code_with_all_that_it_calls_has_the_same_bits(function, shape, monkeypatch):
    """Function by function and as one; alone and in vectors; with memory on the stack, and with too much for it."""
    registered = set()
    register = handlers.Handler.register
    monkeypatch.setattr(handlers.Handler, "register", lambda self: registered.add(self.unit) or register(self))
    alone, of_batch = jax.jit(scalarised(function)), jax.jit(jax.vmap(scalarised(function)))
    members = 11 if len(shape) == 1 else 2
    one, several = ([numbers(*more, *shape, seed=seed) for seed in (0, 1)] for more in ((), (members,)))
    first = alone(*one), of_batch(*several)
    assert len(registered) == 2
    for most in 0, units.MOST_TOGETHER:
        monkeypatch.setattr(units, "MOST_TOGETHER", most)
        for part in {part.key: part for unit in registered for part in unit.all_parts()}.values():
            assert (part.together == [part]) == (most == 0 or not part.callees)
            machine.compiled(part).load(object_code(part.text_together(), CARE))
        jax.tree.map(np.testing.assert_array_equal, (alone(*one), of_batch(*several)), first)


@pytest.mark.parametrize("function", [each for each in FUNCTIONS if each not in (known_for_a_while, scanned)])
def test_code_in_pieces_has_the_same_bits(function, monkeypatch):
    """Loops in a module of their own, a few operations in each function, or none of both: what other pieces need."""
    registered = set()
    register = handlers.Handler.register
    monkeypatch.setattr(handlers.Handler, "register", lambda self: registered.add(self.unit) or register(self))
    found = []
    names = []
    for heavy, most in (np.inf, 10**9), (0, 10**9), (np.inf, 8):
        monkeypatch.setattr(pieces, "HEAVY", heavy)
        monkeypatch.setattr(pieces, "LONG", most)
        registered.clear()
        alone = jax.jit(scalarised(lambda x, y: function(x, y)))
        of_batch = jax.jit(jax.vmap(scalarised(lambda x, y: function(x, y))))
        one, several = ([numbers(*more, 40, 30, seed=seed) for seed in (0, 1)] for more in ((), (3,)))
        found.append((alone(*one), of_batch(*several)))
        text = "".join(part.text for unit in registered for part in unit.all_parts())
        names.append({name for name in ("@piece", "@loop") if name in text})
    assert "@loop" in names[1]
    assert "@piece" in names[2]
    for each in found[1:]:
        jax.tree.map(np.testing.assert_array_equal, each, found[0])


def test_functions_are_short():
    """At level 0 each value has a place of its own on the stack: those of a bicycle overflowed it once."""

    def function(x):
        for number in range(150):
            x = x @ x.T / 10 + number
        return x

    code = emitted(function_of(jax.make_jaxpr(function)(numbers(8, 8)), [None]), 8, "name")
    lines = [len(block.splitlines()) for block in re.findall(r"^define .*?^}", code.text, re.MULTILINE | re.DOTALL)]
    assert sum(lines) > 80_000
    assert max(lines) < 8_000  # vectors of eight doubles: 0.5 MB


def test_each_array_has_a_place_of_its_own():
    """Also one that comes after another is gone."""
    memory = Memory(Graph(), 8)
    places = [memory.place(Buffer(np.dtype(float), size)) for size in range(1, 100)]
    assert len(set(places)) == len(places)


def graphs():
    gc.collect()
    return sum(isinstance(each, Graph) and len(each.names) > 0 for each in gc.get_objects())


def test_what_is_let_go_of_is_compiled_again_where_it_is_called():
    """Graphs take four times the memory of their text; of texts, code and all else, `clear_caches` lets go."""
    function = lambda x: lax.fori_loop(0, 10, lambda k, x: jnp.cos(x @ x.T / 3) + k / 7, x)
    before = graphs()
    compiled = jax.jit(scalarised(function))
    x, several = numbers(3, 3), numbers(5, 3, 3)
    first = compiled(x)
    assert graphs() == before
    clear_caches()
    assert not any(each.has_code for each in handlers.registered.values())
    np.testing.assert_array_equal(compiled(x), first)
    assert sum(each.has_code for each in handlers.registered.values()) == 1
    clear_caches()
    compiled.clear_cache()
    np.testing.assert_array_equal(compiled(x), first)
    np.testing.assert_allclose(jax.vmap(compiled)(several), jax.vmap(function)(several), atol=1e-14)


def test_code_that_runs_is_not_let_go_of():
    def function(x, passes):
        return lax.fori_loop(0, passes, lambda k, x: jnp.cos(x @ x.T / 3) + k / 7, x)

    compiled = jax.jit(scalarised(function))
    first = compiled(numbers(3, 3), 1_000_000)
    with ThreadPoolExecutor() as pool:
        runs = [pool.submit(compiled, numbers(3, 3), 1_000_000) for _ in range(3)]
        while not all(run.done() for run in runs):
            clear_caches()
    for run in runs:
        np.testing.assert_array_equal(run.result(), first)


FAILED = ValueError, jax.errors.JaxRuntimeError  # JAX raises one or the other


def test_code_that_cannot_be_compiled_again_is_an_error(monkeypatch):
    compiled = jax.jit(scalarised(lambda x: jnp.sin(x) / 3 + x))
    assert compiled(0.0) == 0.0
    clear_caches()
    reasons = []
    with monkeypatch.context() as patch:
        patch.setattr(handlers, "compiled", None)
        patch.setattr(sys, "unraisablehook", reasons.append)
        with pytest.raises(FAILED, match="code that had been let go of does not compile again"):
            compiled(0.0).block_until_ready()
    assert [reason.exc_type for reason in reasons] == [TypeError]
    assert compiled(0.0) == 0.0


def test_memory_that_is_not_there_is_an_error(monkeypatch):
    monkeypatch.setattr(handlers, "HANDLER", handlers.HANDLER.replace("@malloc(i64 {bytes})", "@malloc(i64 -1)"))
    with pytest.raises(FAILED, match=r"no memory is left for [0-9]+ bytes"):
        jax.jit(scalarised(lambda x: jnp.sin(x) / 5 + x))(0.0).block_until_ready()


def test_loops_keep_known_entries_of_innermost_axes():
    """So that what is computed of them is not computed."""

    def function(x):
        rows = jnp.zeros((len(x), 3, 3)).at[:, 0, 1].set(-x[:, 2]).at[:, 1, 0].set(x[:, 2])
        return jnp.einsum("nij,njk->nik", jnp.sin(rows), rows + jnp.eye(3))

    x = numbers(200, 3)
    agrees(function, x, atol=1e-15)
    (result,) = function_of(jax.make_jaxpr(function)(x), [None]).results
    is_zero = np.ones((3, 3), bool)
    is_zero[:2, :2] = False
    np.testing.assert_array_equal(result.known < 0, np.broadcast_to(is_zero, (200, 3, 3)))


def stores(region):
    """How many entries are written one by one, those of each loop once."""
    inner = [item.region for item in region.items if isinstance(item, For)]
    return sum(isinstance(item, Store) for item in region.items) + sum(map(stores, inner))


def test_what_is_in_memory_is_not_written_again():
    """Not in another shape, nor again and again where rows are alike; constants are copied at once."""

    def function(x, place):
        mixed = jnp.concatenate([jnp.sin(x), jnp.zeros(570)])
        alike = jnp.broadcast_to(jnp.cos(x), (20, 30))
        rows = mixed.reshape(20, 30), mixed.reshape(20, 1, 30)[:, 0], alike
        return [lax.dynamic_index_in_dim(array, place) for array in rows]

    x = numbers(30)
    agrees(function, x, 0)
    agrees(jax.vmap(function, (0, None)), numbers(11, 30), 7)
    graph = function_of(jax.make_jaxpr(function)(x, 0), [None, None]).graph
    assert stores(graph.root) < 3 * 30 + 20


def copies_in_loops(region, inside=False):
    """Copies of arrays in passes of loops of unknown length."""
    found = [item for item in region.items if isinstance(item, Copy) and inside]
    for item in region.items:
        if isinstance(item, While):
            found += copies_in_loops(item.region, True)
        elif isinstance(item, For | If):
            found += copies_in_loops(item.region, inside)
    return found


def test_rows_are_kept_in_place():
    """Not by a copy of all rows in each pass."""

    def function(x):
        def body(carry):
            number, x, rows = carry
            return number + 1, jnp.sin(x) + 1, rows.at[number].set(x)

        begin = 0, x, jnp.full((1000, 3), jnp.inf)
        return eqxi.while_loop(lambda carry: carry[0] < 20, body, begin, kind="lax", buffers=lambda carry: carry[2])[2]

    x = numbers(3)
    agrees(function, x)
    agrees(jax.vmap(function), numbers(11, 3))
    copies = copies_in_loops(function_of(jax.make_jaxpr(function)(x), [None]).graph.root)
    assert not [copy for copy in copies if copy.source.size > 3]


@pytest.mark.parametrize("function", FUNCTIONS)
def test_memory_may_hold_anything_at_first(function, monkeypatch):
    """No number, that is: what is read before it is written spoils results."""
    fill = "call void @llvm.memset.p0.i64(ptr %raw, i8 -1, i64 {bytes}, i1 false)\n%number = ptrtoint"
    handler = handlers.HANDLER.replace("%number = ptrtoint", fill)
    monkeypatch.setattr(handlers, "HANDLER", "declare void @llvm.memset.p0.i64(ptr, i8, i64, i1)\n" + handler)
    for shape in (3,), (20, 10):
        agrees(lambda x, y: function(x, y), numbers(*shape), numbers(*shape, seed=1), rtol=1e-11)


def in_parts(x):
    """Eigenvalues, which XLA computes, by themselves, in loops and in branches."""
    symmetric = jnp.sin(x @ x.T)
    values, vectors = jnp.linalg.eigh(symmetric)
    turned = lambda k, x: jnp.cos(jnp.abs(jnp.linalg.eigh(x)[1]) @ x @ x.T / 9) + k
    looped = lax.fori_loop(0, 3, turned, symmetric)
    going = lambda carry: jnp.linalg.eigvalsh(carry)[0] > -1.0
    halved = lax.while_loop(going, lambda carry: carry - 0.3 * jnp.eye(4), symmetric)
    chosen = lax.cond(jnp.sum(x) > 0, lambda: jnp.linalg.eigvalsh(looped + looped.T), lambda: values)
    scanned = lax.scan(lambda carry, row: (carry + jnp.linalg.eigvalsh(jnp.outer(row, row)), row * 2), values, x)
    return values, jnp.abs(vectors) * 2, looped, halved, chosen, scanned, jnp.abs(jnp.linalg.eigvals(x)).sum()


def test_what_has_no_rule_is_left_to_xla_and_the_rest_is_not():
    x = numbers(4, 4)
    # Eigenvectors turn by much where eigenvalues are close.
    agrees(in_parts, x, rtol=1e-9)
    agrees(jax.vmap(in_parts), np.stack([x, 2 * x, -x]), rtol=1e-9)
    loss = lambda function: lambda x: jnp.sum(function(x)[0] ** 2) + jnp.sum(function(x)[2])
    slopes = jax.jacfwd(loss(scalarised(in_parts)))(x)
    np.testing.assert_allclose(slopes, jax.jacfwd(loss(in_parts))(x), atol=1e-8)


def test_what_is_handed_on_may_be_of_any_type():
    """By branches and functions that compute nothing of it, or something of other arrays."""

    def function(x):
        number = lax.complex(x, x + 1)
        handed = lax.cond(x[0] > 0.0, lambda number: (number, x), lambda number: (jnp.conj(number), 2 * x), number)
        several = jax.jit(lambda number, x: (number, [jnp.sin(x + k) for k in range(20)]))(*handed)
        return jnp.abs(several[0]) + jnp.angle(several[0]), several[1]

    for x in numbers(3), -numbers(3):
        agrees(function, x)


def test_arrays_of_another_process_are_not_left_to_xla():
    """Whose types are equal to those of this one, and not the same."""
    for dtype in np.float64, np.float32, np.int64, bool:
        array = pickle.loads(pickle.dumps(np.ones(3, dtype)))
        for function in scalarised(lambda x: x + 1), jax.vmap(scalarised(lambda x: x + 1)):
            assert re.search(handlers.NAMES, jax.jit(function).lower(array).as_text())


WITHOUT_LLVM = """
import sys, warnings
sys.modules["llvmlite"] = None
import numpy as np
from pathlib import Path
with warnings.catch_warnings(record=True) as told:
    warnings.simplefilter("always")
    import linkax
    from scalarjit import keep_in, scalarised
assert any("llvmlite does not load" in str(each.message) for each in told)
keep_in(Path(sys.argv[1]))
np.testing.assert_array_equal(scalarised(lambda x: x + 1.0)(np.ones(3)), 2.0)
"""


def test_without_llvm_all_is_left_to_xla_and_told(tmp_path):
    programs = tmp_path / "programs"
    # With a cache of its own: what JAX finds in that of another run is not kept once more.
    environment = os.environ | {"JAX_COMPILATION_CACHE_DIR": str(tmp_path / "of_jax")}
    subprocess.run([sys.executable, "-c", WITHOUT_LLVM, str(programs)], check=True, timeout=120, env=environment)
    assert list(programs.iterdir())


def test_callbacks_are_left_to_xla():
    told = []
    agrees(lambda x: jax.pure_callback(lambda x: 2 * x, jax.ShapeDtypeStruct((3,), float), x * 3) + x, numbers(3))
    scalarised(lambda x: jax.debug.callback(told.append, x.sum()) or x * 2)(numbers(3))
    jax.effects_barrier()
    np.testing.assert_allclose(told, np.sum(numbers(3)))


def test_random_numbers_have_keys_of_their_own_type():
    agrees(lambda x: jax.random.normal(jax.random.PRNGKey(3), x.shape) + x, numbers(3))
    agrees(lambda x: jax.random.uniform(jax.random.key(3), x.shape) * x, numbers(3))
