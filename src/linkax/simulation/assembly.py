"""Consistent states from partial positions and speeds."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from linkax.equations.configuration import configure
from linkax.equations.coordinates import neutral, on_manifold, rates, retract
from linkax.equations.loops import Gap, as_if_closed, flips, gaps, jacobian, rate, residual
from linkax.equations.motion import move
from linkax.equations.system import System, system_of
from linkax.formulations.branches import Crossing
from linkax.linalg.constrained_solve import constrained_solve, invert
from linkax.model.mechanism import Mechanism
from linkax.model.numbers import known
from linkax.model.terms import Term
from linkax.simulation.accuracy import BALANCED
from linkax.simulation.given import Given, by_joint, coordinates_by_joint
from linkax.simulation.outset import ON_BRANCH, moving_joints
from linkax.simulation.state import State
from linkax.spatial.quaternions import conjugate, multiply, rotation_vector

MOST_STEPS = 100
LONGEST_STEP = 0.7  # radians, or lengths of the mechanism
STEP_FRACTIONS = 0.5 ** np.arange(6)
SMALL = 1e-15
TURNS = 10
BESIDE = 1e-2
CLOSED = 1e-9  # remaining gap, relative to the mechanism's length
# Starts of the search beside the guess, by which it leaves a saddle of the gap, or a bad guess.
ATTEMPTS = np.array([0.0, 1e-2, 1e-1, 0.3, 0.3, 0.6, 0.6, 1.0, 1.0, 1.0, 1.5, 1.5, 1.5, 1.5, 3.0, 3.0, 3.0, 3.0])


class AssemblyError(ValueError):
    """The loops of a mechanism cannot be closed at the positions that were asked for."""


def assemble(mechanism: Mechanism, positions=None, speeds=None, *, guess=None, t=0.0) -> State:
    """A state with closed loops, from coordinates and speeds of some of the joints.

    **Arguments:**

    - `positions`: {joint: coordinates [rad or m]}, of joints in the tree or cut; held. A number for
      a joint with one coordinate, else all of them; see the joint types. For one of several the
      key is (joint, index), counted like the joint's speeds.
    - `speeds`: {joint: speeds [rad/s or m/s]}, likewise; held.
    - `guess`: {joint: coordinates} of joints in the tree, where the search starts (default:
      frames that coincide); chooses the assembly mode.
    - `t`: time [s], which matters to drives.

    Coordinates that are not held change as little as the loops allow from the guess, and
    speeds that are not held are the smallest that the loops allow, both measured in radians
    and in lengths of the mechanism. Where the search does not get from the guess to closed loops,
    it starts again beside it, a little and then farther. In a singular configuration, where
    branches of the motion cross, speeds lie on the branch nearest to these; give more of them to
    choose another.

    **Raises:** `AssemblyError` naming the joint and the remaining gap [m or rad] where a loop
    cannot be closed, or the joints whose motion branches where the speeds lie on no branch;
    `ValueError` for an unknown joint or a wrong number. Inside JAX transformations nothing is
    raised: the speeds are infinite then, and `linkax.simulate` says so in its result.
    """
    positions, guess = (
        coordinates_by_joint(mechanism, *given) for given in ((positions, "position"), (guess, "guess"))
    )
    speeds = by_joint(mechanism, speeds, "speed", lambda joint: len(joint.speed_units))
    for name, _ in guess.terms:
        if name not in mechanism.topology.coordinates:
            raise ValueError(f"guess for joint {name!r}, which is cut; guess coordinates of joints in the tree")
    state, remainder = _assemble(mechanism, positions, speeds, guess, jnp.asarray(t, float))
    if known(state.q) is None:
        return State(state.q, jnp.where(remainder.is_met(), state.v, jnp.inf))
    _raise_if_open(mechanism, state, t, jax.tree.map(np.asarray, remainder))
    return state


def _raise_if_open(mechanism, state, t, remainder):
    topology = mechanism.topology
    held = ", ".join(repr(along.joint) for along in remainder.positions.terms) or "none"
    remains = lambda size, unit: f"a gap of {size:.6g} {unit} remains (positions held: {held})"
    advice = "check lengths and offsets, hold fewer positions, or give another guess"
    cuts = topology.joints[topology.num_bodies :]
    for name, distance, angle in zip(cuts, remainder.gap.distance, remainder.gap.angle, strict=True):
        for size, unit, most in ((distance, "m", CLOSED * remainder.length), (angle, "rad", CLOSED)):
            if not size <= most:
                raise AssemblyError(f"joint {name!r} does not close: {remains(size, unit)}; {advice}")
    for constraint, size in zip(mechanism.constraints, remainder.gap.constraints, strict=True):
        if not size <= remainder.most:
            joints = ", ".join(map(repr, constraint.joints))
            raise AssemblyError(
                f"{constraint.described} of joint {joints} is not met at t = {float(t):.6g} s: "
                f"{remains(size, 'rad or m')}; {advice}"
            )
    for what, misses in (("position", remainder.positions), ("speed", remainder.speeds)):
        for along, miss in zip(misses.terms, misses.values, strict=True):
            if not np.all(np.abs(miss) <= remainder.most):
                size = np.max(np.abs(miss))
                raise AssemblyError(
                    f"the {what} asked of joint {along.joint!r} is missed by {size:.6g}; the loops do not "
                    f"allow it together with the other {what}s given, so ask for fewer"
                )
    if not remainder.off_branch <= ON_BRANCH * BALANCED.method(state.q.dtype).rank_tolerance:
        system = system_of(mechanism, state.q.dtype)
        basis = Crossing.at(system, t, state.q, BALANCED.method(state.q.dtype).rank_tolerance).inverse.basis
        names = ", ".join(map(repr, moving_joints(system, t, state.q, basis)))
        raise AssemblyError(
            "the configuration is singular, and the speeds asked lie on no branch of the motion; its branches cross "
            f"in the motion of joints {names}, so ask for the speeds of other joints among them, or of fewer"
        )


class _Remainder(eqx.Module):
    """What is left open, for the error message."""

    gap: Gap
    length: jax.Array
    positions: Given
    speeds: Given
    off_branch: jax.Array

    @property
    def most(self):
        """What coordinates and speeds may miss."""
        return CLOSED * jnp.maximum(self.length, 1.0)

    def is_met(self):
        """Whether the loops are closed and all that is held is where it should be."""
        missed = [*self.positions.values, *self.speeds.values, self.gap.constraints]
        met = jnp.all(self.gap.distance <= CLOSED * self.length) & jnp.all(self.gap.angle <= CLOSED)
        return met & jnp.array([jnp.all(jnp.abs(miss) <= self.most) for miss in missed]).all()


class _Demand(eqx.Module):
    """Closed loops at time t, and coordinates of joints that are held at values."""

    system: System
    t: jax.Array
    held: Given

    def misses(self, q):
        """How far what is held is from where it should be, one number for each speed."""
        topology, apart = self.system.topology, []
        configuration = configure(self.system, self.t, q)
        for along, entry in zip(self.held.terms, self.held.values, strict=True):
            kind = topology.joint_types[topology.joints.index(along.joint)]
            turning = 3 * kind.has_quaternion
            indices = range(turning, len(kind.speed_units)) if along.index is None else [along.index]
            ends = entry[turning + kind.has_quaternion :] if along.index is None else entry
            away = lambda index, end, name=along.joint: configuration.joint_displacement(Term(name, index), end)
            missed = [away(index, end) for index, end in zip(indices, ends, strict=True)]
            missed = [jnp.stack(missed)] if missed else []
            if kind.has_quaternion and along.index is None:
                found = configuration.joint_coordinates(along.joint)[:4]
                missed.insert(0, rotation_vector(multiply(found, conjugate(entry[:4] / jnp.linalg.norm(entry[:4])))))
            apart.append(jnp.concatenate([jnp.zeros(0, q.dtype), *missed]))
        return tuple(apart)

    def rows(self, q):
        """All that must vanish: loop rows, axes that point apart, misses."""
        configuration = configure(self.system, self.t, q)
        return jnp.concatenate([residual(configuration), flips(configuration)[0], *self.misses(q)])

    def jacobian(self, q):
        """Derivative of the rows, where the loops are closed; elsewhere the direction that closes them."""
        configuration = as_if_closed(configure(self.system, self.t, q))
        still = jnp.zeros(self.system.topology.num_speeds, q.dtype)
        held = jax.jacfwd(lambda change: self.misses(retract(self.system.topology, q, change)))(still)
        return jnp.concatenate([jacobian(configuration), flips(configuration)[1], *held])

    def least_change(self, q, right):
        """The smallest change that changes the rows by `right`, in radians and lengths of the mechanism."""
        units, rows = self.system.units, self.jacobian(q)
        inverse = invert(None, rows, units, BALANCED.method(q.dtype).rank_tolerance)
        return constrained_solve(inverse, jnp.diag(units**-2), rows, jnp.zeros_like(units), right)[0]

    def size(self, q):
        rows = self.rows(q)
        return jnp.sqrt(jnp.sum(rows * rows))

    def descent(self, q):
        """The steepest descent of the rows' squares, as long as their linearisation says."""
        units, rows, slopes = self.system.units, self.rows(q), self.jacobian(q)
        downhill = -(units**2) * (rows @ slopes)
        change = slopes @ downhill
        scale = jnp.sum(change * change)
        return downhill * jnp.where(scale > 0.0, -(rows @ change) / jnp.where(scale > 0.0, scale, 1.0), 0.0)

    def meet(self, q):
        """Damped Newton steps from q until the rows vanish or stop falling; descent where those fail."""

        def unfinished(carry):
            count, _, size, before = carry
            return (count < MOST_STEPS) & (size > SMALL) & (size < before)

        def improve(carry):
            count, q, size, _ = carry
            steps = jnp.stack([self.least_change(q, -self.rows(q)), self.descent(q)])
            longest = jnp.max(jnp.abs(steps / self.system.units), axis=1, keepdims=True, initial=0.0)
            steps = steps * jnp.minimum(1.0, LONGEST_STEP / jnp.where(longest > 0.0, longest, 1.0))
            changes = (STEP_FRACTIONS[:, None, None] * steps).reshape(-1, steps.shape[1])
            tries = jax.vmap(lambda change: retract(self.system.topology, q, change))(changes)
            tries = jnp.concatenate([tries, q[None]])
            sizes = jax.vmap(self.size)(tries)
            best = jnp.argmin(sizes)
            return count + 1, tries[best], sizes[best], size

        begin = (jnp.zeros((), int), q, self.size(q), jnp.asarray(jnp.inf, q.dtype))
        return lax.while_loop(unfinished, improve, begin)[1]

    def search(self, q):
        """Coordinates that meet the demand, from q, or else from beside it; the nearest miss where none do."""
        beside = np.random.default_rng(0).normal(size=(len(ATTEMPTS), self.system.topology.num_speeds))
        starts = jnp.asarray(ATTEMPTS[:, None] * beside, q.dtype) * self.system.units

        def unfinished(carry):
            count, _, size = carry
            return (count < len(ATTEMPTS)) & (size > CLOSED)

        def attempt(carry):
            count, best, size = carry
            found = self.meet(retract(self.system.topology, q, starts[count]))
            reached = self.size(found)
            return count + 1, jnp.where(reached < size, found, best), jnp.minimum(reached, size)

        begin = (jnp.zeros((), int), q, jnp.asarray(jnp.inf, q.dtype))
        return lax.while_loop(unfinished, attempt, begin)[1]


