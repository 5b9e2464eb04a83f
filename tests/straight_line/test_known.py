"""Which entries of arrays programs may know."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from known_answers import mechanism_of

from linkax.equations.system import system_of
from linkax.straight_line.known import KnownEntries, KnowsEntries, patterns_of
from linkax.straight_line.transform import straight_line


def crank_slider(**changes):
    return mechanism_of("crank-slider", changes=changes)


def test_the_same_zeros_are_the_same_program():
    known = KnownEntries.of(crank_slider())
    assert known == KnownEntries.of(crank_slider(crank=1.3, crank_mass=7.0))
    assert hash(known) == hash(KnownEntries.of(crank_slider(gravity=3.0)))
    assert KnownEntries.of([jnp.ones(2)]) == KnownEntries.of([jnp.array([1.0, 2.0])])
    assert KnownEntries.of([jnp.eye(2)]) != KnownEntries.of([2.0 * jnp.eye(2)])
    assert KnownEntries.of([jnp.array([0.0])]) == KnownEntries.of([jnp.array([-0.0])])


def test_numbers_alone_and_traced_arrays_are_not_known():
    assert KnownEntries.of((jnp.array(1.0), jnp.array([2.0, 3.0]), jnp.array([0, 1]))).patterns == (None,) * 3
    found = []
    jax.make_jaxpr(lambda array: found.append(KnownEntries.of([array])) or array)(jnp.zeros(3))
    assert found[0].patterns == (None,)


class Numbers(KnowsEntries):
    matrix: jax.Array
    factor: jax.Array


def test_what_is_known_folds_and_has_derivatives_all_the_same():
    numbers = Numbers(None, jnp.array([[0.0, 2.0, -1.0]]), jnp.array(3.0))
    numbers = dataclasses.replace(numbers, known=KnownEntries.of(numbers))
    function = lambda numbers, x: jnp.sum(numbers.factor * (numbers.matrix @ jnp.sin(x)))
    x = jnp.array([0.3, 0.4, 0.5])
    assert patterns_of((x, numbers)) == [None, *numbers.known.patterns]
    np.testing.assert_allclose(straight_line(function)(numbers, x), function(numbers, x), rtol=1e-15)
    # As they were when the program was made, whatever the numbers are.
    others = dataclasses.replace(numbers, matrix=jnp.array([[5.0, 2.0, 5.0]]))
    np.testing.assert_allclose(straight_line(function)(others, x), function(numbers, x), rtol=1e-15)
    slopes = jax.grad(lambda numbers: straight_line(function)(numbers, x))(numbers)
    np.testing.assert_allclose(slopes.matrix, 3.0 * np.sin(x)[None], rtol=1e-15)


def test_what_a_function_makes_of_known_entries():
    """A mechanism's stacked numbers: the zeros and ones of all of them, found without their values."""
    mechanism = crank_slider()
    stacked = lambda mechanism: system_of(mechanism, np.dtype(float))
    found = KnownEntries.of(mechanism).through(stacked, mechanism)
    expected = KnownEntries.of(stacked(mechanism))
    zeros = lambda known: [
        set(np.flatnonzero(np.frombuffer(entry[1]) == 0.0)) if entry else set() for entry in known.patterns
    ]
    both = list(zip(zeros(found), zeros(expected), strict=True))
    assert all(some <= all_ for some, all_ in both)
    # All but those that come about by the values of numbers.
    assert sum(map(len, zeros(found))) > 0.9 * sum(map(len, zeros(expected)))
    for numbers in (stacked(mechanism), stacked(crank_slider(crank=1.3, rod=2.5, crank_mass=7.0))):
        for array, pattern in zip(jax.tree.leaves(numbers), found.patterns, strict=True):
            values = np.full(array.shape, np.nan) if pattern is None else np.frombuffer(pattern[1]).reshape(array.shape)
            np.testing.assert_array_equal(np.where(np.isnan(values), array, values), array)
