"""Derivatives of assembled states: by every number of every scene alone, whether or not it moves a loop."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mechanisms import pendulum
from test_gradients import central_differences

import linkax as lx
from linkax.scenes import SCENES


def scenes(*quick):
    """All of them, the others as slow ones."""
    return [name if name in quick else pytest.param(name, marks=pytest.mark.slow) for name in SCENES]


STEP = 6e-5  # relative; with 3e-4 differences of the strandbeest's speeds are 2e-4 off, with 1.5e-4 1e-5
# Parts of the same kinds.
FEWER = {"n-four-bar": {"N": 2}, "telescopic-crane": {"elements": 1}, "hoberman": {"pairs": 3, "angle": 1.26}}
PARTS = 12  # of the numbers of a scene, each one test: the 106 of the Delta robot take 800 s


class Numbers:
    """The numbers of a scene's mechanism, and its assembled state as a function of them."""

    def __init__(self, name):
        self.scene = SCENES[name]
        self.settings = self.scene.settings(None, FEWER.get(name, {}))
        leaves, self.structure = jax.tree.flatten(self.scene.mechanism(self.settings))
        self.leaves = [jnp.asarray(leaf) for leaf in leaves]
        self.changeable = [i for i, leaf in enumerate(self.leaves) if jnp.issubdtype(leaf.dtype, jnp.inexact)]

    def state(self, leaves):
        """q and v, in one vector."""
        state = self.scene.initial(jax.tree.unflatten(self.structure, leaves), self.settings)
        return jnp.concatenate([state.q, state.v])

    def alone(self, index):
        """The state as a function of one leaf."""
        return lambda leaf: self.state([*self.leaves[:index], leaf, *self.leaves[index + 1 :]])


@pytest.mark.slow
@pytest.mark.parametrize("name", SCENES)
@pytest.mark.parametrize("part", range(PARTS))
def test_every_leaf_alone_has_a_derivative_in_both_modes(name, part):
    """Each is traced alone, as JAX tells rules which inputs do not change."""
    numbers = Numbers(name)
    for index in numbers.changeable[part::PARTS]:
        leaf, state = numbers.leaves[index], numbers.alone(index)
        jax.eval_shape(jax.grad(lambda leaf, state=state: jnp.sum(state(leaf))), leaf)
        jax.eval_shape(lambda leaf, state=state: jax.jvp(state, (leaf,), (leaf,))[1], leaf)


@pytest.mark.parametrize("name", scenes("pendulum", "crank-slider"))
def test_derivatives_agree_with_differences(name):
    """To 1e-6, where loops can be closed with a number changed alone."""
    numbers = Numbers(name)
    sizes = [numbers.leaves[i].size for i in numbers.changeable]
    places = np.cumsum(sizes)[:-1]

    def state(flat):
        leaves = list(numbers.leaves)
        for index, part in zip(numbers.changeable, jnp.split(flat, places), strict=True):
            leaves[index] = part.reshape(leaves[index].shape)
        return numbers.state(leaves)

    at = jnp.concatenate([numbers.leaves[i].ravel() for i in numbers.changeable])
    forwards, one = jax.jit(jax.jacfwd(state))(at), jax.jit(state)
    with np.errstate(invalid="ignore"):  # speeds are infinite where loops do not close
        differences = central_differences(lambda several: np.stack([one(flat) for flat in several]), at, STEP)
    relative = np.asarray(forwards) * np.where(at == 0.0, 1.0, np.abs(at))
    closes = np.all(np.isfinite(differences), axis=0)
    assert np.mean(closes) > 0.5
    np.testing.assert_allclose(relative[:, closes], differences[:, closes], atol=1e-6)


def test_a_number_of_python_that_a_law_closes_over():
    """JAX differentiates it as such, and not as an array."""

    def height(rate):
        mechanism = pendulum(2.0, constraints=[lx.Drive("drive", "hinge", lambda t: rate * t)])
        state = lx.assemble(mechanism, t=0.5)
        return lx.Solution.of_state(mechanism, state, t=0.5).position("arm", at="tip")[-1, 1]

    np.testing.assert_allclose(jax.grad(height)(1.0), 2.0 * np.cos(0.5) * 0.5, rtol=1e-9)
    np.testing.assert_allclose(jax.jvp(height, (1.0,), (1.0,))[1], 2.0 * np.cos(0.5) * 0.5, rtol=1e-9)


@pytest.mark.slow
def test_fit_of_a_mass_alone():
    """That no loop depends on, with the state assembled inside of the residual."""

    def angle(params):
        mechanism = pendulum(mass=params["mass"], forces=[lx.JointSpring("hinge", 20.0)])
        return lx.simulate(mechanism, lx.assemble(mechanism, {"hinge": 0.4}), t1=1.0).joint("hinge")

    measured = angle({"mass": 1.3})
    found = lx.fit(lambda params, measured: angle(params) - measured, {"mass": 1.0}, (measured,), progress=False)
    np.testing.assert_allclose(found.params["mass"], 1.3, rtol=1e-6)
