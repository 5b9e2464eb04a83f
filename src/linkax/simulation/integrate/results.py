"""How a run ended, in names and words; its errors and warnings."""

import warnings
from typing import Any

import diffrax
import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Bool

from linkax.xla.arrays import Array
from linkax.xla.enumerations import code

Solution = Any  # a `linkax.Solution`, of a higher layer


with warnings.catch_warnings():
    warnings.simplefilter("ignore")  # Equinox's, that diffrax has no words for this

    class RESULTS(diffrax.RESULTS):  # pyright: ignore[reportGeneralTypeIssues]  Equinox lets enumerations be extended
        """`diffrax.RESULTS`, and what can go wrong with a mechanism."""

        successful = "The run reached its end."
        not_closed = (
            "The loops of the initial state do not close. Make the state with `linkax.assemble`, which says which "
            "joint is open, and how far."
        )
        not_assembled = (
            "The loops cannot be closed with the positions and speeds that `linkax.assemble` was given. Outside of "
            "JAX transformations it says which joint is open, and how far."
        )
        no_branch = (
            "The initial configuration is singular, and the initial speeds lie on no branch of the motion. Make the "
            "state with `linkax.assemble`, which finds speeds on a branch."
        )
        not_unique = (
            "The mechanism starts at rest in a singular configuration, and the forces drive it along no single "
            "branch: its motion is not unique. Give it speeds, or start a little along the branch it should take."
        )
        massless = (
            "Bodies without mass, or without inertia, can move freely, so that no acceleration follows from the "
            "forces on them. Give them mass and inertia, or a joint that holds them."
        )
        diverged = (
            "A step of fixed size led to numbers that are not finite, or far off the loops. Take smaller steps, or let "
            "the step size adapt."
        )
        times_out_of_order = (
            "The times of the run make no sense: t1, saved times and dt0 must be finite, t1 after t0, and saved times"
            " in rising order between them."
        )
        not_finite = (
            "The initial state, the numbers of the mechanism, or its forces there are not finite, or a number is "
            "outside of what it can be, such as a negative length; give finite ones. Outside of JAX transformations "
            "such a mechanism is refused, by an error that names the number."
        )
        off_loops = (
            "A state between two steps lies off the loops, and no state that closes them is near: the steps are too "
            "long there. Ask for a smaller rtol, or take smaller steps."
        )
        locked = (
            "The mechanism locks: its loops do not allow what drives ask for after that. Change lengths so that it can "
            "go on, drive another joint, or end the run before."
        )
        rests_on_stop = (
            "The motion comes to rest on the stop of a `linkax.Impact`, after bounces that follow each other ever "
            "faster, or begins beyond it. Take a `linkax.JointLimit` or a `linkax.Contact`, which holds it, or end "
            "the run before."
        )
        driven_into_stop = (
            "A drive leads into the stop of a `linkax.Impact`: the loops and the drive leave no impulse that would "
            "change how fast the gap closes. Move the stop, let the drive turn back before it, or end the run before."
        )
        event_without_root = (
            "The root finder finds no zero of the event's condition where that changes sign: it jumps there, as "
            "speeds do at an impact, or the root finder's tolerance is out of reach. Leave `root_finder` out, and the "
            "run ends just after."
        )
        pressed_through = (
            "Bodies are pressed through each other: their energy is larger than what the law of a `linkax.Contact` "
            "takes up over their radii. Take a larger stiffness, larger radii, or a `linkax.Impact`."
        )
        not_reached = "The branch does not lead to all values: it turns back before, or ends where another one crosses."


KNOWN_RESULTS = (
    "successful",
    "max_steps_reached",
    "dt_min_reached",
    "diverged",
    "event_occurred",
    "not_assembled",
    "not_closed",
    "no_branch",
    "not_unique",
    "massless",
    "not_finite",
    "times_out_of_order",
    "off_loops",
    "locked",
    "rests_on_stop",
    "driven_into_stop",
    "event_without_root",
    "pressed_through",
    "not_reached",
)


ENDED_WELL = ("successful", "event_occurred")


def ended_well(result: RESULTS) -> Bool[Array, "*batch"]:
    """Whether a run ended as it was asked to."""
    return jnp.stack([result == getattr(RESULTS, name) for name in ENDED_WELL]).any(axis=0)


def result_name(result: RESULTS) -> str:
    """The name of a result, such as "successful" or "max_steps_reached"."""
    number = int(code(result))
    return next((name for name in KNOWN_RESULTS if number == int(code(getattr(RESULTS, name)))), "failed")


def remark_name(remark: "REMARKS") -> str:
    """The name of a remark, such as "none" or "stiff"."""
    number = int(code(remark))
    return next((name for name in WARNINGS if number == int(code(getattr(REMARKS, name)))), "none")


class REMARKS(eqx.Enumeration):
    """Remarks on a run that ended well; a single run warns of the first that applies."""

    none = "There is nothing to say of the run."
    rounding = (
        "Rounding alone puts accelerations off by more than the tolerance: a body carries one far larger, or very "
        "many. Ask for a larger rtol, or cut a joint so that another body carries it."
    )
    single_precision = (
        "The motion passes a singular configuration, where branches of motion cross, and rounding of single precision "
        "may move it to another; compare with double precision."
    )
    lingers = (
        "The motion does not leave a singular configuration, where branches of motion cross: rounding may move it from "
        "one to another."
    )
    stiff = (
        "A stiff spring, damper or beam, or a fast internal state of a force element, and not the motion, chooses the "
        "steps. Take a rigid joint or constraint in its place, or a force without that state; of a contact or stop one "
        "less stiff, or a linkax.Impact; or with an explicit solver, where it comes to rest, solver=linkax.Rodas5P()."
    )


class AccuracyWarning(UserWarning):
    """Rounding keeps a run from the tolerance asked for; `Solution.error_estimate` tells how far."""


class StiffnessWarning(UserWarning):
    """One fast element, and not the motion, chooses the steps of a run."""


WARNINGS = {
    "rounding": AccuracyWarning,
    "single_precision": AccuracyWarning,
    "lingers": AccuracyWarning,
    "stiff": StiffnessWarning,
}


class SimulationError(RuntimeError):
    """A run did not reach its end; `solution` holds the part computed."""

    # The message alone is what pickle gives, the rest follows.
    def __init__(self, message: str, solution: Solution | None = None) -> None:
        super().__init__(message)
        self.solution = solution
