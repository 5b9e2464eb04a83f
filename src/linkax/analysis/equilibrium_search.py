"""Search downhill for an equilibrium, on the tangent space of the loops."""

import dataclasses
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Float, Int

from linkax.analysis.eigenpairs import eigh
from linkax.analysis.steady import Nearby, largest_force
from linkax.equations.constraint_rows import is_driven
from linkax.equations.coordinates import retract
from linkax.equations.dynamics import generalised_force
from linkax.equations.internal_states import bound, internal_rates
from linkax.equations.motion import Motion, move
from linkax.equations.system import System
from linkax.formulations.constraint_split import ConstraintSplit
from linkax.formulations.tangent_space import TangentSpace
from linkax.linalg.constrained_solve import constrained_solve
from linkax.model.forces.internal_states import scales
from linkax.simulation.start.closing import LONGEST_STEP
from linkax.xla.arrays import Array
from linkax.xla.batches import one_by_one
from linkax.xla.derivatives import pushforward, ratio

MOST_STEPS = 200
UNFELT = 1e-9  # forces that rounding leaves, relative to all forces; and rates, in scales of states [1/s]
SMALLEST_STEP = 1e-12  # at which the search ends [rad, lengths of the mechanism]
OVERSHOOT = 0.5  # work of the forces at the end of a step, against it, relative to their work at its start
NEUTRAL = 1e-12  # stiffness, relative to the largest, up to which it counts as zero
ASIDE = 1e-3  # first step out of an unstable equilibrium [rad, lengths of the mechanism]; each next one doubles it

_pseudo_inverse = one_by_one(lambda matrix: jnp.linalg.pinv(matrix, rtol=NEUTRAL))

# An equilibrium needs no mass, and forces differ less between soft and stiff directions than accelerations do.
STATICS = TangentSpace(metric="identity")


class Balanced(Nearby):
    """A mechanism near an equilibrium: its forces, centrifugal ones included, on a T orthonormal in the scales."""

    @staticmethod
    def of(system: System, method: TangentSpace, t: Float[Array, ""], q: Float[Array, " n_q"]) -> "Balanced":
        basis = lax.stop_gradient(method.constraint_split(system, t, q).inverse.basis)
        return Balanced(system, method, t, q, basis, basis.T / system.scales**2)

    def motion(self, y: Float[Array, " n_v"]) -> tuple[Motion, ConstraintSplit]:
        """The motion at q ⊕ T y with the smallest v that has J v = b, and the split there."""
        zero = jnp.zeros_like(self.system.scales)
        q, v, *_ = self.method.correct(self.system, self.t, self.at(y), zero)
        split = self.method.constraint_split(self.system, self.t, q)
        return move(split.configuration, v if is_driven(self.system) else zero), split

    def force(self, y: Float[Array, " n_v"]) -> Float[Array, " n_v"]:
        """Forces along y, less the reactions of the loops."""
        motion, split = self.motion(y)
        forces, none = generalised_force(motion), jnp.zeros(len(split.jacobian), y.dtype)
        metric = jnp.diag(self.system.scales**-2)
        left, _ = constrained_solve(split.inverse, metric, split.jacobian, forces, none)
        return self.dual @ left

    def force_and_stiffness(self) -> tuple[Float[Array, " n_v"], Float[Array, "n_v n_v"]]:
        """The force f at y = 0, and the stiffness −∂f/∂y."""
        force, slopes = self.slopes(self.force, jnp.zeros_like(self.system.scales))
        return force, -slopes


class Search(NamedTuple):
    """A search for an equilibrium.

    - `steps`: number of steps tried.
    - `q`: coordinates reached. `step`: change of them to try next, (n_v,); `longest`: its largest part [rad, lengths of
      the mechanism]; `work`: of the forces on it [J].
    - `lowest`: smallest stiffness in any direction, zero where none is negative.
    - `circulation`: largest entry of the skew part of the stiffness, which has no potential.
    """

    steps: Int[Array, ""]
    q: Float[Array, " n_q"]
    step: Float[Array, " n_v"]
    longest: Float[Array, ""]
    work: Float[Array, ""]
    lowest: Float[Array, ""]
    circulation: Float[Array, ""]


