"""Contact of shapes, and of a journal in its bearing, by forces."""

import abc
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Float

from linkax.model.bodies import BodyOrFrame, Frame, frame_of
from linkax.model.elements import Configuration, Motion
from linkax.model.forces.contact_law import ContactLaw
from linkax.model.forces.force import AbstractForce, Load, described, named
from linkax.model.forces.shapes import Shape, ShapePair, Spot, smallest_gap
from linkax.model.names import optional_name
from linkax.model.numbers import Number, positive, require_type
from linkax.spatial.vectors import dot, length
from linkax.xla.arrays import Array, Scalar
from linkax.xla.derivatives import ratio

NEARLY = 0.999  # of a depth: what counts as there


class SurfaceContact(AbstractForce):
    """Forces of a contact law between the surfaces of two bodies."""

    name: eqx.AbstractVar[str | None]
    law: eqx.AbstractVar[ContactLaw]

    @property
    @abc.abstractmethod
    def sides(self) -> tuple[Frame, Frame]:
        """Frames on both bodies, from whose origins the arms of spots go."""

    @abc.abstractmethod
    def spots(self, configuration: Configuration) -> list[Spot]:
        """Find where the surfaces are nearest."""

    def _approach(self, motion: Motion, spot: Spot) -> tuple[Float[jax.Array, "3"], Scalar]:
        """The velocity of the first surface seen from the second, and the rate at which penetration grows [m/s]."""
        velocities = [motion.velocity_at(frame, arm) for frame, arm in zip(self.sides, spot.arms, strict=True)]
        velocity = velocities[0] - velocities[1]
        return velocity, -dot(spot.normal, velocity)

    def _normal_forces(self, motion: Motion, on: Any) -> list[tuple[Spot, Array, Array]]:
        """Of each spot, with the velocity of the first surface seen from the second."""
        spots, found = self.spots(motion.configuration), []
        for spot in spots:
            velocity, rate = self._approach(motion, spot)
            normal = self.law.normal(-spot.gap, rate)
            # One spot alone goes on smoothly past its switch.
            found.append((spot, velocity, normal if len(spots) == 1 else jnp.maximum(normal, 0.0) * (spot.gap < 0.0)))
        return [(spot, velocity, jnp.where(on, normal, 0.0)) for spot, velocity, normal in found]

    @property
    def deepest(self) -> Scalar | None:
        """The penetration up to which the law is one of two surfaces [m]; None for any."""
        return None

    def switch(self, t: Number, motion: Motion) -> Scalar:
        """Positive where a surface pushes, and no deeper than `deepest`."""
        unit = motion.system.length
        spots = self.spots(motion.configuration)
        each = [self.law.presses(-spot.gap, self._approach(motion, spot)[1], unit) for spot in spots]
        pushes = jnp.max(jnp.stack(each))
        return pushes if self.deepest is None else jnp.minimum(pushes, (self.deepest + smallest_gap(spots)) / unit)

    def separation(self, configuration: Configuration) -> Scalar:
        return smallest_gap(self.spots(configuration)) / configuration.system.length

    def pressed_through(self, configuration: Configuration) -> Any:
        # Steps end there, but for rounding.
        return self.deepest is not None and -smallest_gap(self.spots(configuration)) > NEARLY * self.deepest

    def exhausted(self, configuration: Configuration) -> str:
        if not self.pressed_through(configuration):
            return ""
        depth = float(-smallest_gap(self.spots(configuration)))
        energy = float(self.potential_energy(configuration))
        return (
            f"{self.display_name} is {depth:.3g} m deep, nine tenths of both radii, where its law has taken up "
            f"{energy:.3g} J besides friction and damping."
        )

    def strength(self, t: Number, motion: Motion, on: Any) -> Scalar:
        return sum((normal for _, _, normal in self._normal_forces(motion, on)), jnp.zeros((), motion.system.dtype))

    def load(self, t: Number, motion: Motion, on: Any) -> Load:
        total = Load.none(motion.system)
        for spot, velocity, normal in self._normal_forces(motion, on):
            tangential, moment = self.tangential(motion, spot, velocity, normal)
            force = normal * spot.normal + tangential
            for frame, arm, sign in zip(self.sides, spot.arms, (1.0, -1.0), strict=True):
                configuration = motion.configuration
                body, at = configuration.body(frame.body), configuration.arm(frame) + arm
                total = total.plus(configuration.wrench(body, at, sign * force, sign * moment))
        return total

    def tangential(self, motion: Motion, spot: Spot, velocity: Array, normal: Array) -> tuple[Any, Any]:
        """Compute the force in the plane of contact, and the moment, on the first surface [N, N m]; dry friction."""
        if self.law.friction is None:
            return 0.0, 0.0
        return self.law.friction.force(normal, velocity - dot(spot.normal, velocity) * spot.normal), 0.0

    def potential_energy(self, configuration: Configuration) -> Scalar:
        energies = [self.law.energy(-spot.gap) for spot in self.spots(configuration)]
        return sum(energies, jnp.zeros((), configuration.system.dtype))


