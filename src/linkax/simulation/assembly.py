"""Consistent states from partial positions and speeds."""

import warnings

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.scipy.linalg import block_diag

from linkax.equations.configuration import configure
from linkax.equations.coordinates import neutral, on_manifold, rates, retract, speeds
from linkax.equations.loops import Gap, as_if_closed, flips, gaps, jacobian, rate, residual
from linkax.equations.motion import move
from linkax.equations.system import System, system_of
from linkax.formulations.branches import Crossing
from linkax.linalg.constrained_solve import constrained_solve, invert
from linkax.linalg.placing import placed
from linkax.model.beams import BeamElasticity
from linkax.model.mechanism import Mechanism
from linkax.model.terms import Term
from linkax.simulation.accuracy import BALANCED
from linkax.simulation.given import Given, by_joint, check_mechanism, checked_time, coordinates_by_joint, sound_numbers
from linkax.simulation.outset import ON_BRANCH, moving_joints
from linkax.simulation.state import State
from linkax.spatial.quaternions import conjugate, multiply, rotation_vector
from linkax.tracing import all_known, materialised, pushed_forward, runs_once

MOST_STEPS = 100
LONGEST_STEP = 0.7  # radians, or lengths of the mechanism
STEP_FRACTIONS = 0.5 ** np.arange(6)
SMALL = 1e-15
TURNS = 30  # of Newton's method for speeds: from close to where y² = x² is flat, each but halves the way
BESIDE = 1e-2
SEEN_ULPS = 100.0  # of rows that are not rounding alone
CLOSED = 1e-9  # remaining gap, relative to the mechanism's length
# Starts of the search beside the guess, by which it leaves a saddle of the gap, or a bad guess.
ATTEMPTS = np.array([0.0, 1e-2, 1e-1, 0.3, 0.3, 0.6, 0.6, 1.0, 1.0, 1.0, 1.5, 1.5, 1.5, 1.5, 3.0, 3.0, 3.0, 3.0])
# The same where strains move too, and what these count for next to the rows, little; where that stops short, nothing.
STRAINED = np.array([[0.0, 1e-2, 1e-2, 0.0, 1e-2, 1e-2], [0.1, 0.1, 0.1, 0.0, 0.0, 0.0]])


class AssemblyError(ValueError):
    """The loops of a mechanism cannot be closed at the positions that were asked for."""