@eqx.filter_custom_jvp
def search_downhill(
    system: System, t: Float[Array, ""], q: Float[Array, " n_q"]
) -> tuple[Float[Array, " n_q"], Search]:
    """Coordinates of an equilibrium, and the last `Search`, from coordinates q."""
    method, zero = STATICS.prepared(system.dtype), jnp.zeros(system.topology.num_speeds, system.dtype)
    size = system.fastest

    def unfinished(search):
        return (search.steps < MOST_STEPS) & (search.longest > SMALLEST_STEP)

    def advance(search):
        """Try a step. If it goes beyond the minimum of the potential, or off the loops, halve it, else choose the next.

        A step is f / |k| along each eigenvector of the stiffness. At an equilibrium that is unstable it is one along
        the least stable direction.
        """
        q, _, holds = method.close_near(system, t, retract(system.topology, search.q, search.step), zero)
        here = Balanced.of(system, method, t, q)
        force, stiffness = here.force_and_stiffness()
        values, vectors = eigh((stiffness + stiffness.T) / 2.0)
        stiff = jnp.abs(values) > NEUTRAL * jnp.max(jnp.abs(values))
        along = vectors.T @ force
        downhill = vectors @ ratio(along, jnp.where(stiff, jnp.abs(values), 0.0))
        step = here.basis @ downhill
        shorter = jnp.minimum(1.0, ratio(LONGEST_STEP, size(step)))
        lowest = jnp.where(stiff[0], jnp.minimum(values[0], 0.0), 0.0)
        circulation = jnp.max(jnp.abs(stiffness - stiffness.T)) / 2.0
        aside = here.basis @ vectors[:, 0]
        # The sign of an eigenvector is arbitrary: let its largest part be positive.
        aside = aside * jnp.sign(aside[jnp.argmax(jnp.abs(aside / system.scales))])
        leave = (size(step) <= SMALLEST_STEP) & (lowest < 0.0) & (circulation <= -lowest)
        step, work = jnp.where(leave, ASIDE * aside / size(aside), shorter * step), shorter * (downhill @ force)
        onwards = Search(search.steps + 1, q, step, size(step), jnp.where(leave, 0.0, work), lowest, circulation)
        half = search._replace(
            steps=search.steps + 1, step=search.step / 2.0, longest=search.longest / 2.0, work=search.work / 2.0
        )
        beyond = (here.dual @ search.step) @ force < -OVERSHOOT * search.work
        beyond = beyond | ((search.steps > 0) & jnp.logical_not(holds))
        return jax.tree.map(lambda a, b: jnp.where(beyond, a, b), half, onwards)

    nothing = jnp.zeros((), system.dtype)
    begin = Search(jnp.zeros((), int), q, zero, nothing + jnp.inf, *3 * (nothing,))
    search = lax.while_loop(unfinished, advance, begin)
    return search.q, search


@search_downhill.def_jvp
def _jvp(primals, tangents):
    """Derivatives, to any order, of the coordinates at which the forces balance; those of the search do not matter."""
    (system, t, begin), (system_change, t_change, _) = primals, tangents
    q, search = search_downhill(system, t, begin)
    here = Balanced.of(system, STATICS.prepared(system.dtype), t, q)
    zero = jnp.zeros(system.topology.num_speeds, system.dtype)
    force = lambda system, t: dataclasses.replace(here, system=system, t=t).force(zero)
    _, unbalanced = pushforward(force, (system, t), (system_change, t_change))
    change = _pseudo_inverse(here.force_and_stiffness()[1]) @ unbalanced

    def moved(system, t, y):
        return here.method.close(system, t, retract(system.topology, q, here.basis @ y), zero)[0]

    _, q_change = pushforward(moved, (system, t, zero), (system_change, t_change, change))
    return (q, search), (q_change, jax.tree.map(lambda _: None, search))


class Standstill(NamedTuple):
    """A search for coordinates and internal states of force elements at which forces balance and states stand still.

    - `q`, `internal`: reached. `longest`: the largest part of the last step, or of what steps cannot balance [rad,
      lengths of the mechanism, scales].
    - `most`: the longest step that is tried [rad, lengths of the mechanism].
    """

    steps: Int[Array, ""]
    q: Float[Array, " n_q"]
    internal: Float[Array, " n_s"]
    longest: Float[Array, ""]
    most: Float[Array, ""]


