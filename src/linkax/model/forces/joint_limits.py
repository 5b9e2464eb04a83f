"""Stops on the coordinates of joints."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Float

from linkax.model.elements import Configuration, Motion
from linkax.model.forces.contact_law import ContactLaw
from linkax.model.forces.joint_forces import AlongJoint
from linkax.model.names import optional_name
from linkax.model.numbers import Number, number, numbers_of, require, require_type
from linkax.model.terms import Term, TermLike, term
from linkax.xla.arrays import Scalar


class JointRange(eqx.Module):
    """The range of a joint's coordinate [rad or m]: from `lower`, up to `upper`, of which one may be None.

    An angle counts turns, see `linkax.JointSpring`.
    """

    joint: Term = eqx.field(static=True)
    lower: Scalar | None
    upper: Scalar | None

    def __init__(self, joint: TermLike, lower: Number | None, upper: Number | None, what: str) -> None:
        self.joint = term(joint, what)
        if lower is None and upper is None:
            raise ValueError(
                f"{what} on {self.joint.joint!r} has neither lower nor upper; give one, or both [rad or m]"
            )
        ends = ((lower, "lower"), (upper, "upper"))
        self.lower, self.upper = (
            None if entry is None else number(entry, (), f"{what} on {self.joint.joint!r}: {name} [rad or m]")
            for entry, name in ends
        )
        if self.lower is not None and self.upper is not None:
            other: Any = self.lower
            above = lambda upper: upper > numbers_of(other)
            remedy = f"lower is {self.lower}; upper must be larger"
            self.upper = require(self.upper, above, f"{what} on {self.joint.joint!r}: upper", remedy)

    def gap(self, configuration: Configuration) -> Scalar:
        """Compute how far the coordinate is from the nearer end [rad or m], negative beyond it."""
        return self.nearest(configuration)[0]

    def nearest(self, configuration: Configuration) -> tuple[Scalar, Scalar]:
        """Compute how far the coordinate is from the nearer end, negative beyond it, and on which side this end is.

        **Returns:** the gap [rad or m], and its derivative by the coordinate: 1 at the lower end, −1 at the upper.
        """
        if self.lower is None or self.upper is None:
            end, sign = (self.upper, -1.0) if self.lower is None else (self.lower, 1.0)
            return sign * configuration.joint_displacement(self.joint, end), jnp.asarray(sign, configuration.q.dtype)
        from_middle = configuration.joint_displacement(self.joint, (self.lower + self.upper) / 2.0)
        sign = jnp.where(from_middle < 0.0, 1.0, -1.0).astype(configuration.q.dtype)
        return (self.upper - self.lower) / 2.0 + sign * from_middle, sign

    def unit(self, configuration: Configuration) -> Float[jax.Array, ""]:
        """One radian, or the mechanism's length [m]."""
        topology, system = configuration.system.topology, configuration.system
        kind = topology.joint_types[topology.joints.index(self.joint.joint)]
        is_angle = kind.speed_units[self.joint.index or 0] == "rad"
        return jnp.ones((), system.dtype) if is_angle else system.length


class JointLimit(AlongJoint):
    """A stop at one end, or at both ends, of the range of a joint's coordinate, which pushes it back by a contact law.

    Steps end where the stop is met and where it is left. What smoothing a rigid stop costs, and when to take
    `linkax.Impact` or another simulator instead, see `linkax.ContactLaw`.

    **Arguments:**

    - `joint`: a joint's name, or (name, index), in the tree or cut.
    - `law`: a `linkax.ContactLaw` without friction, in radians at a hinge, in metres at a slide.
    - `lower`, `upper`: [rad or m]; one may be left out.
    - `name`: see `linkax.AbstractForce`.

    **Raises:** `ValueError` without an end, for an `upper` that is not above `lower`, and for a law with friction.
    """

    range: JointRange
    law: ContactLaw

    def __init__(
        self,
        joint: TermLike,
        law: ContactLaw,
        *,
        lower: Number | None = None,
        upper: Number | None = None,
        name: str | None = None,
    ) -> None:
        self.name = optional_name(name, "JointLimit")
        self.range = JointRange(joint, lower, upper, "JointLimit")
        self.joint = self.range.joint
        self.law = require_type(law, ContactLaw, f"{self.display_name}: law", "give a linkax.ContactLaw")
        if law.friction is not None:
            raise ValueError(f"{self.display_name}: its law has friction, which slides on nothing; leave it out")

    @property
    def needs_coordinate(self) -> bool:
        return True

    def _penetration(self, motion):
        """Depth, its rate, and the sign of the push."""
        gap, sign = self.range.nearest(motion.configuration)
        return -gap, -sign * motion.joint_rate(self.joint), sign

    def switch(self, t: Number, motion: Motion) -> Scalar:
        """Positive where it pushes."""
        depth, rate, _ = self._penetration(motion)
        return self.law.presses(depth, rate, self.range.unit(motion.configuration))

    def separation(self, configuration: Configuration) -> Scalar:
        return self.range.gap(configuration) / self.range.unit(configuration)

    def strength(self, t: Number, motion: Motion, on: Any) -> Scalar:
        depth, rate, sign = self._penetration(motion)
        return jnp.where(on, sign * self.law.normal(depth, rate), 0.0)

    def potential_energy(self, configuration: Configuration) -> Scalar:
        return self.law.energy(-self.range.gap(configuration))