class AssemblyWarning(UserWarning):
    """The loops of a mechanism close only where beams are strained."""


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
    it starts again beside it, a little and then farther. Strains of beams stay as guessed, by default
    zero; where no start leads to closed loops so, they change, with little energy. In a singular
    configuration, where branches of the motion cross, speeds lie on the branch nearest to these; give
    more of them to choose another.

    Derivatives by numbers of the mechanism, positions and speeds given, and the guess, to any order: of
    coordinates that are not held and that the loops leave free, those of the nearest to the guess, as if
    it closed the loops.

    **Raises:** `AssemblyError` naming the joint and the remaining gap [m or rad] where a loop
    cannot be closed, or the joints whose motion branches where the speeds lie on no branch;
    `ValueError` for an unknown joint or a wrong number. Inside JAX transformations nothing is
    raised: the speeds are infinite then, and `linkax.simulate` says so in its result.
    Warns (`AssemblyWarning`), outside JAX transformations, of beams that the loops strain.
    """
    check_mechanism(mechanism)
    t = jnp.asarray(checked_time(t, "t"))
    positions, guess = (
        coordinates_by_joint(mechanism, *given) for given in ((positions, "position"), (guess, "guess"))
    )
    speeds = by_joint(mechanism, speeds, "speed", lambda joint: len(joint.speed_units))
    for name, _ in guess.terms:
        if name not in mechanism.topology.coordinates:
            raise ValueError(f"guess for joint {name!r}, which is cut; guess coordinates of joints in the tree")
    state, remainder = _assemble(mechanism, positions, speeds, guess, t)
    if not all_known((state, remainder)):
        return State(state.q, jnp.where(remainder.is_met() & sound_numbers(mechanism), state.v, jnp.inf))
    remainder = jax.tree.map(np.asarray, remainder)
    _raise_if_open(mechanism, state, t, remainder)
    for beam, (strain, energy) in remainder.strained.items():
        if strain > remainder.most:
            warnings.warn(
                f"beam {beam!r} is strained, with an energy of {energy:.3g} J, as the loops do not close otherwise; "
                "check lengths and offsets, hold fewer positions, or give another guess; linkax.equilibrium finds the "
                "strains at rest",
                AssemblyWarning,
                stacklevel=2,
            )
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
            joints = f" of joint {', '.join(map(repr, constraint.joints))}" if constraint.joints else ""
            raise AssemblyError(
                f"{constraint.described}{joints} is not met at t = {float(t):.6g} s: "
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
    """What is left open, for the error message; and of each beam the largest change of a strain, and its energy."""

    gap: Gap
    length: jax.Array
    positions: Given
    speeds: Given
    off_branch: jax.Array
    strained: dict

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

    def misses(self, configuration):
        """How far what is held is from where it should be, one number for each speed."""
        topology, apart = self.system.topology, []
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
            apart.append(jnp.concatenate([jnp.zeros(0, self.system.dtype), *missed]))
        return tuple(apart)

    def rows(self, configuration):
        """All that must vanish: loop rows, axes that point apart, misses."""
        return jnp.concatenate([residual(configuration), flips(configuration)[0], *self.misses(configuration)])

    def linearised(self, q):
        """The rows, and their derivative where the loops are closed; elsewhere the direction that closes them."""
        configuration, held = configure(self.system, self.t, q), ()
        if self.held.terms:
            moved = lambda change: configure(self.system, self.t, retract(self.system.topology, q, change))
            still = jnp.zeros(self.system.topology.num_speeds, q.dtype)
            held = jax.jacfwd(lambda change: self.misses(moved(change)))(still)
        closed = as_if_closed(configuration)
        return self.rows(configuration), jnp.concatenate([jacobian(closed), flips(closed)[1], *held])

    def back(self, q, guess):
        """The change that undoes that of the strains since a guess."""
        change = speeds(self.system.topology, q, guess - q)
        strains = _strains(self.system)
        return placed(jnp.zeros_like(change), strains, change[strains])

    def metrics(self):
        """In radians and lengths of the mechanism, with strains by energy, over that of the softest or the hardest."""
        strains, units = _strains(self.system), self.system.units
        energy = _elastic_energy(self.system)
        sizes = jnp.diagonal(energy) * units[strains] ** 2
        of = lambda size: jnp.diag(units**-2).at[np.ix_(strains, strains)].set(energy / size)
        return jax.vmap(of)(jnp.stack([jnp.min(sizes), jnp.max(sizes)]))

    def descent(self, rows, slopes):
        """The steepest descent of the rows' squares, without strains, as long as their linearisation says."""
        strains = _strains(self.system)
        downhill = placed(-(self.system.units**2) * (rows @ slopes), strains, jnp.zeros(len(strains), rows.dtype))
        change = slopes @ downhill
        scale = jnp.sum(change * change)
        return downhill * jnp.where(scale > 0.0, -(rows @ change) / jnp.where(scale > 0.0, scale, 1.0), 0.0)

    def meet(self, q, guess, moves, weight):
        """Damped Newton steps from q until rows and strains vanish or stop falling; descent where those fail.

        **Arguments:** `guess`: coordinates whose strains they lead back to; `moves`: which coordinates they change;
        `weight`: of strains in radians and lengths of the mechanism, next to the rows.

        **Returns:** where they lead, and the size of the rows there.
        """
        metrics = self.metrics() if len(_strains(self.system)) else None

        def newton(rows, slopes, back):
            if metrics is None:
                return _nearest(self.system, back, slopes, -rows)[None]
            return jax.vmap(lambda metric: _nearest_in(metric, self.system.units, back, slopes, -rows))(metrics)

        def strained(q):
            back = self.back(q, guess)
            return jnp.zeros((), q.dtype) if metrics is None else weight * jnp.sqrt(back @ metrics[1] @ back)

        def unfinished(carry):
            count, _, _, miss, before = carry
            return (count == 0) | ((count < MOST_STEPS) & (miss > SMALL) & (miss < before))

        def improve(carry):
            count, q, _, miss, _ = carry
            rows, slopes = self.linearised(q)
            slopes = jnp.where(moves, slopes, 0.0)
            steps = [
                newton(rows, slopes, jnp.where(weight > 0.0, self.back(q, guess), 0.0)),
                self.descent(rows, slopes)[None],
            ]
            steps = jnp.concatenate(steps)
            longest = jnp.max(jnp.abs(steps / self.system.units), axis=1, keepdims=True, initial=0.0)
            steps = steps * jnp.minimum(1.0, LONGEST_STEP / jnp.where(longest > 0.0, longest, 1.0))
            changes = (STEP_FRACTIONS[:, None, None] * steps).reshape(-1, steps.shape[1])
            tries = jax.vmap(lambda change: retract(self.system.topology, q, change))(changes)
            tries = jnp.concatenate([tries, q[None]])
            sizes = jax.vmap(lambda q: _size(self.rows(configure(self.system, self.t, q))))(tries)
            misses = sizes + jax.vmap(strained)(tries)
            best = jnp.argmin(misses)
            return count + 1, tries[best], sizes[best], misses[best], miss

        infinite = jnp.asarray(jnp.inf, q.dtype)
        begin = (jnp.zeros((), int), q, infinite, infinite, infinite)
        return lax.while_loop(unfinished, improve, begin)[1:3]

    def search(self, q):
        """Coordinates that meet the demand, from q, or else from beside it; the nearest miss where none do."""
        fixed = np.isin(np.arange(self.system.topology.num_speeds), _strains(self.system))
        # Beams are strained only where that leads to no closed loops, by what the nearest miss leaves open.
        sizes, weights = np.concatenate(
            [[ATTEMPTS, 0.0 * ATTEMPTS], [*STRAINED] if np.any(fixed) else 2 * [[]]], axis=1
        )
        beside = sizes[:, None] * np.random.default_rng(0).normal(size=(len(sizes), len(fixed)))
        starts, weights = jnp.asarray(beside, q.dtype) * self.system.units, jnp.asarray(weights, q.dtype)

        def unfinished(carry):
            count, _, size = carry
            return (count < len(starts)) & (size > CLOSED)

        def attempt(carry):
            count, best, size = carry
            strains = count >= len(ATTEMPTS)
            moves = strains | jnp.logical_not(fixed)
            begin, aside = jnp.where(strains, best, q), jnp.where(moves, starts[count], 0.0)
            found, reached = self.meet(retract(self.system.topology, begin, aside), q, moves, weights[count])
            return count + 1, jnp.where(reached < size, found, best), jnp.minimum(reached, size)

        begin = (jnp.zeros((), int), q, jnp.asarray(jnp.inf, q.dtype))
        return lax.while_loop(unfinished, attempt, begin)[1]


