"""Derivatives of a simulation, through singular passages too."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np

import linkax as lx
from linkax.scenes import SCENES

SCENE = SCENES["crank-slider"]
SAVE_END = diffrax.SaveAt(t1=True)


def final_position(changes, adjoint=None):
    """Where the slider is after 1 s of SC4; `length` scales crank and rod alike."""
    changes = dict(changes)
    length = changes.pop("length")
    settings = SCENE.settings("SC4", changes | {"crank": length, "rod": length})
    mechanism = SCENE.mechanism(settings)
    state = SCENE.initial(mechanism, settings)
    accuracy = lx.Accuracy(rtol=1e-12)
    return lx.simulate(mechanism, state, t1=1.0, accuracy=accuracy, saveat=SAVE_END, adjoint=adjoint).position(
        "slider"
    )[0, 0]


def separate_lengths(crank, rod):
    """The same with unlike lengths, which meet no singular configuration."""
    settings = SCENE.settings("SC4", {"crank": crank, "rod": rod})
    mechanism = SCENE.mechanism(settings)
    state = SCENE.initial(mechanism, settings)
    return lx.simulate(mechanism, state, t1=1.0, accuracy=lx.Accuracy(rtol=1e-12), saveat=SAVE_END).position("slider")[
        0, 0
    ]


NUMBERS = {"length": 1.0, "crank_mass": 1.0, "rod_mass": 1.0, "slider_mass": 1.0, "gravity": 9.81}


def central_differences(function, numbers, step=1e-4):
    """Fourth order, so that a step is found where neither truncation nor rounding matter."""

    def along(name):
        at = lambda factor: function({**numbers, name: numbers[name] + factor * step})
        return (8.0 * (at(1.0) - at(-1.0)) - (at(2.0) - at(-2.0))) / (12.0 * step)

    return {name: along(name) for name in numbers}


def test_reverse_and_forward_mode_agree_with_central_differences():
    numbers = {name: jnp.asarray(number) for name, number in NUMBERS.items()}
    reverse = jax.jit(jax.grad(final_position))(numbers)
    forward = jax.jit(jax.jacfwd(lambda numbers: final_position(numbers, diffrax.ForwardMode())))(numbers)
    differences = central_differences(jax.jit(final_position), numbers)
    for name in NUMBERS:
        np.testing.assert_allclose(forward[name], reverse[name], rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(reverse[name], differences[name], rtol=1e-6, atol=1e-9)


def test_lengths_that_differ():
    reverse = jax.jit(jax.grad(lambda numbers: separate_lengths(**numbers)))
    numbers = {"crank": jnp.asarray(0.8), "rod": jnp.asarray(1.1)}
    found = reverse(numbers)
    differences = central_differences(jax.jit(lambda numbers: separate_lengths(**numbers)), numbers)
    for name in numbers:
        np.testing.assert_allclose(found[name], differences[name], rtol=1e-6)


def test_masses_alone_from_a_state_that_is_given():
    """Only the forces depend on the numbers: right-hand sides of corrections have no derivative."""

    def final_angle(mass):
        settings = SCENE.settings("regular", {"rod_mass": mass})
        mechanism = SCENE.mechanism(settings)
        start = lx.State(jnp.array([0.0, 0.4, 0.0]), jnp.zeros(3))
        found = lx.simulate(mechanism, start, t1=0.3, accuracy=lx.Accuracy(rtol=1e-10), saveat=SAVE_END)
        return found.end.q[0]

    found, step = jax.jit(jax.grad(final_angle))(0.2), 1e-4
    difference = (jax.jit(final_angle)(0.2 + step) - jax.jit(final_angle)(0.2 - step)) / (2 * step)
    np.testing.assert_allclose(found, difference, rtol=1e-6)