def _speeds(system, t, q, held):
    """The smallest speeds with those of joints held, or near to them on a branch of the motion.

    Newton steps from rest on J v = b, the speeds held, and γ(v, v) in the range of J; the first
    leads to the smallest speeds, and where the rank of J is constant, these are on a branch.

    **Returns:** speeds, (n_v,); how far the smallest speeds are from those held, by joint; and
    how far the speeds are from such a branch, relative to themselves.
    """
    tolerance = BALANCED.method(q.dtype).rank_tolerance
    crossing = Crossing.at(system, t, q, tolerance)

    of_joints = lambda v: held.speeds(move(crossing.configuration, v))
    asked = jnp.concatenate([rate(system, t), *held.values])
    largest = jnp.max(jnp.abs(asked), initial=0.0)
    scale = lax.stop_gradient(jnp.where(largest > 0.0, largest, 1.0))
    still = jnp.zeros(system.topology.num_speeds, q.dtype)
    rows = jnp.concatenate([crossing.jacobian, *jax.jacfwd(of_joints)(still)])
    metric = jnp.diag(system.units**-2)
    # A little beside the smallest speeds, which may lie just between two branches.
    beside = BESIDE * crossing.inverse.basis @ jnp.ones_like(still)

    def off_branch(v):
        fastest = crossing.fastest(v)
        off = jnp.max(jnp.abs(crossing.off_branch(v, scale)), initial=0.0)
        return jnp.where(fastest > 0.0, off / jnp.where(fastest > 0.0, fastest, 1.0) ** 2, 0.0)

    def turn(v, first):
        off = lambda v: crossing.off_branch(v, scale)
        rest = jnp.concatenate([asked / scale - rows @ v, -off(v)])
        slopes = jnp.concatenate([rows, jax.jacfwd(off)(v)])
        inverse = invert(None, slopes, system.units, tolerance)
        v = v + constrained_solve(inverse, metric, slopes, jnp.zeros_like(v), rest)[0]
        return v + jnp.where(first & (off_branch(v) > ON_BRANCH * tolerance), beside, 0.0), v

    v, turns = lax.scan(turn, still, jnp.arange(TURNS) == 0)
    missed = jnp.max(jnp.abs(asked / scale - rows @ v), initial=0.0)
    reached = zip(of_joints(scale * turns[0]), held.values, strict=True)
    misses = Given(held.terms, tuple(found - entry for found, entry in reached))
    return scale * v, misses, jnp.maximum(off_branch(v), missed)


