"""Stops that are rigid: impacts by Newton's law of restitution."""

from typing import Any, cast

import equinox as eqx

from linkax.model.bodies import Frame
from linkax.model.elements import Configuration, Motion
from linkax.model.forces.force import AbstractForce, Load
from linkax.model.forces.joint_limits import JointRange
from linkax.model.forces.shapes import Shape, ShapePair
from linkax.model.names import optional_name
from linkax.model.numbers import Number, number, positive, require
from linkax.model.terms import Term, TermLike
from linkax.xla.arrays import Scalar

SLOWEST = 1e-5


class Impact(AbstractForce):
    """A rigid stop, hit rarely: of a joint, or between two shapes; speeds jump at each hit, and loops stay closed.

    `Impact("hinge", lower=-0.5, restitution=0.8)` keeps a joint above −0.5 rad; `Impact(Sphere(ball, 0.02),
    Plane(lx.GROUND), restitution=0.8)` a ball above the ground. A step ends where the gap g(q) closes. There speeds
    jump by M⁻¹ (∇gᵀ Λ + Jᵀ λ), along which loops stay closed, with the impulse Λ that makes dg/dt after the impact
    −restitution × dg/dt before it (Newton). It has no friction. One run has as many impacts as happen, in batches and
    in both modes of differentiation too: derivatives know that impacts move in time (Leine and Nijmeijer, Dynamics and
    Bifurcations of Non-Smooth Mechanical Systems, 2004, ch. 7). What impacts take is in `Solution.work`, by the `name`;
    it includes what a drive does in that instant. `Solution.impacts` counts them. A state saved at the very time of an
    impact is that before it; save often, where states are to be read between the saved times: what is interpolated
    between two of them knows of no impact.

    First derivatives are right; second ones lack how the times of impacts change the first. Where a motion only grazes
    the stop, or several gaps close at once, it has no derivative.

    Several gaps that close at once are taken one after the other, in their order, which is one of the possible
    outcomes.

    Where bounces follow each other ever faster, or a body comes to lie on the stop, infinitely many impacts would
    happen in finite time. The run ends there, once dg/dt after an impact is below `slowest` and the forces lead back to
    the stop, with the result `RESULTS.rests_on_stop`, as a run does that begins beyond the stop. Where motion is to go
    on, take `linkax.JointLimit` or `linkax.Contact`. Where a drive leads into the stop, and closed loops leave no
    impulse that would change dg/dt, the run ends with `RESULTS.driven_into_stop`.

    Within a step the least value of the gap is sought, so that thin obstacles are hit. Between two eighths of a step
    the gap is taken to fall no faster than beside them; where the joints between the two bodies turn by more than six
    radians in a step, it is tried again, shorter.

    **Arguments:**

    - `first`, `second`: a joint's name, or (name, index), alone; or two of `linkax.Sphere`, `Capsule` and `Plane`.
    - `restitution`: 0 to 1.
    - `lower`, `upper`: of a joint [rad or m]; one may be left out.
    - `slowest`: [m/s or rad/s], see above.
    - `name`: see `linkax.AbstractForce`.

    **Raises:** `ValueError` for a joint without an end, shapes with one, shapes on one body, a restitution outside of
    [0, 1], and by `linkax.simulate` with steps of a fixed size, which do not end where an impact happens.
    """

    name: str | None = eqx.field(static=True)
    between: JointRange | ShapePair
    restitution: Scalar
    slowest: Scalar

    def __init__(
        self,
        first: TermLike | Shape,
        second: Shape | None = None,
        *,
        restitution: Number,
        lower: Number | None = None,
        upper: Number | None = None,
        slowest: Number = SLOWEST,
        name: str | None = None,
    ) -> None:
        self.name = optional_name(name, "Impact")
        if second is None:
            self.between = JointRange(cast(TermLike, first), lower, upper, "Impact")
        elif lower is not None or upper is not None:
            raise ValueError(f"Impact: lower is {lower!r}, upper is {upper!r}; shapes have neither, leave them out")
        else:
            self.between = ShapePair(first, second, "Impact")
        what, within = f"{self.display_name}: restitution", lambda e: (e >= 0.0) & (e <= 1.0)
        self.restitution = require(number(restitution, (), what), within, what, "it must be between 0 and 1")
        self.slowest = positive(slowest, f"{self.display_name}: slowest [m/s or rad/s]")

    @property
    def terms(self) -> tuple[Term, ...]:
        return (self.between.joint,) if isinstance(self.between, JointRange) else ()

    @property
    def frames(self) -> tuple[Frame, ...]:
        return self.between.frames if isinstance(self.between, ShapePair) else ()

    @property
    def needs_coordinate(self) -> bool:
        return True

    @property
    def conserves_energy(self) -> bool:
        return True  # of its force, which it has none of; what impacts take is counted as they happen

    def gap(self, configuration: Configuration) -> Scalar:
        """Compute g(q), how far from the stop a mechanism is [rad or m]."""
        return self.between.gap(configuration)

    def switch(self, t: Number, motion: Motion) -> Scalar:
        """The gap in radians, or lengths of the mechanism."""
        return self.gap(motion.configuration) / self.between.unit(motion.configuration)

    def strength(self, t: Number, motion: Motion, *args: Any) -> Scalar:
        raise ValueError(f"{self.display_name} has impulses, and no force; see Solution.impacts and Solution.work")

    def load(self, t: Number, motion: Motion, on: Any) -> Load:
        return Load.none(motion.system)
