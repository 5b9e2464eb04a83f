"""Values for joints and places, one after another, as a smooth function of s."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import ArrayLike, Bool, Float

from linkax.analysis.continuation import Asked
from linkax.equations.configuration import Configuration
from linkax.model.constraints.constraint import AbstractConstraint, Drive
from linkax.model.mechanism import Mechanism
from linkax.model.numbers import is_finite, namespace, real, require, require_type
from linkax.model.poses import Pose
from linkax.simulation.start.joint_values import JointValues
from linkax.simulation.start.places import Places
from linkax.simulation.start.validation import coordinates_by_joint
from linkax.spatial.quaternions import normalised
from linkax.xla.arrays import Array
from linkax.xla.tracing import concrete


class Course(NamedTuple):
    """What is asked for at each s.

    - `held`: whose values they are; nobody's where s is the arc length. `s`: (n,).
    - `asked`: values and their derivatives, (n, k). One coordinate is its own s; several are a cubic spline through
      the values, of s = 0, 1, 2, ….
    """

    held: JointValues
    s: Float[Array, " n"]
    asked: Asked

    @staticmethod
    def along(held: JointValues, values: Float[Array, "n k"]) -> "Course":
        """Through values of what is held."""
        n, k = values.shape
        values = _continuous(held, values)
        if k == 1:
            return Course(held, values[:, 0], Asked(values, jnp.ones((n, 1)), jnp.zeros((n, 1))))
        return Course(held, jnp.arange(float(n)), Asked(values, *_spline(values)))

    @staticmethod
    def by_arc(arc_length: ArrayLike | Sequence[float]) -> "Course":
        """Check arc lengths.

        **Raises:** `ValueError` for what is no row of finite numbers that rise or fall from zero.
        """
        what = "arc_length"
        s = real(arc_length, what)
        if s.ndim != 1 or not len(s):
            raise ValueError(f"{what} has shape {s.shape}; give a row of numbers, such as np.linspace(0.0, 5.0, 100)")

        def one_way(s):
            steps = namespace(s).diff(s, prepend=0.0)
            rises, falls = steps[1:] > 0.0, steps[1:] < 0.0
            return is_finite(s) & ((rises.all() & (s[0] >= 0.0)) | (falls.all() & (s[0] <= 0.0)))

        s = require(s, one_way, what, "they must be finite, and rise or fall from the start, where they are zero")
        nothing = jnp.zeros((len(s), 0))
        return Course(JointValues((), ()), jnp.asarray(s), Asked(nothing, nothing, nothing))


def values_along(mechanism: Mechanism, along: Mapping[Any, Any]) -> tuple[Mechanism, JointValues, Float[Array, "n k"]]:
    """Check what a user gives: {joint or place: values}, n for each.

    **Returns:** the mechanism with joints that measure places, what is held, and its values.

    **Raises:** `ValueError` for unknown joints and places, and for values that are none.
    """
    remedy = "give {joint: values}, such as {'crank': np.linspace(0.0, 6.28, 100)}"
    if not require_type(along, Mapping, "along", remedy):
        raise ValueError(f"along is empty; {remedy}")
    rows = {key: _checked(key, entry) for key, entry in along.items()}
    counts = {key: len(jax.tree.leaves(entry)[0]) for key, entry in rows.items()}
    if len(set(counts.values())) > 1:
        raise ValueError(f"along has different numbers of values, {counts}; give equally many for each")
    places = Places(mechanism)

    def of_row(row):
        terms = places.positions(row, "along")
        return coordinates_by_joint(places.measured(), terms, "along")

    held = of_row({key: jax.tree.map(lambda array: array[0], entry) for key, entry in rows.items()})
    values = jax.vmap(lambda row: of_row(row).flat())(rows)
    if (known := concrete(values)) is not None and not np.all(np.isfinite(known)):
        row = int(np.flatnonzero(~np.isfinite(known).all(axis=1))[0])
        raise ValueError(f"along: value {row} is none; its quaternion is zero, or its orientation no rotation")
    return places.measured(), held, values


def own_values(near: JointValues, configuration: Configuration) -> Float[Array, " k"]:
    """The values of what is held in a configuration, with the turns that are nearest to others."""
    found = []
    for alike, ends in zip(near.groups, near.values, strict=True):
        values = alike.coordinates(configuration)
        if alike.kind.has_quaternion and alike.index is None:
            turned = jnp.sum(values[:, :4] * ends[:, :4], axis=1, keepdims=True) < 0.0
            values = jnp.concatenate([jnp.where(turned, -values[:, :4], values[:, :4]), values[:, 4:]], axis=1)
        found.append(values)
    values = JointValues(near.groups, tuple(found)).flat()
    turns = jnp.round((near.flat() - values) / (2.0 * jnp.pi))
    return jnp.where(wraps(near), values + 2.0 * jnp.pi * turns, values)


def followed_drives(held: JointValues, constraints: Sequence[AbstractConstraint]) -> tuple[tuple[int, int], ...]:
    """Drives of joints that are held, and which of the values theirs is: (constraint, value)."""
    which = {
        (along.joint, (along.index or 0) + speed): start + by_quaternion + speed
        for along, start, size, by_quaternion in _places(held)
        for speed in range(size - by_quaternion)
    }
    keys = [
        (row, (drive.terms[0].joint, drive.terms[0].index or 0))
        for row, drive in enumerate(constraints)
        if isinstance(drive, Drive)
    ]
    return tuple((row, which[key]) for row, key in keys if key in which)


def _checked(key, entry):
    """Values of one joint or place as arrays with a first axis of the same length."""
    what = f"along: values of {key!r}"

    def array(entry):
        found = real(entry, what)
        if found.ndim == 0 or not len(found):
            raise ValueError(f"{what} have shape {found.shape}; give at least one, in an array whose first axis counts")
        return require(found, is_finite, what, "they must be finite")

    if not isinstance(entry, Pose):
        return array(entry)
    position, orientation = array(entry.position), None if entry.orientation is None else array(entry.orientation)
    if orientation is not None and len(orientation) != len(position):
        raise ValueError(f"{what} are {len(position)} positions and {len(orientation)} orientations; give equally many")
    return Pose(position, orientation)


def _continuous(held, values):
    """The same values, with signs of quaternions, and turns of cut joints' angles, that do not jump."""
    for _, start, _, by_quaternion in _places(held):
        if by_quaternion:
            quaternions = normalised(values[:, start : start + 4])
            flips = jnp.sum(quaternions[1:] * quaternions[:-1], axis=1) < 0.0
            signs = jnp.cumprod(jnp.concatenate([jnp.ones(1), jnp.where(flips, -1.0, 1.0)]))
            values = values.at[:, start : start + 4].set(signs[:, None] * quaternions)
    return jnp.where(wraps(held), jnp.unwrap(values, axis=0), values)