@eqx.filter_custom_jvp
def _found(demand, q):
    """Coordinates that meet a demand, by a search from q."""
    q = demand.search(q)
    # Loops that do not close stay as open as they were found.
    met = demand.size(q) <= CLOSED
    return retract(demand.system.topology, q, jnp.where(met, demand.least_change(q, -demand.rows(q)), 0.0))


@_found.def_jvp
def _found_jvp(primals, changes):
    """Where the rows stay zero, to any order: the search has no derivative."""
    (demand, begin), (change, _) = primals, changes
    q = _found(demand, begin)
    opens = eqx.filter_jvp(lambda demand: demand.rows(q), (demand,), (change,))[1]
    along = jnp.where(demand.size(q) <= CLOSED, demand.least_change(q, -opens), 0.0)
    return q, rates(demand.system.topology, q, along)


@eqx.filter_jit
def _assemble(mechanism, positions, speeds, guess, t):
    system = system_of(mechanism, jnp.result_type(float))
    topology = system.topology
    q = neutral(topology, system.dtype)
    for given in (guess, positions):
        for along, entry in zip(given.terms, given.values, strict=True):
            if along.joint in topology.coordinates:
                q = q.at[topology.places(along)].set(entry)
    q = _found(_Demand(system, t, positions), lax.stop_gradient(on_manifold(topology, q)))
    v, misses, off_branch = _speeds(system, t, q, speeds)
    remainder = _Remainder(
        gap=gaps(configure(system, t, q)),
        length=system.length,
        positions=Given(positions.terms, _Demand(system, t, positions).misses(q)),
        speeds=misses,
        off_branch=off_branch,
    )
    return State(q, v), remainder
