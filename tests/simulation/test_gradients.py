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
from mechanisms import pendulum
from scipy.integrate import solve_ivp

import linkax as lx
from linkax.equations.coordinates import rates
from linkax.equations.dynamics import generalised_force
from linkax.equations.loops import gamma
from linkax.equations.motion import move
from linkax.equations.system import system_of
from linkax.formulations.formulation import linear_system
from linkax.scenes import SCENES

SCENE = SCENES["crank-slider"]
SAVE_END = diffrax.SaveAt(t1=True)
MASSES = ("crank_mass", "rod_mass", "slider_mass")


class Case(NamedTuple):
    """A scene, of which all numbers change, and the mass and the inertia of each body by themselves."""

    scene: str
    t1: float
    count: int | None = None

    def settings(self, variant=None):
        return SCENES[self.scene].settings(variant, {"N": self.count} if self.count else {})

    def size(self):
        """How many coordinates and speeds there are."""
        topology = SCENES[self.scene].mechanism(self.settings()).topology
        return topology.num_coordinates + topology.num_speeds

    def numbers(self, variant=None):
        """Values of all parameters that are no counts, and ones for masses and inertias of the bodies."""
        settings = self.settings(variant)
        bodies = SCENES[self.scene].mechanism(settings).bodies
        values = [value for value in settings.values() if not isinstance(value, int)]
        return jnp.asarray([*values, *np.ones(2 * len(bodies))])

    def start(self, numbers, duplicated=False):
        """Mechanism and initial state."""
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
        return mechanism, scene.initial(mechanism, settings)

    def end(self, numbers, t1, duplicated=False):
        """Coordinates and speeds at t1."""
        mechanism, state = self.start(numbers, duplicated)
        end = lx.simulate(mechanism, state, t1=t1, accuracy=lx.Accuracy(rtol=1e-12), saveat=SAVE_END).end
        return jnp.concatenate([end.q, end.v])

    def rates(self, numbers, t, y):
        """q̇ and v̇ of M v̇ = f + Jᵀ (J M⁻¹ Jᵀ)⁺ (γ − J M⁻¹ f), on loops that nothing keeps closed."""
        mechanism = self.start(numbers)[0]
        system = system_of(mechanism, float)
        q, v = jnp.split(y, [mechanism.topology.num_coordinates])
        configuration, jacobian, mass, _ = linear_system(system, t, q)
        motion = move(configuration, v)
        free, reach = (jnp.linalg.solve(mass, right) for right in (generalised_force(motion), jacobian.T))
        multipliers = jnp.linalg.pinv(jacobian @ reach, rtol=1e-9, hermitian=True) @ (gamma(motion) - jacobian @ free)
        return jnp.concatenate([rates(mechanism.topology, q, v), free + reach @ multipliers])


def again(joint):
    """The same joint a second time, cut."""
    joint = copy.copy(joint)
    for field, value in (("name", f"{joint.name}_again"), ("cut", True)):
        object.__setattr__(joint, field, value)
    return joint


CASES = {
    "pendulum": Case("pendulum", 1.0),
    "crank-slider": Case("crank-slider", 1.0),
    "bricard": Case("bricard", 1.0),
    "n-four-bar": Case("n-four-bar", 0.8, 5),
    "spatial-four-link": Case("spatial-four-link", 1.0),
    "rigid-crane": Case("rigid-crane", 0.5),
}
LOOPS = [("crank-slider", "regular"), ("crank-slider", "SC4"), *((scene, None) for scene in list(CASES)[2:])]


@functools.cache
def program(scene):
    """The end of a case; and with it, its Jacobian forwards, and backwards along weights."""
    end = CASES[scene].end

    @jax.jit
    def derivatives(numbers, t1, weights):
        found, forwards = jax.linearize(lambda numbers: end(numbers, t1), numbers)
        along = jax.linear_transpose(forwards, numbers)(weights)[0]
        return found, jax.vmap(forwards, out_axes=1)(jnp.eye(len(numbers))), along

    return jax.jit(end), derivatives


def forward_derivatives(scene, numbers, t1=None):
    """Of coordinates and speeds at the end of a case, or at t1."""
    case = CASES[scene]
    return np.asarray(program(scene)[1](numbers, case.t1 if t1 is None else t1, jnp.zeros(case.size()))[1])


def scales(numbers):
    """Of changes: relative, but for numbers that are zero."""
    return np.where(numbers == 0.0, 1.0, np.abs(numbers))