class _WithStates(NamedTuple):
    """A mechanism near an equilibrium, displaced by z: y on the tangent space, and states in their scales.

    `system`: whose forces are not bound to values of their states.
    """

    system: System
    t: Float[Array, ""]
    q: Float[Array, " n_q"]
    internal: Float[Array, " n_s"]
    near: Balanced

    @staticmethod
    def of(
        system: System, t: Float[Array, ""], q: Float[Array, " n_q"], internal: Float[Array, " n_s"]
    ) -> "_WithStates":
        near = Balanced.of(bound(system, internal), STATICS.prepared(system.dtype), t, q)
        return _WithStates(system, t, q, internal, near)

    @property
    def units(self) -> Float[Array, " n_s"]:
        return scales([force.itself for force in self.system.forces], self.system.dtype)

    @property
    def nothing(self) -> Float[Array, " n"]:
        return jnp.zeros(self.system.topology.num_speeds + len(self.internal), self.system.dtype)

    def unbalanced(self, z: Float[Array, " n"]) -> Float[Array, " n"]:
        """Forces along y, less the reactions of the loops, and rates of the states in their scales."""
        y, states = jnp.split(z, [self.system.topology.num_speeds])
        system = bound(self.system, self.internal + self.units * states)
        here = dataclasses.replace(self.near, system=system, t=self.t)
        return jnp.concatenate([here.force(y), internal_rates(here.motion(y)[0]) / self.units])

    def off(self, slopes: Float[Array, "n n"], unbalanced: Float[Array, " n"]) -> Float[Array, ""]:
        """How far z would have to go to balance what is unbalanced most, infinite where nothing would."""
        forces = largest_force(self.near.motion(jnp.zeros_like(self.system.scales))[0])
        rounding = jnp.where(jnp.arange(len(unbalanced)) < len(self.system.scales), forces, 1.0) * UNFELT
        felt = jnp.where(jnp.abs(unbalanced) > rounding, jnp.abs(unbalanced), 0.0)
        return jnp.max(ratio(felt, jnp.sum(jnp.abs(slopes), axis=1), jnp.where(felt > 0.0, jnp.inf, 0.0)))

    def step(self, slopes: Float[Array, "n n"], unbalanced: Float[Array, " n"]) -> Float[Array, " n"]:
        """The smallest z that balances what is unbalanced, to first order."""
        size = jnp.max(jnp.abs(slopes), axis=1)
        return -_pseudo_inverse(ratio(slopes, size[:, None])) @ ratio(unbalanced, size)


@eqx.filter_custom_jvp
def search_standstill(
    system: System, t: Float[Array, ""], q: Float[Array, " n_q"], internal: Float[Array, " n_s"]
) -> tuple[Float[Array, " n_q"], Float[Array, " n_s"], Standstill]:
    """Coordinates and internal states of an equilibrium, by Newton's method, and the last `Standstill`.

    What the equations leave open, such as the pressure of locked oil, changes as little as they allow.
    """
    method, zero = STATICS.prepared(system.dtype), jnp.zeros(system.topology.num_speeds, system.dtype)

    def unfinished(search):
        return (search.steps < MOST_STEPS) & (search.longest > SMALLEST_STEP)

    def advance(search):
        here = _WithStates.of(system, t, search.q, search.internal)
        unbalanced, slopes = here.near.slopes(here.unbalanced, here.nothing)
        step = here.step(slopes, unbalanced)
        change, states = here.near.basis @ step[: len(zero)], step[len(zero) :]
        size = system.fastest(change)
        shorter = jnp.minimum(1.0, ratio(search.most, size))
        q, _, holds = method.close_near(system, t, retract(system.topology, search.q, shorter * change), zero)
        longest = jnp.maximum(jnp.maximum(size, jnp.max(jnp.abs(states))), here.off(slopes, unbalanced))
        states = search.internal + shorter * here.units * states
        # A step that leaves the loops is tried again, half as long.
        q, states = jax.tree.map(lambda new, old: jnp.where(holds, new, old), (q, states), (search.q, search.internal))
        most = jnp.where(holds, LONGEST_STEP, jnp.minimum(search.most, size) / 2.0)
        return Standstill(search.steps + 1, q, states, longest, most)

    q, _ = method.close(system, t, q, zero)
    infinite = jnp.asarray(jnp.inf, system.dtype)
    begin = Standstill(jnp.zeros((), int), q, internal, infinite, jnp.full_like(infinite, LONGEST_STEP))
    search = lax.while_loop(unfinished, advance, begin)
    return search.q, search.internal, search


@search_standstill.def_jvp
def _standstill_jvp(primals, tangents):
    """Derivatives, to any order, of where forces balance and states stand still."""
    (system, t, *begin), (system_change, t_change, *_) = primals, tangents
    q, internal, search = search_standstill(system, t, *begin)
    here = _WithStates.of(system, t, q, internal)
    zero = jnp.zeros(system.topology.num_speeds, system.dtype)
    left = lambda system, t: here._replace(system=system, t=t).unbalanced(here.nothing)
    _, unbalanced = pushforward(left, (system, t), (system_change, t_change))
    change = here.step(here.near.slopes(here.unbalanced, here.nothing)[1], unbalanced)

    def moved(system, t, y):
        return here.near.method.close(system, t, retract(system.topology, q, here.near.basis @ y), zero)[0]

    _, q_change = pushforward(moved, (system, t, zero), (system_change, t_change, change[: len(zero)]))
    of_search = jax.tree.map(lambda _: None, search)
    return (q, internal, search), (q_change, here.units * change[len(zero) :], of_search)