def _size(rows):
    return jnp.sqrt(jnp.sum(rows * rows))


def _beams(system):
    """The elastic forces of beams."""
    return [force for force in system.forces if isinstance(force, BeamElasticity)]


def _strains(system):
    """Where the strains of beams are among the speeds."""
    taken = [system.topology.speeds[beam.beam] for beam in _beams(system)]
    return np.concatenate([np.zeros(0, int), *(np.arange(of.start, of.stop) for of in taken)])


def _elastic_energy(system):
    """Twice that of the strains of beams, as a matrix."""
    return block_diag(*(beam.matrix for beam in _beams(system)))


def _nearest(system, x, slopes, right, tolerance=None):
    """What is nearest to x, in radians and lengths of the mechanism, with slopes @ x = right.

    Strains of beams differ from x, by as little energy as they can, only in what all else leaves open. `tolerance`:
    for independent rows, by default that of `BALANCED`.
    """
    strains, units = _strains(system), system.units
    if not len(strains):
        return _nearest_in(None, units, x, slopes, right, tolerance)
    others = np.setdiff1d(np.arange(len(units)), strains)
    of_others = lambda x, right: _nearest_in(None, units[others], x, slopes[:, others], right, tolerance)
    left = lambda right: right - slopes[:, others] @ of_others(jnp.zeros_like(x[others]), right)
    open_ = jax.vmap(left, in_axes=1, out_axes=1)(slopes[:, strains])
    strained = _nearest_in(_elastic_energy(system), units[strains], x[strains], open_, left(right), tolerance)
    rest = of_others(x[others], right - slopes[:, strains] @ strained)
    return placed(placed(x, strains, strained), others, rest)


