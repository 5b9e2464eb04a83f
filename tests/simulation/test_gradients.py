"""Derivatives of a simulation, through singular passages too."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np

import linkax as lx
from linkax.scenes import SCENES

SCENE = SCENES["crank-slider"]
SAVE_END = diffrax.SaveAt(t1=True)


def final_position(numbers, t1, adjoint=None):
    """Where the slider of the crank-slider is at t1, of all the scene's numbers."""
    settings = SCENE.settings("SC4", numbers)
    mechanism = SCENE.mechanism(settings)
    state, accuracy = SCENE.initial(mechanism, settings), lx.Accuracy(rtol=1e-12)
    found = lx.simulate(mechanism, state, t1=t1, accuracy=accuracy, saveat=SAVE_END, adjoint=adjoint)
    return found.position("slider")[0, 0]


# Compiled once, for all tests here.
POSITION = jax.jit(final_position)
REVERSE = jax.jit(jax.grad(final_position))


def numbers(**changes):
    given = {"crank": 1.0, "rod": 1.0, "angle": np.pi / 3, "gravity": 9.81} | dict.fromkeys(MASSES, 1.0) | changes
    return {name: jnp.asarray(number) for name, number in given.items()}


MASSES = ("crank_mass", "rod_mass", "slider_mass")


def central_differences(function, numbers, step=1e-4):
    """Fourth order, so that a step is found where neither truncation nor rounding matter."""

    def along(name):
        at = lambda factor: function({**numbers, name: numbers[name] + factor * step})
        return (8.0 * (at(1.0) - at(-1.0)) - (at(2.0) - at(-2.0))) / (12.0 * step)

    return {name: along(name) for name in numbers}


def test_reverse_and_forward_mode_agree_with_central_differences():
    at = numbers()
    reverse = REVERSE(at, 1.0)
    forward = jax.jit(jax.jacfwd(lambda numbers: final_position(numbers, 1.0, diffrax.ForwardMode())))(at)
    differences = central_differences(lambda numbers: POSITION(numbers, 1.0), at)
    for name in at:
        np.testing.assert_allclose(forward[name], reverse[name], rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(reverse[name], differences[name], rtol=1e-6, atol=1e-9)


def test_lengths_that_differ():
    at = numbers(crank=0.8, rod=1.1)
    found, differences = REVERSE(at, 1.0), central_differences(lambda numbers: POSITION(numbers, 1.0), at)
    for name in at:
        np.testing.assert_allclose(found[name], differences[name], rtol=1e-6, atol=1e-9)


def test_masses_through_three_passages():
    """SC1 against the motion of the crank alone, by Lagrange's equation, differentiated as it is solved."""
    t1, gravity = 5.0, 9.81

    def reduced(masses):
        crank, rod, slider = masses
        inertia = lambda a: crank / 3 + rod * (1 / 3 + 2 * jnp.sin(a) ** 2) + 4 * slider * jnp.sin(a) ** 2
        height = lambda a: 0.5 * (crank + rod) * jnp.sin(a)

        def rates(t, y, args):
            a, w = y
            force = -0.5 * jax.grad(inertia)(a) * w**2 - gravity * jax.grad(height)(a)
            return w, force / inertia(a)

        found = diffrax.diffeqsolve(
            diffrax.ODETerm(rates),
            diffrax.Dopri8(scan_kind="lax"),
            0.0,
            t1,
            1e-3,
            (jnp.zeros(()), jnp.zeros(())),
            adjoint=diffrax.ForwardMode(),
            max_steps=6000,
        )
        return 2.0 * jnp.cos(found.ys[0][0])

    masses = {"crank_mass": 1.0, "rod_mass": 1.2, "slider_mass": 0.8}
    at, values = numbers(angle=0.0, **masses), jnp.array(list(masses.values()))
    np.testing.assert_allclose(POSITION(at, t1), reduced(values), atol=1e-9)
    found, exact = REVERSE(at, t1), jax.jacfwd(reduced)(values)
    for name, derivative in zip(masses, exact, strict=True):
        np.testing.assert_allclose(found[name], derivative, rtol=1e-6)


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
