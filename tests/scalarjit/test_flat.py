"""A pytree as its arrays and one static object."""

import gc
import pickle
import weakref
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from known_answers import mechanism_of

from scalarjit import Flat, with_known_entries

TREE = {"masses": np.array([1.0, 2.0]), "name": "rod", "of": (jnp.ones(3), None, 4.0)}


class Numbers(eqx.Module):
    numbers: Any


def test_tree_is_what_it_was_made_of():
    flat = Flat.of(TREE, "noted")
    assert eqx.tree_equal(flat.tree, TREE)
    assert flat.noted == "noted"
    assert len(jax.tree.leaves(flat)) == 2


def test_jax_transforms_its_arrays_alone():
    total = lambda flat: jnp.sum(flat.tree["masses"]) * flat.tree["of"][2]
    assert jax.jit(total)(Flat.of(TREE)) == 12.0
    assert np.all(jax.grad(total)(Flat.of(TREE)).tree["masses"] == 4.0)
    batch = jax.vmap(lambda mass: Flat.of({**TREE, "masses": mass * TREE["masses"]}))(jnp.arange(3.0))
    assert batch.tree["masses"].shape == (3, 2)
    assert batch.tree["name"] == "rod"


def test_compiles_again_only_for_another_static_part():
    compiled = []

    @eqx.filter_jit
    def count(flat):
        compiled.append(flat.tree["name"])
        return flat.tree["masses"] + 1.0

    for tree, noted in (
        (TREE, 1),
        ({**TREE, "masses": np.array([3.0, 4.0])}, 1),
        (TREE, 2),
        ({**TREE, "name": "crank"}, 1),
        ({**TREE, "of": (jnp.ones(3), None, 5.0)}, 1),
        (TREE, 1),
    ):
        count(Flat.of(tree, noted))
    assert compiled == ["rod", "rod", "crank", "rod"]


def test_pickles():
    mechanism = mechanism_of("crank-slider")
    flat = with_known_entries(mechanism)
    again = pickle.loads(pickle.dumps(flat))
    assert eqx.tree_equal(again, flat)
    assert again.noted == flat.noted


def test_kept_as_long_as_the_mechanism_lives():
    mechanism = mechanism_of("crank-slider")
    first = with_known_entries(mechanism)
    assert with_known_entries(mechanism) is first
    heavier = eqx.tree_at(lambda m: m.bodies[0].mass, mechanism, mechanism.bodies[0].mass + 1.0)
    assert with_known_entries(heavier) is not first
    kept = weakref.ref(first)
    del mechanism, first
    gc.collect()
    assert kept() is None


def test_traced_mechanisms_are_not_kept():
    def of(mass):
        mechanism = mechanism_of("crank-slider", changes={"rod_mass": mass})
        assert with_known_entries(mechanism) is not with_known_entries(mechanism)
        return mass

    jax.jit(of)(1.0)


def test_the_same_zeros_are_the_same_program():
    noted = lambda *arrays: with_known_entries(Numbers(arrays)).noted
    of_slider = lambda **changes: with_known_entries(mechanism_of("crank-slider", changes=changes)).noted
    assert of_slider() == of_slider(crank=1.3, crank_mass=7.0)
    assert hash(of_slider()) == hash(of_slider(gravity=3.0))
    assert noted(jnp.ones(2)) == noted(jnp.array([1.0, 2.0])) == (None,)
    assert noted(jnp.eye(2)) != noted(2.0 * jnp.eye(2))
    assert noted(jnp.array([0.0])) == noted(jnp.array([-0.0])) != (None,)
    assert noted(jnp.array(0.0), jnp.array([0, 1])) == (None, None)
    found = []
    jax.make_jaxpr(lambda array: found.append(noted(array)) or array)(jnp.zeros(3))
    assert found == [(None,)]


def test_arrays_that_can_be_written_to_are_read_each_time():
    of_its_own = Numbers(np.zeros(2))
    assert with_known_entries(of_its_own).noted != (None,)
    of_its_own.numbers[:] = 3.0
    assert with_known_entries(of_its_own).noted == (None,)