def _nearest_in(metric, units, x, slopes, right, tolerance=None):
    """What is nearest to x in a metric, or in units for None, with slopes @ x = right."""
    tolerance = BALANCED.method(x.dtype).rank_tolerance if tolerance is None else tolerance
    inverse = invert(metric, slopes, units, tolerance)
    metric = jnp.diag(units**-2) if metric is None else metric
    return constrained_solve(inverse, metric, slopes, metric @ x, right)[0]


class _Asked(eqx.Module):
    """Speeds that the loops and a user ask for, over `scale`: rows @ v is `right`, and v is on a branch."""

    crossing: Crossing
    rows: jax.Array
    right: jax.Array
    scale: jax.Array

    def rest(self, v):
        """What speeds leave over."""
        return jnp.concatenate([self.right - self.rows @ v, -self.crossing.off_branch(v, self.scale)])

    @property
    def system(self):
        return self.crossing.configuration.system

    def slopes(self, v):
        return -jax.jacfwd(self.rest)(v)

    def least(self):
        """The smallest speeds, on a branch or not; close to a singular configuration on the branch of the position."""
        least = lambda tolerance: _nearest(self.system, jnp.zeros_like(units), self.rows, self.right, tolerance)
        units = self.system.units
        within = least(SEEN_ULPS * jnp.finfo(units.dtype).eps)
        met = jnp.max(jnp.abs(self.right - self.rows @ within), initial=0.0) <= CLOSED
        return jnp.where(met & (self.off_branch(within) <= BESIDE), within, least(None))

    def off_branch(self, v):
        """How far speeds are from a branch, relative to themselves."""
        fastest = self.crossing.fastest(v)
        off = jnp.max(jnp.abs(self.crossing.off_branch(v, self.scale)), initial=0.0)
        return jnp.where(fastest > 0.0, off / jnp.where(fastest > 0.0, fastest, 1.0) ** 2, 0.0)


@eqx.filter_custom_jvp
def _on_branch(asked, v):
    """Speeds on a branch, by Newton steps from a little beside speeds v, which may lie just between two."""
    beside = BESIDE * jnp.sum(asked.crossing.inverse.basis, axis=1)
    off = asked.off_branch(v) > ON_BRANCH * BALANCED.method(v.dtype).rank_tolerance
    turn = lambda _, v: v + _nearest(asked.system, jnp.zeros_like(v), asked.slopes(v), asked.rest(v))
    # As many each time: with a loop that ends sooner XLA (jaxlib 0.10) finds no callbacks in the rest of the program.
    return lax.fori_loop(0, TURNS, turn, v + jnp.where(off, beside, 0.0))


