import jax.numpy as jnp

from linkax.model.joints.joint import AbstractJoint


class Prismatic(AbstractJoint):
    """A slide: the child moves along h¹ without turning.

    Coordinate: distance [m] of the child's frame from the parent's along h¹.
    """

    coordinate_units = ("m",)
    angular_subspace = ((0.0, 0.0, 0.0),)
    linear_subspace = ((1.0, 0.0, 0.0),)
    locked_rotations = ((1, 2), (0, 2), (0, 1))
    aligned_axes = (0, 1, 2)
    locked_translations = (1, 2)

    @staticmethod
    def rotation(coordinates):
        return jnp.eye(3, dtype=coordinates.dtype)

    @staticmethod
    def displacement(coordinates):
        return coordinates[0] * jnp.array([1.0, 0.0, 0.0], coordinates.dtype)

    @staticmethod
    def measure(rotation, separation):
        return separation[:1]
