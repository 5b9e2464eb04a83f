"""What forces and constraints share: the joints that they act along, the frames that they attach to."""

import abc
from typing import Any

import equinox as eqx

from linkax.model.bodies import Frame
from linkax.model.terms import Term

# What elements are given. All but time is of higher layers, which import this one: linkax.Motion, its `configuration`,
# and the `system` of both. A user's own class may say more than `Any`.
Time = Any  # t [s], a number that is mostly traced
Motion = Any
Configuration = Any
System = Any


def is_own(element: Any) -> bool:
    """Tell whether an element is of a class that a user has written."""
    return not type(element).__module__.startswith("linkax.")


class AbstractElement(eqx.Module):
    """A force element or a constraint."""

    @property
    def terms(self) -> tuple[Term, ...]:
        """Speeds that this element acts along. Their joints go into the spanning tree where they can."""
        return ()

    @property
    def frames(self) -> tuple[Frame, ...]:
        """Frames that this element attaches to."""
        return ()

    @property
    def joints(self) -> tuple[str, ...]:
        """Names of the joints of `terms`."""
        return tuple(dict.fromkeys(along.joint for along in self.terms))

    def extent(self, configuration: Configuration) -> Any:
        """Compute the distance between its points, or along all of them [m], which `Solution.length` reads.

        **Raises:** `ValueError` for an element without length.
        """
        raise ValueError(f"{self.display_name} has no length; give a spring, damper, rope or Distance")

    @property
    @abc.abstractmethod
    def display_name(self) -> str:
        """Name of this element in errors."""