class Contact(SurfaceContact):
    """Contact of two shapes on two bodies by a contact law, with its friction.

    Spheres and capsules meet each other, and planes; a capsule on a plane touches with the spheres at both of its ends.
    The force acts in the middle of the penetration. Where two capsules lie along each other, their nearest points jump
    from end to end as they tilt: put spheres on one of them instead. Steps end where contact begins and ends, and
    pass no thin obstacle, see `linkax.Impact`. What the law costs, and when to take `linkax.Impact` or another
    simulator instead, see `linkax.ContactLaw`.

    A run ends with `RESULTS.pressed_through` where spheres or capsules penetrate by nine tenths of the sum of their
    radii: beyond, the law would push them out on the other side.

    `Solution.force` has the normal force [N], of both ends in sum.

    **Arguments:** `first`, `second`: `linkax.Sphere`, `Capsule` or `Plane`, one of them no plane; `law`: a
    `linkax.ContactLaw`; `name`, see `linkax.AbstractForce`.

    **Raises:** `ValueError` for two planes, and for shapes on one body.
    """

    name: str | None = eqx.field(static=True)
    shapes: ShapePair
    law: ContactLaw

    def __init__(self, first: Shape, second: Shape, law: ContactLaw, *, name: str | None = None) -> None:
        self.name = optional_name(name, "Contact")
        self.shapes = ShapePair(first, second, "Contact")
        self.law = require_type(law, ContactLaw, f"{self.display_name}: law", "give a linkax.ContactLaw")

    @property
    def frames(self) -> tuple[Frame, ...]:
        return self.shapes.frames

    @property
    def sides(self) -> tuple[Frame, Frame]:
        return self.shapes.first.frame, self.shapes.second.frame

    def spots(self, configuration: Configuration) -> list[Spot]:
        return self.shapes.spots(configuration)

    @property
    def deepest(self) -> Scalar | None:
        return self.shapes.deepest


class Clearance(SurfaceContact):
    """A journal in a bearing that is larger than it, in place of a pin: it flies, hits the bearing, and rolls along it.

    The bearing is a cylinder about the z axis of its frame, and the journal a disc of a radius smaller by `clearance`,
    whose centre may be up to that far from the axis; beyond, the contact law pushes it back, and its friction acts on
    the surfaces, which turn with their bodies. Along the axis the journal is free. The pin itself is left out of the
    mechanism, and its bodies need other joints, such as `linkax.Planar` or `Free`. Flores, Ambrósio, Claro, Lankarani,
    Kinematics and Dynamics of Multibody Systems with Imperfect Joints, Springer, 2008, ch. 3.

    Steps end where the journal meets the bearing and where it leaves it. What the law costs, see `linkax.ContactLaw`.
    `Solution.force` has the normal force [N], `Solution.length` the distance of the centres [m].

    **Arguments:**

    - `bearing`, `journal`: two bodies, or `body.at(...)`, with their centres.
    - `clearance`: radius of the bearing less that of the journal [m]. `radius`: that of the bearing [m].
    - `law`: a `linkax.ContactLaw`. `name`: see `linkax.AbstractForce`.

    **Raises:** `ValueError` for two frames on one body, and a clearance that is not between 0 and the radius.
    """

    name: str | None = eqx.field(static=True)
    bearing: Frame
    journal: Frame
    clearance: Scalar
    radius: Scalar
    law: ContactLaw

    def __init__(
        self,
        bearing: BodyOrFrame,
        journal: BodyOrFrame,
        *,
        clearance: Number,
        radius: Number,
        law: ContactLaw,
        name: str | None = None,
    ) -> None:
        self.name = optional_name(name, "Clearance")
        self.bearing, self.journal = frame_of(bearing, "Clearance: bearing"), frame_of(journal, "Clearance: journal")
        if self.bearing.body == self.journal.body:
            raise ValueError(f"{described('Clearance', named([self.bearing]))}: both frames are on it; give two bodies")
        self.clearance = positive(clearance, f"{self.display_name}: clearance [m]")
        self.radius = positive(radius, f"{self.display_name}: radius [m]")
        self.law = require_type(law, ContactLaw, f"{self.display_name}: law", "give a linkax.ContactLaw")

    @property
    def frames(self) -> tuple[Frame, ...]:
        return self.bearing, self.journal

    @property
    def sides(self) -> tuple[Frame, Frame]:
        return self.journal, self.bearing

    def _apart(self, configuration):
        """From the bearing's axis to the journal's centre, across the axis and along it."""
        apart, axis = configuration.between(self.bearing, self.journal), configuration.orientation(self.bearing)[:, 2]
        along = dot(apart, axis) * axis
        return apart - along, along

    def extent(self, configuration: Configuration) -> Scalar:
        return length(self._apart(configuration)[0])

    def spots(self, configuration: Configuration) -> list[Spot]:
        across, along = self._apart(configuration)
        eccentricity = length(across)
        outwards, gap = ratio(across, eccentricity, 0.0), jnp.asarray(self.clearance - eccentricity)
        at = self.radius - gap / 2.0  # from the axis, in the middle of the penetration
        return [Spot(gap, -outwards, (outwards * (at - eccentricity), along + outwards * at))]
