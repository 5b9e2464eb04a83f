"""Symmetries along which a steady motion goes on: a mechanism turns as one body, bodies spin about axes of their own.

A field X(q) of speeds is a symmetry of the equations of motion if it takes motions to motions: then δ = X(q(t)) solves
the linearised equations along each of them. A motion with v = X(q) is a relative equilibrium, see Marsden and Ratiu,
Introduction to Mechanics and Symmetry, 1999.
"""

from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from linkax.equations.configuration import configure
from linkax.equations.coordinates import carried, coordinates_by_speed, on_manifold, rates, retract
from linkax.equations.system import System
from linkax.formulations.tangent_space import TangentSpace
from linkax.model.joints.free import Free
from linkax.model.topology import GROUND_INDEX, Topology
from linkax.spatial.quaternions import rotation_matrix
from linkax.spatial.vectors import cross
from linkax.xla.arrays import Array
from linkax.xla.batches import one_by_one
from linkax.xla.derivatives import positive_or_one

BESIDE = 0.01  # how far beside a motion its symmetries are sought [rad, lengths of the mechanism, shares of its speed]

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
        fixed = np.isin(np.arange(len(v)), np.concatenate([[], *_ground_slides(topology)]))
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
        speeds, places, start = jnp.asarray(self.constant), coordinates_by_speed(self.topology, q), 0
        for columns in _ground_slides(self.topology):
            velocity = cross(self.turns[start : start + 3], places[columns] @ self.axes[columns])
            speeds, start = speeds.at[columns].add(self.axes[columns] @ velocity), start + 3
        for in_q, columns in _turning(self.topology):
            vectors = self.turns[start : start + len(columns)].reshape(-1, 3)
            of_child = vectors @ rotation_matrix(q[in_q : in_q + 4]).T
            speeds, start = speeds.at[columns].add(of_child.ravel()), start + len(columns)
        return speeds

    def along(
        self, q: Float[Array, " n_q"], v: Float[Array, " n_v"]
    ) -> tuple[Float[Array, " n_v"], Float[Array, " n_v"]]:
        """X at q, and its rate at speeds v."""
        return _with_rate(lambda s: self.speeds(retract(self.topology, q, s * v)), v.dtype)

    def carry(self, q: Float[Array, " n_q"], change: Float[Array, " n_v"]) -> Float[Array, " n_v"]:
        """The rate of a small change of q that goes along."""
        speeds, rate = self.along(q, change)
        return rate + _turn(self.topology, speeds, change)

    def follow(
        self, q: Float[Array, " n_q"], changes: Float[Array, "n_v k"], duration: Float[Array, ""]
    ) -> tuple[Float[Array, " n_q"], Float[Array, "n_v k"]]:
        """Coordinates and small changes of them after a time [s]."""
        topology = self.topology

        def of_each(function):
            return jax.vmap(function, in_axes=1, out_axes=1)

        if not len(self.turns):
            motion = duration * self.constant
            return retract(topology, q, motion), of_each(lambda change: carried(topology, motion, change))(changes)

        def flow(_, state, __):
            q, changes = state
            carry = of_each(lambda change: self.carry(q, change))
            return duration * rates(topology, q, self.speeds(q)), duration * carry(changes)

        error = float(jnp.finfo(q.dtype).eps) ** (2 / 3)
        found: Any = diffrax.diffeqsolve(
            diffrax.ODETerm(flow),
            diffrax.Dopri8(),
            t0=0.0,
            t1=1.0,
            dt0=None,
            y0=(q, changes),
            stepsize_controller=diffrax.PIDController(rtol=error, atol=error),
            throw=False,
        )
        q, changes = (of_end[-1] for of_end in found.ys)
        return on_manifold(topology, q), changes

    def misses(
        self,
        system: System,
        method: TangentSpace,
        t: Float[Array, ""],
        q: Float[Array, " n_q"],
        v: Float[Array, " n_v"],
    ) -> Float[Array, " n_v"]:
        """By how much X misses the linearised equations along the motion through a state; zero for a symmetry."""
        v, acceleration, q, _ = method.derivative(system, t, q, v, True)

        def change(s):
            at, moved = retract(self.topology, q, s * v), v + s * acceleration
            speeds, rate = self.along(at, moved)
            return speeds, rate - _turn(self.topology, moved, speeds)

        (of_places, of_speeds), (_, needed) = _with_rate(change, v.dtype)

        def beside(s):
            at = retract(self.topology, q, s * of_places), v + s * of_speeds
            return method.derivative(system, t + s, *at, True)[1]

        return needed - _with_rate(beside, v.dtype)[1]


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

    **Arguments:** `constant`: the motion, without any; `places`, `speeds`: directions in which q and v may change.
    """
    v = constant.speeds(q)
    pace, scales = positive_or_one(system.fastest(v)), system.scales
    acceleration = method.derivative(system, t, q, v, True)[1]
    unit = lambda columns: BESIDE * columns / positive_or_one(jax.vmap(system.fastest, in_axes=1)(columns))
    changes = jnp.concatenate([unit(places), jnp.zeros_like(speeds)], axis=1).T
    moved = v + pace * jnp.concatenate([jnp.zeros_like(places), unit(speeds)], axis=1).T

    def missed(turns):
        symmetry = constant.turning(q, pace * turns)
        of_state = lambda change, v: symmetry.misses(system, method, t, retract(system.topology, q, change), v)
        own = (acceleration - symmetry.along(q, v)[1]) / pace
        return (jnp.concatenate([own[None], jax.vmap(of_state)(changes, moved)]) / (scales * pace**2)).ravel()

    count = len(constant.turns)
    each = jax.vmap(missed, out_axes=1)(jnp.eye(count + 1, count, -1, dtype=v.dtype))
    return -pace * _pseudo_inverse(each[:, 1:] - each[:, :1]) @ each[:, 0]


def num_turns(topology: Topology) -> int:
    """m."""
    return 3 * len(_ground_slides(topology)) + sum(len(columns) for _, columns in _turning(topology))


def _ground_slides(topology):
    """Indices in v of slides whose axes are fixed on the ground, by the tree that they carry; no less than two each."""
    found, fixed = {}, {GROUND_INDEX}
    for body, kind in enumerate(topology.joint_types[: topology.num_bodies]):
        if topology.predecessor[body] in fixed and isinstance(kind, type) and not topology.reversed[body]:
            columns = topology.columns(body)
            slides = topology.slides[columns]
            found.setdefault(topology.root[body], []).extend(columns[slides])
            if np.all(slides):
                fixed.add(body)
    return [np.array(columns) for columns in found.values() if len(columns) > 1]


def _turning(topology):
    """Where each quaternion begins in q, and its indices in v, with those of the velocity of a `Free` joint."""
    kinds = [kind for kind in topology.joint_types[: topology.num_bodies] if kind.has_quaternion]
    return [
        (in_q, in_v + np.arange(6 if kind is Free else 3))
        for (in_q, in_v), kind in zip(topology.quaternions, kinds, strict=True)
    ]


def _turn(topology, v, change):
    """The rate of a small change of q that quaternions take along at speeds v."""
    if not len(topology.quaternions):
        return jnp.zeros_like(change)
    return _with_rate(lambda s: carried(topology, s * v, change), v.dtype)[1]


def _with_rate(function, dtype):
    """A function of a number at zero, and its derivative."""
    return jax.jvp(function, (jnp.zeros((), dtype),), (jnp.ones((), dtype),))
