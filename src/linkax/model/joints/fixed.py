import jax.numpy as jnp

from linkax.model.joints.joint import AbstractJoint, unturned


class Fixed(AbstractJoint):
    """A weld: the child keeps its place and its orientation on the parent. No coordinate."""

    speed_units = ()
    angular_subspace = ()
    linear_subspace = ()
    locked_rotations = ((1, 2), (0, 2), (0, 1))
    aligned_axes = (0, 1, 2)
    locked_translations = (0, 1, 2)

    rotation = staticmethod(unturned)

    def __init__(self, name: str, parent, child, *, cut: bool = False):
        super().__init__(name, parent, child, "x", cut=cut)

    @staticmethod
    def measure(rotation, separation):
        return jnp.zeros(0, separation.dtype)
