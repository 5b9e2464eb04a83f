from jaxtyping import Float

from linkax.model.joints.table_joint import TableJoint, unturned
from linkax.xla.arrays import Array


class Rectangular(TableJoint):
    """A cross slide: the child moves in the plane across h¹ without turning.

    With a `lx.point_mass` as child it is a point that moves in a plane. Coordinates: distances [m] of the child's
    frame from the parent's along the parent's h² and h³; x and y for axis "z".

    ```python
    puck = lx.point_mass("puck", mass=0.1)
    table = lx.Mechanism([puck], [lx.Rectangular("table", lx.GROUND, puck, axis="z")])
    state = lx.assemble(table, {"table": [0.2, 0.3]}, {"table": [1.0, 0.0]})
    ```
    """

    speed_units = ("m", "m")
    angular_subspace = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    linear_subspace = ((0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    locked_rotations = ((1, 2), (0, 2), (0, 1))
    aligned_axes = (0, 1, 2)
    locked_translations = (0,)

    __init__ = TableJoint.__init__

    rotation = staticmethod(unturned)

    @staticmethod
    def measure(rotation: Float[Array, "3 3"], separation: Float[Array, "3"]) -> Float[Array, "2"]:
        return separation[1:]
