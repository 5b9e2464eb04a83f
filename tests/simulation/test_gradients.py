"""Derivatives of a simulation: of every number, in both modes, redundant or not, through singular passages too."""

import copy
import functools
from typing import NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import linkax as lx
from linkax.scenes import SCENES

SCENE = SCENES["crank-slider"]
SAVE_END = diffrax.SaveAt(t1=True)
MASSES = ("crank_mass", "rod_mass", "slider_mass")


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


class Case(NamedTuple):
    """A scene, of which all numbers change, and the mass and the inertia of each body by themselves."""

    scene: str
    t1: float
    count: int | None = None

    def numbers(self, variant=None):
        """Values of all parameters that are no counts, and ones for masses and inertias of the bodies."""
        settings = SCENES[self.scene].settings(variant, {"N": self.count} if self.count else {})
        bodies = SCENES[self.scene].mechanism(settings).bodies
        values = [value for value in settings.values() if not isinstance(value, int)]
        return jnp.asarray([*values, *np.ones(2 * len(bodies))])

    def end(self, numbers, duplicated=False):
        """Coordinates and speeds at t1."""
        scene = SCENES[self.scene]
        names = [name for name, value in scene.parameters.items() if not isinstance(value, int)]
        settings = dict(zip(names, numbers, strict=False)) | ({"N": self.count} if self.count else {})
        mechanism = scene.mechanism(settings)
        masses, inertias = jnp.split(numbers[len(names) :], 2)
        bodies = [
            eqx.tree_at(lambda b: (b.mass, b.inertia), body, (body.mass * masses[i], body.inertia * inertias[i]))
            for i, body in enumerate(mechanism.bodies)
        ]
        joints = list(mechanism.joints)
        cuts = mechanism.topology.joints[mechanism.topology.num_bodies :]
        joints += [again(mechanism.joint(name)) for name in cuts if duplicated]
        mechanism = lx.Mechanism(bodies, joints, mechanism.forces, mechanism.constraints)
        state, accuracy = scene.initial(mechanism, settings), lx.Accuracy(rtol=1e-12)
        end = lx.simulate(mechanism, state, t1=self.t1, accuracy=accuracy, saveat=SAVE_END).end
        return jnp.concatenate([end.q, end.v])


def again(joint):
    """The same joint a second time, cut."""
    joint = copy.copy(joint)
    for field, value in (("name", f"{joint.name}_again"), ("cut", True)):
        object.__setattr__(joint, field, value)
    return joint


CASES = {
    "crank-slider": Case("crank-slider", 1.0),
    "bricard": Case("bricard", 1.0),
    "n-four-bar": Case("n-four-bar", 0.8, 5),
    "spatial-four-link": Case("spatial-four-link", 1.0),
    "rigid-crane": Case("rigid-crane", 0.5),
}
SLOW = ("n-four-bar", "spatial-four-link", "rigid-crane")
marked = lambda scene, *more: pytest.param(scene, *more, marks=[pytest.mark.slow] if scene in SLOW else [])
VARIANTS = [("crank-slider", "regular"), ("crank-slider", "SC4"), *(marked(scene, None) for scene in list(CASES)[1:])]


@functools.cache
def program(scene):
    """The end of a case, and with it its Jacobian forwards, and backwards along weights of its rows."""
    end = CASES[scene].end

    @jax.jit
    def derivatives(numbers):
        value, forwards = jax.linearize(end, numbers)
        weights = jnp.asarray(np.random.default_rng(0).normal(size=value.shape))
        along = jax.linear_transpose(forwards, numbers)(weights)[0]
        return jax.vmap(forwards, out_axes=1)(jnp.eye(len(numbers))), along, weights

    return jax.jit(end), derivatives


def units(numbers):
    """Of changes: relative, but for numbers that are zero."""
    return np.where(numbers == 0.0, 1.0, np.abs(numbers))


def central_differences(function, at, step=3e-4):
    """Of fourth order, along all numbers in their units."""

    def along(unit):
        value = lambda factor: np.asarray(function(at + factor * step * unit))
        return (8.0 * (value(1.0) - value(-1.0)) - (value(2.0) - value(-2.0))) / (12.0 * step)

    return np.stack([along(unit) for unit in np.diag(units(at))], axis=1)


@pytest.mark.parametrize(("scene", "variant"), VARIANTS)
def test_both_modes_agree_with_central_differences(scene, variant):
    """To 1e-6 of the largest derivative of the same coordinate or speed, of relative changes."""
    at, (end, derivatives) = CASES[scene].numbers(variant), program(scene)
    forwards, backwards, weights = (np.asarray(part) for part in derivatives(at))
    backwards, forwards = backwards * units(at), forwards * units(at)
    np.testing.assert_allclose(backwards, weights @ forwards, rtol=1e-9, atol=1e-9 * np.max(np.abs(backwards)))
    off = np.abs(central_differences(end, at) - forwards) / np.max(np.abs(forwards), axis=1, keepdims=True)
    assert np.max(off) <= 1e-6


@pytest.mark.parametrize("scene", [marked("bricard"), marked("rigid-crane")])
def test_duplicated_cut_joints_change_no_derivative(scene):
    case, (_, derivatives) = CASES[scene], program(scene)
    at = case.numbers()
    duplicated = jax.jit(jax.jacfwd(lambda numbers: case.end(numbers, duplicated=True)))(at) * units(at)
    forwards = derivatives(at)[0] * units(at)
    np.testing.assert_allclose(duplicated, forwards, atol=1e-9 * np.max(np.abs(forwards)))


@pytest.mark.slow
def test_hessian_times_vector():
    """Forwards over backwards, against differences of gradients."""
    at, along = numbers(), {name: jnp.asarray(0.5 + index) for index, name in enumerate(numbers())}
    slope = lambda step: REVERSE({name: at[name] + step * along[name] for name in at}, 0.5)
    (near, back, far, beyond), step = (slope(factor * 1e-4) for factor in (1, -1, 2, -2)), 1e-4
    product = jax.jit(lambda at: jax.jvp(lambda at: REVERSE(at, 0.5), (at,), (along,))[1])(at)
    differences = {name: (8 * (near[name] - back[name]) - (far[name] - beyond[name])) / (12 * step) for name in at}
    scale = max(abs(float(value)) for value in differences.values())
    for name in at:
        np.testing.assert_allclose(product[name], differences[name], rtol=1e-5, atol=1e-5 * scale)


def test_second_derivatives_forwards():
    """Forwards twice, against backwards once and forwards once, of a pendulum."""

    def angle(length):
        arm = lx.rod("arm", length=length, mass=1.0)
        hinge = lx.Revolute("hinge", lx.GROUND, arm.at("base"), axis="z")
        mechanism = lx.Mechanism([arm], [hinge], [lx.Gravity([0.0, -9.81, 0.0])])
        return lx.simulate(mechanism, lx.State(jnp.zeros(1), jnp.zeros(1)), t1=1.0, saveat=SAVE_END).q[0, 0]

    twice = jax.jit(jax.jacfwd(jax.jacfwd(angle)))(0.9)
    np.testing.assert_allclose(twice, jax.jit(jax.jacfwd(jax.grad(angle)))(0.9), rtol=1e-9)
    with pytest.raises(ValueError, match=r"[Rr]everse-mode"):
        jax.grad(jax.grad(angle))(0.9)


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
