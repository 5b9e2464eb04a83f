"""Consistent states from partial positions and speeds."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from linkax.equations.kinematics import configure
from linkax.equations.loops import Gap, as_if_closed, cut_frames, gaps, jacobian, residual
from linkax.equations.system import System, system_of
from linkax.formulations.branches import Crossing
from linkax.linalg.constrained_solve import constrained_solve, invert
from linkax.model.mechanism import Mechanism
from linkax.model.numbers import known, number
from linkax.simulation.accuracy import BALANCED
from linkax.simulation.outset import ON_BRANCH, moving_joints
from linkax.simulation.state import State, joint_coordinates, wrapped

MOST_STEPS = 100
LONGEST_STEP = 0.7  # radians, or lengths of the mechanism
STEP_FRACTIONS = 0.5 ** np.arange(6)
SMALL = 1e-15
TURNS = 10
BESIDE = 1e-2
CLOSED = 1e-9  # remaining gap, relative to the mechanism's length


class AssemblyError(ValueError):
    """The loops of a mechanism cannot be closed at the positions that were asked for."""


def assemble(mechanism: Mechanism, positions=None, speeds=None, *, guess=None) -> State:
    """A state with closed loops, from coordinates and speeds of some of the joints.

    **Arguments:**

    - `positions`: {joint name: coordinate [rad or m]}, of joints in the tree or cut; held.
    - `speeds`: {joint name: speed [rad/s or m/s]}; held.
    - `guess`: {joint name: coordinate} of joints in the tree, where the search starts (default
      zero); chooses the assembly mode.

    Coordinates that are not held change as little as the loops allow from the guess, and
    speeds that are not held are the smallest that the loops allow, both measured in radians
    and in lengths of the mechanism. In a singular configuration, where branches of the motion
    cross, speeds lie on the branch nearest to these; give more of them to choose another.

    **Raises:** `AssemblyError` naming the joint and the remaining gap [m or rad] where a loop
    cannot be closed, or the joints whose motion branches where the speeds lie on no branch;
    `ValueError` for an unknown joint or a wrong number. Inside JAX transformations nothing is
    raised; `linkax.simulate` marks such a state in its result.
    """
    positions, speeds = _by_joint(mechanism, positions, "position"), _by_joint(mechanism, speeds, "speed")
    guess = _by_joint(mechanism, guess, "guess")
    for name in guess:
        if name not in mechanism.topology.coordinates:
            raise ValueError(f"guess for joint {name!r}, which is cut; guess coordinates of joints in the tree")
    state, remainder = _assemble(mechanism, positions, speeds, guess)
    if known(state.q) is not None:
        _raise_if_open(mechanism, state, jax.tree.map(np.asarray, remainder))
    return state


def _by_joint(mechanism, values, what):
    checked = {}
    for name, entry in (values or {}).items():
        count = mechanism.joint(name).num_coordinates
        scalar = np.ndim(entry) == 0
        if scalar and count != 1:
            raise ValueError(f"{what} of joint {name!r} is one number; the joint has {count} coordinates")
        checked[name] = number([entry] if scalar else entry, (count,), f"{what} of joint {name!r}")
    return checked


def _raise_if_open(mechanism, state, remainder):
    topology = mechanism.topology
    cuts = topology.joints[topology.num_bodies :]
    for name, distance, angle in zip(cuts, remainder.gap.distance, remainder.gap.angle, strict=True):
        for size, unit, scale in ((distance, "m", remainder.length), (angle, "rad", 1.0)):
            if not size <= CLOSED * scale:
                held = ", ".join(map(repr, remainder.positions)) or "none"
                raise AssemblyError(
                    f"joint {name!r} does not close: a gap of {size:.6g} {unit} remains (positions held: {held}); "
                    "check lengths and offsets, hold fewer positions, or give another guess"
                )
    for what, misses in (("position", remainder.positions), ("speed", remainder.speeds)):
        for name, miss in misses.items():
            if not np.all(np.abs(miss) <= CLOSED * max(remainder.length, 1.0)):
                raise AssemblyError(
                    f"the {what} asked of joint {name!r} is missed by {np.max(np.abs(miss)):.6g}; the loops do not "
                    f"allow it together with the other {what}s given, so ask for fewer"
                )
    if not remainder.off_branch <= ON_BRANCH * BALANCED.method(state.q.dtype).rank_tolerance:
        system = system_of(mechanism, state.q.dtype)
        basis = Crossing.at(system, state.q, BALANCED.method(state.q.dtype).rank_tolerance).inverse.basis
        names = ", ".join(map(repr, moving_joints(system, state.q, basis)))
        raise AssemblyError(
            "the configuration is singular, and the speeds asked lie on no branch of the motion; its branches cross "
            f"in the motion of joints {names}, so ask for the speeds of other joints among them, or of fewer"
        )


class _Remainder(eqx.Module):
    """What is left open, for the error message."""

    gap: Gap
    length: jax.Array
    positions: dict[str, jax.Array]
    speeds: dict[str, jax.Array]
    off_branch: jax.Array


class _Demand(eqx.Module):
    """Closed loops, and coordinates of joints that are held at values."""

    system: System
    held: dict[str, jax.Array]

    def misses(self, q):
        """How far each held coordinate is from where it should be."""
        topology, apart = self.system.topology, {}
        for name, entry in self.held.items():
            kind = topology.joint_types[topology.joints.index(name)]
            is_angle = np.array([unit == "rad" for unit in kind.coordinate_units])
            apart[name] = joint_coordinates(self.system, name, q) - entry
            if name not in topology.coordinates:
                apart[name] = wrapped(apart[name], is_angle)
        return apart

    def rows(self, q):
        """All that must vanish: loop rows, then misses."""
        loops = residual(cut_frames(configure(self.system, q)))
        return jnp.concatenate([loops, *self.misses(q).values()])

    def jacobian(self, q):
        """Derivative of the rows, where the loops are closed; elsewhere the direction that closes them."""
        loops = jacobian(as_if_closed(cut_frames(configure(self.system, q))))
        held = jax.jacfwd(self.misses)(q)
        return jnp.concatenate([loops, *held.values()])

    def least_change(self, q, right):
        """The smallest change that changes the rows by `right`, in radians and lengths of the mechanism."""
        units, rows = self.system.coordinate_units, self.jacobian(q)
        inverse = invert(None, rows, units, BALANCED.method(q.dtype).rank_tolerance)
        return constrained_solve(inverse, jnp.diag(units**-2), rows, jnp.zeros_like(q), right)[0]

    def size(self, q):
        rows = self.rows(q)
        return jnp.sqrt(jnp.sum(rows * rows))

    def descent(self, q):
        """The steepest descent of the rows' squares, as long as their linearisation says."""
        units, rows, slopes = self.system.coordinate_units, self.rows(q), self.jacobian(q)
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
            longest = jnp.max(jnp.abs(steps / self.system.coordinate_units), axis=1, keepdims=True, initial=0.0)
            steps = steps * jnp.minimum(1.0, LONGEST_STEP / jnp.where(longest > 0.0, longest, 1.0))
            tries = (q + STEP_FRACTIONS[:, None, None] * steps).reshape(-1, len(q))
            tries = jnp.concatenate([tries, q[None]])
            sizes = jax.vmap(self.size)(tries)
            best = jnp.argmin(sizes)
            return count + 1, tries[best], sizes[best], size

        begin = (jnp.zeros((), int), q, self.size(q), jnp.asarray(jnp.inf, q.dtype))
        return lax.while_loop(unfinished, improve, begin)[1]

    def speeds(self, q):
        """The smallest speeds with the rates held, or near to them on a branch of the motion.

        Newton steps from rest on J v = 0, the rates held, and γ(v, v) in the range of J; the first
        leads to the smallest speeds, and where the rank of J is constant, these are on a branch.

        **Returns:** speeds, (n_v,); the smallest speeds, (n_v,); and how far the former are from
        such a branch, relative to the speeds.
        """
        system, tolerance = self.system, BALANCED.method(q.dtype).rank_tolerance
        rates = jnp.concatenate([jnp.zeros(system.topology.num_rows), *self.held.values()])
        largest = jnp.max(jnp.abs(rates), initial=0.0)
        scale = lax.stop_gradient(jnp.where(largest > 0.0, largest, 1.0))
        crossing, rows = Crossing.at(system, q, tolerance), self.jacobian(q)
        metric = jnp.diag(system.coordinate_units**-2)
        # A little beside the smallest speeds, which may lie just between two branches.
        beside = BESIDE * crossing.inverse.basis @ jnp.ones_like(q)

        def turn(v, first):
            off, slopes = crossing.off_branch(v), jax.jacfwd(crossing.off_branch)(v)
            rest = jnp.concatenate([rates / scale - rows @ v, -off])
            slopes = jnp.concatenate([rows, slopes])
            inverse = invert(None, slopes, system.coordinate_units, tolerance)
            v = v + constrained_solve(inverse, metric, slopes, jnp.zeros_like(v), rest)[0]
            return v + jnp.where(first & (_off(crossing, v) > ON_BRANCH * tolerance), beside, 0.0), v

        v, turns = lax.scan(turn, jnp.zeros_like(q), jnp.arange(TURNS) == 0)
        missed = jnp.max(jnp.abs(rates / scale - rows @ v), initial=0.0)
        return scale * v, scale * turns[0], jnp.maximum(_off(crossing, v), missed)