def wraps(held: JointValues) -> Bool[np.ndarray, " k"]:
    """Which values are angles of cut joints, which are the same after a turn."""
    found = []
    for alike in held.groups:
        angles = [unit == "rad" and not alike.in_tree for unit in alike.units]
        if alike.kind.has_quaternion and alike.index is None:
            angles = [False] * 4 + angles[3:]
        found += angles * len(alike.terms)
    return np.array(found, dtype=bool)


def _places(held):
    """Of each term where its values begin in `JointValues.flat`, how many, and whether the first are a quaternion."""
    start = 0
    for alike in held.groups:
        by_quaternion = bool(alike.kind.has_quaternion) and alike.index is None
        for along in alike.terms:
            size = len(alike.units) + by_quaternion
            yield along, start, size, by_quaternion
            start += size


def _spline(values: Float[Array, "n k"]) -> tuple[Float[Array, "n k"], Float[Array, "n k"]]:
    """First and second derivatives, at 0, 1, 2, …, of the cubic spline through values there.

    Its third derivative does not jump next to either end: of three values it is the parabola, of two the straight line
    (de Boor, A Practical Guide to Splines, 1978, chapter IV).
    """
    n, steps = len(values), jnp.diff(values, axis=0)
    if n < 3:
        return jnp.broadcast_to(jnp.sum(steps, axis=0), values.shape), jnp.zeros_like(values)
    far, end = (2.0, lambda near, next: 2.5 * near + 0.5 * next) if n > 3 else (1.0, lambda near, next: 2.0 * near)
    right = [end(steps[:1], steps[1:2]), 3.0 * (steps[1:] + steps[:-1]), end(steps[-1:], steps[-2:-1])]
    inside = np.ones(n - 2)
    bands = [0.0, *inside, far], [1.0, *4.0 * inside, 1.0], [far, *inside, 0.0]
    below, diagonal, above = (jnp.asarray(band, values.dtype) for band in bands)
    slopes = lax.linalg.tridiagonal_solve(below, diagonal, above, jnp.concatenate(right))
    first, last = slopes[:-1], slopes[-1:]
    bends = 6.0 * steps - 4.0 * first - 2.0 * slopes[1:]
    return slopes, jnp.concatenate([bends, 4.0 * last + 2.0 * first[-1:] - 6.0 * steps[-1:]])