FACTORS = np.array([1.0, -1.0, 2.0, -2.0])
BEFORE_A_PASSAGE = {"n-four-bar": 0.7}  # [s]; through one a pseudo-inverse takes steps of 1e-8 s


def central_differences(function, at, step=3e-4):
    """Of fourth order, along all numbers in their units, of a function of several sets of numbers at once."""
    moves = step * FACTORS[:, None, None] * np.diag(scales(at))
    ends = np.asarray(function(np.concatenate(at + moves))).reshape(*moves.shape[:2], -1)
    return np.tensordot([8.0, -8.0, -1.0, 1.0], ends, 1).T / (12.0 * step)


@pytest.mark.parametrize(
    ("scene", "variant"), [("pendulum", None), *(pytest.param(*loop, marks=pytest.mark.slow) for loop in LOOPS)]
)
def test_both_modes_agree_with_central_differences(scene, variant):
    """To 1e-6 of the largest derivative of the same coordinate or speed, of relative changes."""
    case, (end, derivatives) = CASES[scene], program(scene)
    at, t1, weights = case.numbers(variant), case.t1, np.random.default_rng(0).normal(size=case.size())
    _, forwards, backwards = (np.asarray(part) for part in derivatives(at, t1, weights))
    backwards, forwards = backwards * scales(at), forwards * scales(at)
    np.testing.assert_allclose(backwards, weights @ forwards, rtol=1e-9, atol=1e-9 * np.max(np.abs(backwards)))
    ends = lambda several: np.stack([end(numbers, t1) for numbers in several])
    off = np.abs(central_differences(ends, at) - forwards) / np.max(np.abs(forwards), axis=1, keepdims=True)
    assert np.max(off) <= 1e-6


@pytest.mark.slow
@pytest.mark.parametrize(("scene", "variant"), LOOPS)
def test_forwards_agrees_with_integrated_sensitivities(scene, variant):
    """To 1e-6 likewise: of the equations of motion with a pseudo-inverse, by scipy, together with their derivatives."""
    case = CASES[scene]
    at, t1 = case.numbers(variant), BEFORE_A_PASSAGE.get(scene, case.t1)

    @jax.jit
    def of_all(t, y, to_y):
        change = lambda to_numbers, to_y: jax.jvp(lambda p, y: case.rates(p, t, y), (at, y), (to_numbers, to_y))
        rates, to_rates = jax.vmap(change, in_axes=(0, 1), out_axes=(None, 1))(jnp.eye(len(at)), to_y)
        return jnp.concatenate([rates[:, None], to_rates], axis=1)

    begin = lambda numbers: jnp.concatenate(jax.tree.leaves(case.start(numbers)[1]))
    begins = np.column_stack([begin(at), jax.jit(jax.jacfwd(begin))(at)])

    def flat(t, flattened):
        both = flattened.reshape(begins.shape)
        return np.asarray(of_all(t, both[:, 0], both[:, 1:])).ravel()

    found = solve_ivp(flat, (0.0, t1), begins.ravel(), method="DOP853", rtol=1e-10, atol=1e-11)
    integrated = found.y[:, -1].reshape(begins.shape)[:, 1:] * scales(at)
    forwards = forward_derivatives(scene, at, t1) * scales(at)
    off = np.abs(integrated - forwards) / np.max(np.abs(forwards), axis=1, keepdims=True)
    assert np.max(off) <= 1e-6


@pytest.mark.slow
@pytest.mark.parametrize("scene", ["bricard", "rigid-crane"])
def test_duplicated_cut_joints_change_no_derivative(scene):
    case = CASES[scene]
    at = case.numbers()
    duplicated = jax.jit(jax.jacfwd(lambda numbers: case.end(numbers, case.t1, duplicated=True)))(at) * scales(at)
    forwards = forward_derivatives(scene, at) * scales(at)
    np.testing.assert_allclose(duplicated, forwards, atol=1e-9 * np.max(np.abs(forwards)))


@pytest.mark.slow
def test_hessian_times_vector():
    """Forwards over backwards, against differences of gradients: of where the slider is."""
    _, derivatives = program("crank-slider")
    gradient = jax.jit(lambda numbers: derivatives(numbers, 0.5, jnp.zeros(6).at[1].set(1.0))[2])
    at = CASES["crank-slider"].numbers("SC4")
    along = jnp.asarray(np.random.default_rng(0).normal(size=len(at)))
    product = jax.jit(lambda at: jax.jvp(gradient, (at,), (along,))[1])(at)
    slope, step = lambda factor: gradient(at + factor * step * along), 1e-4
    differences = (8.0 * (slope(1) - slope(-1)) - (slope(2) - slope(-2))) / (12.0 * step)
    np.testing.assert_allclose(product, differences, rtol=1e-5, atol=1e-5 * np.max(np.abs(differences)))


