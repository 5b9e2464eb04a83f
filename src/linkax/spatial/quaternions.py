"""Unit quaternions q = (w, x, y, z), shape (..., 4).

They describe every orientation without a singular one; q and −q are the same rotation, whose matrix has the
rotated axes as columns. All functions are smooth, also where there is no rotation.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Float

from linkax.spatial.vectors import cross, dot
from linkax.xla.arrays import Array

SMALL = 1e-8  # squares of half angles for which two terms of the series are exact


def multiply(a: Float[Array, "*#batch 4"], b: Float[Array, "*#batch 4"]) -> Float[jax.Array, "... 4"]:
    """Multiply two quaternions: rotate by b first, then by a."""
    real = a[..., 0] * b[..., 0] - dot(a[..., 1:], b[..., 1:])
    vector = a[..., :1] * b[..., 1:] + b[..., :1] * a[..., 1:] + cross(a[..., 1:], b[..., 1:])
    return jnp.concatenate([real[..., None], vector], axis=-1)


def conjugate(quaternion: Float[Array, "*batch 4"]) -> Float[jax.Array, "*batch 4"]:
    """Invert a unit quaternion: (w, −x, −y, −z)."""
    return jnp.concatenate([quaternion[..., :1], -quaternion[..., 1:]], axis=-1)


def normalised(quaternion: Float[Array, "*batch 4"]) -> Float[Array, "*batch 4"]:
    """Divide a nonzero quaternion by its length."""
    return quaternion / jnp.sqrt(dot(quaternion, quaternion))[..., None]


def rotation_matrix(quaternion: Float[Array, "*batch 4"]) -> Float[jax.Array, "*batch 3 3"]:
    """Convert a nonzero quaternion of any length to a rotation matrix (..., 3, 3)."""
    w, x, y, z = (quaternion[..., i] for i in range(4))
    s = 2.0 / dot(quaternion, quaternion)
    rows = [
        [1.0 - s * (y * y + z * z), s * (x * y - w * z), s * (x * z + w * y)],
        [s * (x * y + w * z), 1.0 - s * (x * x + z * z), s * (y * z - w * x)],
        [s * (x * z - w * y), s * (y * z + w * x), 1.0 - s * (x * x + y * y)],
    ]
    return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)


def from_rotation_vector(vector: Float[Array, "*batch 3"]) -> Float[jax.Array, "*batch 4"]:
    """Convert a rotation vector (..., 3), a turn by |vector| [rad] about it, to a quaternion."""
    half = 0.5 * vector
    square = dot(half, half)
    angle = jnp.sqrt(jnp.where(square > SMALL, square, 1.0))
    real = jnp.where(square > SMALL, jnp.cos(angle), 1.0 - square / 2.0)
    ratio = jnp.where(square > SMALL, jnp.sin(angle) / angle, 1.0 - square / 6.0)
    return jnp.concatenate([real[..., None], ratio[..., None] * half], axis=-1)


def rotation_vector(quaternion: Float[Array, "*batch 4"]) -> Float[jax.Array, "*batch 3"]:
    """Convert a unit quaternion to its shortest rotation vector (..., 3) [rad]; turns by π have two."""
    quaternion = jnp.where(quaternion[..., :1] < 0.0, -quaternion, quaternion)
    real, vector = quaternion[..., 0], quaternion[..., 1:]
    square = dot(vector, vector)
    sine = jnp.sqrt(jnp.where(square > SMALL, square, 1.0))
    ratio = jnp.where(square > SMALL, 2.0 * jnp.arctan2(sine, real) / sine, 2.0 + square / 3.0)
    return ratio[..., None] * vector


def from_rotation_matrix(rotation: Float[Array, "*batch 3 3"]) -> Float[jax.Array, "*batch 4"]:
    """Convert a rotation matrix (..., 3, 3) to the quaternion with w ≥ 0, from its largest component."""
    r = lambda i, j: rotation[..., i, j]
    across = [r(2, 1) - r(1, 2), r(0, 2) - r(2, 0), r(1, 0) - r(0, 1)]
    sums = [r(2, 1) + r(1, 2), r(0, 2) + r(2, 0), r(1, 0) + r(0, 1)]
    # Row i is 4 qᵢ q.
    rows = [
        [1.0 + r(0, 0) + r(1, 1) + r(2, 2), *across],
        [across[0], 1.0 + r(0, 0) - r(1, 1) - r(2, 2), sums[2], sums[1]],
        [across[1], sums[2], 1.0 - r(0, 0) + r(1, 1) - r(2, 2), sums[0]],
        [across[2], sums[1], sums[0], 1.0 - r(0, 0) - r(1, 1) + r(2, 2)],
    ]
    rows = jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)
    largest = jnp.argmax(jnp.stack([rows[..., i, i] for i in range(4)], axis=-1), axis=-1)
    found = normalised(jnp.take_along_axis(rows, largest[..., None, None], axis=-2)[..., 0, :])
    return jnp.where(found[..., :1] < 0.0, -found, found)