@_on_branch.def_jvp
def _on_branch_jvp(primals, changes):
    """Where nothing is left over, to any order: the Newton steps have no derivative."""
    (asked, begin), (change, begins) = primals, changes
    v = _on_branch(asked, begin)
    opens = pushed_forward(lambda asked: asked.rest(v), (asked,), (change,))[1]
    return v, _nearest(asked.system, materialised(v, begins), asked.slopes(v), opens)


def _speeds(configuration, held):
    """The smallest speeds with those of joints held, or near to them on a branch of the motion.

    Speeds satisfy J v = b, and γ(v, v) is in the range of J; where the rank of J is constant, the
    smallest do.

    **Returns:** speeds, (n_v,); how far the smallest speeds that the loops allow are from those held, by
    joint; and how far the speeds are from such a branch, relative to themselves.
    """
    system = configuration.system
    crossing = Crossing.of(configuration, BALANCED.method(system.dtype).rank_tolerance)
    of_joints = lambda v: held.speeds(move(configuration, v))
    right = jnp.concatenate([rate(system, configuration.t), *held.values])
    largest = jnp.max(jnp.abs(right), initial=0.0)
    scale = lax.stop_gradient(jnp.where(largest > 0.0, largest, 1.0))
    still = jnp.zeros(system.topology.num_speeds, system.dtype)
    rows = jnp.concatenate([crossing.jacobian, *jax.jacfwd(of_joints)(still)])
    asked = _Asked(crossing, rows, right / scale, scale)
    least = asked.least()
    v = _on_branch(asked, least)
    missed = jnp.max(jnp.abs(asked.right - rows @ v), initial=0.0)
    # What the loops leave of them: a row that is nearly none opens little, and yet may allow no motion at all.
    opened = crossing.jacobian @ least - asked.right[: crossing.jacobian.shape[0]]
    reached = zip(of_joints(scale * (least - crossing.inverse.normal @ opened)), held.values, strict=True)
    misses = Given(held.terms, tuple(found - entry for found, entry in reached))
    return scale * v, misses, jnp.maximum(asked.off_branch(v), missed)


@eqx.filter_custom_jvp
def _found(demand, q):
    """Coordinates that meet a demand, by a search from q."""
    return demand.search(q)


@_found.def_jvp
def _found_jvp(primals, changes):
    """Where the rows stay zero, nearest to the change of where the search begins; itself it has no derivative."""
    (demand, begin), (change, begins) = primals, changes
    q, topology = _found(demand, begin), demand.system.topology
    along = jnp.zeros_like(demand.system.units) if begins is None else speeds(topology, begin, begins)
    at_rest = lambda demand: demand.rows(configure(demand.system, demand.t, q))
    rows, opens = pushed_forward(at_rest, (demand,), (change,))
    along = _nearest(demand.system, along, demand.linearised(q)[1], -opens)
    # Loops that do not close stay as open as they were found.
    return q, rates(topology, q, jnp.where(_size(rows) <= CLOSED, along, 0.0))


@runs_once
def _assemble(mechanism, positions, speeds, guess, t):
    system = system_of(mechanism, jnp.result_type(float))
    topology = system.topology
    q = neutral(topology, system.dtype)
    for given in (guess, positions):
        for along, entry in zip(given.terms, given.values, strict=True):
            if along.joint in topology.coordinates:
                q = q.at[topology.places(along)].set(entry)
    demand = _Demand(system, t, positions)
    begin = on_manifold(topology, q)
    q = _found(demand, begin)
    off = jnp.abs(demand.back(q, begin))
    configuration = configure(system, t, q)
    v, misses, off_branch = _speeds(configuration, speeds)
    remainder = _Remainder(
        gap=gaps(configuration),
        length=system.length,
        positions=Given(positions.terms, demand.misses(configuration)),
        speeds=misses,
        off_branch=off_branch,
        strained={
            beam.beam: (jnp.max(off[topology.speeds[beam.beam]]), beam.energy(q[topology.coordinates[beam.beam]]))
            for beam in _beams(system)
        },
    )
    return State(q, v), remainder