def _off(crossing, v):
    """How far speeds are from a branch, relative to their square."""
    fastest = jnp.max(jnp.abs(v / crossing.configuration.system.coordinate_units), initial=0.0)
    off = jnp.max(jnp.abs(crossing.off_branch(v)), initial=0.0)
    return jnp.where(fastest > 0.0, off / jnp.where(fastest > 0.0, fastest, 1.0) ** 2, 0.0)


@eqx.filter_jit
def _assemble(mechanism, positions, speeds, guess):
    system = system_of(mechanism, jnp.result_type(float))
    topology = system.topology
    q = jnp.zeros(topology.num_coordinates, system.dtype)
    for name, entry in {**guess, **positions}.items():
        if name in topology.coordinates:
            q = q.at[topology.coordinates[name]].set(entry)
    placed, moving = _Demand(system, positions), _Demand(system, speeds)
    q = lax.stop_gradient(lax.stop_gradient(placed).meet(lax.stop_gradient(q)))
    # Carries the derivative. Loops that do not close stay as open as they were found.
    met = placed.size(q) <= CLOSED
    q = q + jnp.where(met, placed.least_change(q, -placed.rows(q)), 0.0)

    v, smallest, off_branch = moving.speeds(q)
    reached = jax.jvp(moving.misses, (q,), (smallest,))[1]
    remainder = _Remainder(
        gap=gaps(cut_frames(configure(system, q))),
        length=system.length,
        positions=placed.misses(q),
        speeds={name: reached[name] - speeds[name] for name in speeds},
        off_branch=off_branch,
    )
    return State(q, v), remainder
