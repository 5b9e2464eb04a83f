"""What bodies and joints do at the times of a motion, or at the places of a trace."""

import os
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, ClassVar

import equinox as eqx
from jaxtyping import Float, Int

from linkax.formulations.formulation import Dynamics
from linkax.model.beams import Beam
from linkax.model.elements import AbstractElement
from linkax.model.joints.distance import Distance
from linkax.model.mechanism import Mechanism
from linkax.model.names import ByName
from linkax.model.poses import Pose
from linkax.simulation.integrate.run import Run
from linkax.simulation.read.by_name import BodyPoint, length_of, of_body, of_joint, of_point
from linkax.simulation.read.observables import Observables
from linkax.simulation.read.reading import read
from linkax.xla.arrays import Array

if TYPE_CHECKING:
    from linkax.view import View
else:
    View = Any  # of a higher layer


class Kinematics(eqx.Module):
    """Coordinates, and their changes, of a mechanism's joints at `ts`, read by the names of bodies and joints.

    - `run`: what moves. `q`, `v`: coordinates and speeds of the tree's joints, (n_t, n_q) and (n_t, n_v).
    - `internal`: internal states of force elements, (n_t, n_s); None where there are none.
    - `rank_nearby`: rank along the motion, see `linkax.Solution`; None where it is not known.
    """

    by_time: ClassVar[tuple[str, ...]] = ("ts", "q", "v", "internal")  # names of the arrays with times as an axis

    run: eqx.AbstractVar[Run]
    ts: eqx.AbstractVar[Float[Array, "*batch n_t"] | Any]
    q: eqx.AbstractVar[Float[Array, "*batch n_t n_q"] | Any]
    v: eqx.AbstractVar[Float[Array, "*batch n_t n_v"] | Any]
    internal: eqx.AbstractVar[Float[Array, "*batch n_t n_s"] | Any]
    rank_nearby: eqx.AbstractVar[Int[Array, "*batch k"] | None]

    @property
    def known_dynamics(self) -> Dynamics | None:
        """Accelerations that are known beforehand, and do not follow from forces."""
        return None

    @property
    def mechanism(self) -> Mechanism:
        """The mechanism that moved."""
        return self.run.mechanism

    def position(self, body: str, at: BodyPoint = None) -> Float[Array, "*batch n_t 3"]:
        """Position of a body's centre of mass, or of the point `at` on it [m].

        `at`: the name of one of the body's frames, or [x, y, z] in its reference frame [m]. On a beam,
        "base", "tip", a distance along the axis [m], or [x, y, z] off it.
        """
        return of_point(Observables.position, self, body, at)

    def velocity(self, body: str, at: BodyPoint = None) -> Float[Array, "*batch n_t 3"]:
        """Velocity of a body's centre of mass, or of the point `at` on it [m/s]."""
        return of_point(Observables.velocity, self, body, at)

    def acceleration(self, body: str, at: BodyPoint = None) -> Float[Array, "*batch n_t 3"]:
        """Acceleration of a body's centre of mass, or of the point `at` on it [m/s²]."""
        return of_point(Observables.acceleration, self, body, at)

    def orientation(self, body: str) -> Float[Array, "*batch n_t 3 3"]:
        """Axes of a body's reference frame, as columns."""
        return of_body(Observables.orientation, self, body)

    def angular_velocity(self, body: str) -> Float[Array, "*batch n_t 3"]:
        """Angular velocity of a body [rad/s]."""
        return of_body(Observables.angular_velocity, self, body)

    def angular_acceleration(self, body: str) -> Float[Array, "*batch n_t 3"]:
        """Angular acceleration of a body [rad/s²]."""
        return of_body(Observables.angular_acceleration, self, body)

    def poses(self) -> dict[str, Pose]:
        """Reference frames of all bodies by name, of a beam those of its sections: what an animation needs."""
        origin, axes = read(Observables.poses, self)
        names = enumerate(self.mechanism.topology.bodies)
        return ByName({name: Pose(origin[..., index, :], axes[..., index, :, :]) for index, name in names}, "body")

    def joint(self, name: str) -> Float[Array, "..."]:
        """Coordinate of a joint, in the tree or cut [rad or m]; (n_t, n) where it has several."""
        return of_joint(Observables.joint, self, name)

    def joint_speed(self, name: str) -> Float[Array, "..."]:
        """Speed of a joint, in the tree or cut [rad/s or m/s]."""
        return of_joint(Observables.joint_speed, self, name)

    def joint_acceleration(self, name: str) -> Float[Array, "..."]:
        """Rate of a joint's speed, in the tree or cut [rad/s² or m/s²]."""
        return of_joint(Observables.joint_acceleration, self, name)

    def strain(self, beam: str) -> Float[Array, "*batch n_t n 6"]:
        """Strains of a beam at its nodes: twist, curvatures about y and z [rad/m], stretch, shear along y and z."""
        found = self.mechanism.body(beam)
        if not isinstance(found, Beam):
            raise ValueError(f"body {beam!r} is no beam, and has no strain")
        return found.strain(self.joint(beam))

    def length(self, element: str | AbstractElement | Distance) -> Float[Array, "*batch n_t"]:
        """Length of a `Spring`, `Damper`, `ElasticRope`, `Rope` or `Distance` [m]; see `force`."""
        return length_of(self, element)

    def rank(self) -> Int[Array, "*batch n_t"]:
        """Number of independent loop rows."""
        return read(Observables.rank_and_distance, self)[0]

    def singularity_distance(self) -> Float[Array, "*batch n_t"]:
        """Distance d from the nearest singular configuration, see `linkax.Accuracy`."""
        return read(Observables.rank_and_distance, self)[1]

    def view(
        self,
        path: str | os.PathLike | None = None,
        *,
        points: Mapping[str, tuple[str, BodyPoint]] | None = None,
        reactions: bool | list[str] = False,
    ) -> View:
        """Show the motion in three dimensions, in any browser or in a notebook.

        The page needs no network. It turns, zooms and plays; names show where the pointer is. Bodies are drawn
        as their shapes, see `linkax.RigidBody`, or through their joints and named frames. A warning tells which meshes
        cannot be read.

        **Arguments:**

        - `path`: an HTML file to write.
        - `points`: {name: (body, at)} of points to label and trace, see `position`.
        - `reactions`: joints whose forces on their children are shown as arrows, or `True` for all.

        **Returns:** a `View`: the value of a notebook cell, or `solution.view().show()` for the browser.

        **Raises:** `ValueError` for the solution of a batch, and for an unknown name.
        """
        from linkax.view import view

        return view(self, path, points=points, reactions=reactions)
