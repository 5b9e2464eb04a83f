"""Symmetries along which a steady motion goes on: a mechanism turns as one body, bodies spin about axes of their own.

A field X(q) of speeds is a symmetry of the equations of motion if it takes motions to motions: then δ = X(q(t)) solves
the linearised equations along each of them. A motion with v = X(q) is a relative equilibrium, see Marsden and Ratiu,
Introduction to Mechanics and Symmetry, 1999.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.flatten_util import ravel_pytree
from jax.scipy.linalg import block_diag
from jaxtyping import Float

from linkax.equations.configuration import configure
from linkax.equations.coordinates import (
    coordinates,
    coordinates_by_speed,
    quaternion_places,
    retract,
    speeds,
    turn_rate,
)
from linkax.equations.system import System
from linkax.formulations.tangent_space import TangentSpace
from linkax.model.joints.free import Free
from linkax.model.topology import GROUND_INDEX, Topology
from linkax.spatial.quaternions import from_rotation_matrix, rotation_matrix
from linkax.spatial.vectors import cross
from linkax.xla.arrays import Array
from linkax.xla.batches import one_by_one
from linkax.xla.derivatives import positive_or_one

BESIDE = 0.01  # how far beside a motion its symmetries are sought [rad, lengths of the mechanism, shares of its speed]

SQUARINGS, POWERS = 10, 12  # by which exponentials are exact to rounding for turns of 100 rad

_inverted = one_by_one(lambda matrix: jnp.linalg.pinv(matrix, rtol=jnp.finfo(matrix.dtype).eps ** 0.5))


@jax.custom_jvp
def _pseudo_inverse(matrix):
    return _inverted(matrix)


@_pseudo_inverse.defjvp
def _pseudo_inverse_jvp(primals, tangents):
    """Golub and Pereyra, SIAM Journal on Numerical Analysis 10 (1973): to any order, where the rank stays."""
    (matrix,), (change,) = primals, tangents
    found = _pseudo_inverse(matrix)
    of_rows = found @ found.T @ change.T
    of_columns = change.T @ found.T @ found
    return found, of_rows - of_rows @ matrix @ found + of_columns - found @ matrix @ of_columns - found @ change @ found


class Symmetry(eqx.Module):
    """Speeds X(q) = c + F(q) p that carry a motion along.

    - `constant`: c, speeds at which joints go on. `turns`: p [rad/s, m/s], see `speeds`.
    - `axes`: of slides that are fixed on the ground, in ground axes, (n_v, 3), zero for other speeds.
    """

    topology: Topology = eqx.field(static=True)
    axes: Float[Array, "n_v 3"]
    constant: Float[Array, " n_v"]
    turns: Float[Array, " m"]

    @staticmethod
    def through(system: System, t: Float[Array, ""], q: Float[Array, " n_q"], v: Float[Array, " n_v"]) -> "Symmetry":
        """The one of constant speeds v."""
        topology = system.topology
        sliding = configure(system, t, q).sliding
        fixed = np.isin(np.arange(len(v)), np.concatenate([[], *(columns for columns, _ in _turning_slides(topology))]))
        axes = jnp.where(fixed[:, None], jnp.zeros((len(v), 3), v.dtype).at[topology.motions[:, 1]].set(sliding), 0.0)
        return Symmetry(topology, axes, v, jnp.zeros(num_turns(topology), v.dtype))

    def turning(self, q: Float[Array, " n_q"], turns: Float[Array, " m"]) -> "Symmetry":
        """The one with these turns, and with the same speeds at q."""
        turned = eqx.tree_at(lambda symmetry: symmetry.turns, self, turns)
        return eqx.tree_at(
            lambda symmetry: symmetry.constant, turned, self.constant + self.speeds(q) - turned.speeds(q)
        )

    def speeds(self, q: Float[Array, " n_q"]) -> Float[Array, " n_v"]:
        """X: turns add the speeds of a turn about the ground's origin to slides there, three for each of their trees.

        And to each quaternion those of an angular velocity, to a `Free` joint of a velocity too, in axes of the child.
        """
        return self.along(q, jnp.zeros_like(self.constant))[0]

    def along(
        self, q: Float[Array, " n_q"], v: Float[Array, " n_v"]
    ) -> tuple[Float[Array, " n_v"], Float[Array, " n_v"]]:
        """X at q, and its rate at speeds v."""
        in_q, in_v = quaternion_places(self.topology)
        axes = rotation_matrix(q[in_q])
        speeds = self.constant + self._of_turns(coordinates_by_speed(self.topology, q), axes)
        return speeds, self._of_turns(v, _turned(v[in_v], axes))

    def _of_turns(self, places, axes):
        """F p, linear in coordinates of slides, (n_v,), and rotation matrices of quaternions, (n, 3, 3)."""
        speeds = jnp.zeros_like(places)
        for columns, in_turns in _turning_slides(self.topology):
            fixed, turn = self.axes[columns], self.turns[in_turns]
            speeds = speeds.at[columns].add(fixed @ cross(turn, places[columns] @ fixed))
        for (columns, in_turns), of_child in zip(_turning_quaternions(self.topology), axes, strict=True):
            vectors = self.turns[in_turns].reshape(-1, 3) @ of_child.T
            speeds = speeds.at[columns].add(vectors.ravel())
        return speeds

    def carry(self, q: Float[Array, " n_q"], change: Float[Array, " n_v"]) -> Float[Array, " n_v"]:
        """The rate of a small change of q that goes along."""
        speeds, rate = self.along(q, change)
        return rate + turn_rate(self.topology, speeds, change)

    def follow(
        self, q: Float[Array, " n_q"], changes: Float[Array, "n_v k"], duration: Float[Array, ""]
    ) -> tuple[Float[Array, " n_q"], Float[Array, "n_v k"]]:
        """Coordinates and small changes of them after a time [s].

        X is linear in coordinates of slides and in rotation matrices R of quaternions, Ṙ = c × R + R (p ×).
        """
        topology = self.topology
        if not len(self.turns):
            return q + duration * self.constant, changes
        in_q, in_v = quaternion_places(topology)
        in_turns = [within[:3] for _, within in _turning_quaternions(topology)]
        of_parent, of_child = self.constant[in_v], self.turns[np.array(in_turns, int).reshape(-1, 3)]

        def unfolded(q):
            return ravel_pytree((coordinates_by_speed(topology, q), rotation_matrix(q[in_q]), jnp.ones((), q.dtype)))

        flat, restored = unfolded(q)

        def rates(flat):
            places, axes, one = restored(flat)
            turning = _turned(of_parent, axes) - _turned(of_child, axes.mT).mT
            return ravel_pytree((one * self.constant + self._of_turns(places, axes), turning, jnp.zeros_like(one)))[0]

        flow = _exponential(duration * jax.jacfwd(rates)(jnp.zeros_like(flat)))

        def after(change):
            places, axes, _ = restored(flow @ unfolded(retract(topology, q, change))[0])
            return coordinates(topology, places, from_rotation_matrix(axes))

        q, follow = jax.linearize(after, jnp.zeros_like(self.constant))
        return q, jax.vmap(lambda change: speeds(topology, q, follow(change)), in_axes=1, out_axes=1)(changes)


def find_turns(
    constant: Symmetry,
    system: System,
    method: TangentSpace,
    t: Float[Array, ""],
    q: Float[Array, " n_q"],
    places: Float[Array, "n_v h"],
    speeds: Float[Array, "n_v d"],
) -> Float[Array, " m"]:
    """The smallest turns with which X accelerates as the motion does, and is a symmetry, beside the motion, too.

    Where a body may turn with its slides or spin about its own axis, as a rotor on a `Free` joint, it spins.

    **Arguments:** `constant`: the motion, without any; `places`, `speeds`: directions in which q and v may change.
    """
    motion, topology, count = constant.speeds(q), system.topology, len(constant.turns)
    pace, scales = positive_or_one(system.fastest(motion)), system.scales
    nothing, one = jnp.zeros((), motion.dtype), jnp.ones((), motion.dtype)

    def unit(columns):
        return BESIDE * (columns / positive_or_one(jax.vmap(system.fastest, in_axes=1)(columns))).T

    def missed(beside):
        """By how much each X misses the acceleration of a state, and the linearised equations along its motion."""
        in_q, in_v = jnp.split(beside, 2)
        near, v, _, _ = method.correct(system, t, retract(topology, q, in_q), motion + in_v)
        (v, acceleration, at), follow = jax.linearize(
            lambda s, change, v: method.derivative(system, t + s, retract(topology, near, change), v, True)[:3],
            *(nothing, jnp.zeros_like(v), v),
        )

        def of_turns(turns):
            symmetry = constant.turning(q, pace * turns)

            def later(s):
                """X as a change of q, and of v."""
                speeds = v + s * acceleration
                change, rate = symmetry.along(retract(topology, at, s * v), speeds)
                return change, rate - turn_rate(topology, speeds, change)

            changes, (_, needed) = jax.jvp(later, (nothing,), (one,))
            accelerates = (acceleration - symmetry.along(at, v)[1]) / pace
            return jnp.stack([accelerates, (needed - follow(one, *changes)[1]) / pace**2]) / scales

        return jax.vmap(of_turns)(jnp.eye(count + 1, count, -1, dtype=v.dtype))

    # The motion itself comes first.
    of_all = lax.map(missed, jnp.pad(block_diag(unit(places), pace * unit(speeds)), ((1, 0), (0, 0))))
    each = jnp.concatenate([of_all[:1, :, 0], of_all[:, :, 1]]).transpose(0, 2, 1).reshape(-1, count + 1)
    matrix = each[:, 1:] - each[:, :1]
    inverse = _pseudo_inverse(matrix)
    turns = -pace * inverse @ each[:, 0]
    of_slides = 3 * len(_turning_slides(topology))
    if not of_slides:
        return turns
    open_ = jnp.eye(count, dtype=turns.dtype) - inverse @ matrix  # a projection: what is not one of its numbers is none
    open_ = jnp.where(jnp.abs(open_) > jnp.finfo(turns.dtype).eps ** 0.5, open_, 0.0)
    return turns - _pseudo_inverse(open_[:of_slides]) @ turns[:of_slides]


def num_turns(topology: Topology) -> int:
    """m."""
    return sum(len(in_turns) for _, in_turns in _turning_slides(topology) + _turning_quaternions(topology))


def _turning_slides(topology):
    """Indices in v of slides whose axes are fixed on the ground, by the tree that they carry, two or more; and in p."""
    found, fixed = {}, {GROUND_INDEX}
    for body, kind in enumerate(topology.joint_types[: topology.num_bodies]):
        if topology.predecessor[body] in fixed and isinstance(kind, type) and not topology.reversed[body]:
            columns = topology.columns(body)
            slides = topology.slides[columns]
            found.setdefault(topology.root[body], []).extend(columns[slides])
            if np.all(slides):
                fixed.add(body)
    several = [np.array(columns) for columns in found.values() if len(columns) > 1]
    return [(columns, 3 * tree + np.arange(3)) for tree, columns in enumerate(several)]


def _turning_quaternions(topology):
    """Indices in v of each quaternion's angular velocity, and of the velocity of a `Free` joint; and in p."""
    kinds = [kind for kind in topology.joint_types[: topology.num_bodies] if kind.has_quaternion]
    sizes = [6 if kind is Free else 3 for kind in kinds]
    begins = 3 * len(_turning_slides(topology)) + np.cumsum([0, *sizes])
    each = zip(topology.quaternions[:, 1], begins, sizes, strict=False)
    return [(in_v + np.arange(size), begin + np.arange(size)) for in_v, begin, size in each]


def _turned(turn, axes):
    """a × R for turns a, (n, 3), and matrices R, (n, 3, 3)."""
    return cross(turn[:, None], axes.mT).mT


def _exponential(matrix):
    """exp A by its power series for A / 2ⁿ, see Moler and Van Loan, SIAM Review 45 (2003)."""
    term = total = jnp.eye(len(matrix), dtype=matrix.dtype)
    for power in range(1, POWERS):
        term = term @ matrix / (2.0**SQUARINGS * power)
        total = total + term
    return lax.fori_loop(0, SQUARINGS, lambda _, root: root @ root, total)