@pytest.mark.slow
def test_second_derivatives_forwards():
    """Of a pendulum by its length l: its motion depends on t / √l alone."""
    gravity, t1, at = 9.81, 1.0, 0.9

    def angle(length):
        end = lx.simulate(pendulum(length), lx.State(jnp.zeros(1), jnp.zeros(1)), t1=t1, saveat=SAVE_END).end
        return end.q[0], end.v[0]

    both = jax.jit(lambda length: (angle(length), jax.jacfwd(jax.jacfwd(angle))(length)))
    (angle_end, speed_end), (twice, _) = both(at)
    acceleration = -1.5 * gravity / at * jnp.cos(angle_end)
    exact = acceleration * (t1 / at) ** 2 / 4 + 0.75 * speed_end * t1 / at**2
    np.testing.assert_allclose(twice, exact, rtol=1e-6)
    with pytest.raises(ValueError, match=r"[Rr]everse-mode"):
        jax.grad(jax.grad(lambda length: angle(length)[0]))(at)


slowly = lambda *modes: pytest.param(modes, marks=pytest.mark.slow)


@pytest.mark.parametrize("modes", [slowly(jax.jacrev), slowly(jax.jacfwd), slowly(jax.jacfwd, jax.jacfwd)])
def test_times_of_a_driven_joint(modes):
    """By the end of the run and by times at which it is saved, with rows that depend on time."""
    mechanism = pendulum(constraints=[lx.Drive("motor", "hinge", jnp.sin)])
    start = lx.assemble(mechanism)

    def motion(t1, saved):
        saveat = diffrax.SaveAt(ts=saved[None], t1=True)
        found = lx.simulate(mechanism, start, t1=t1, saveat=saveat)
        return jnp.stack([*found.q[:, 0], *found.v[:, 0], *found.ts, found.end.q[0], found.t_end])

    t1, saved = jnp.asarray(1.2), jnp.asarray(0.7)
    expected = lambda t1, saved: jnp.stack(
        [jnp.sin(saved), jnp.sin(t1), jnp.cos(saved), jnp.cos(t1), saved, t1, jnp.sin(t1), t1]
    )
    np.testing.assert_allclose(motion(t1, saved), expected(t1, saved), atol=1e-9)
    for mode in modes:
        motion, expected = mode(motion, (0, 1)), mode(expected, (0, 1))
    flat = lambda tree: np.stack(jax.tree.leaves(tree))
    np.testing.assert_allclose(flat(jax.jit(motion)(t1, saved)), flat(expected(t1, saved)), atol=1e-7)


@pytest.mark.slow
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

    names, values = list(SCENE.parameters), jnp.array([1.0, 1.2, 0.8])
    masses, angle = np.array([names.index(name) for name in MASSES]), names.index("angle")
    _, derivatives = program("crank-slider")
    at = CASES["crank-slider"].numbers("SC1").at[masses].set(values).at[angle].set(0.0)
    slider = jnp.zeros(6).at[1].set(1.0)
    end, forwards, backwards = derivatives(at, t1, slider)
    np.testing.assert_allclose(end @ slider, reduced(values), atol=1e-9)
    for found in (slider @ forwards, backwards):
        np.testing.assert_allclose(found[masses], jax.jacfwd(reduced)(values), rtol=1e-6)


@pytest.mark.slow
def test_masses_alone_from_a_state_that_is_given():
    """Only the forces depend on the numbers: right-hand sides of corrections have no derivative."""

    case = CASES["crank-slider"]
    at, place = case.numbers("regular"), list(SCENE.parameters).index("rod_mass")
    start = case.start(at)[1]

    def final_angle(mass):
        mechanism = case.start(at.at[place].set(mass))[0]
        return lx.simulate(mechanism, start, t1=case.t1, accuracy=lx.Accuracy(rtol=1e-12), saveat=SAVE_END).end.q[0]

    found = jax.jit(jax.grad(final_angle))(at[place])
    np.testing.assert_allclose(found, forward_derivatives("crank-slider", at)[0, place], rtol=1e-9)
