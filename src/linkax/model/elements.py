"""What forces and constraints share: the joints that they act along, the frames that they attach to."""

import abc
import inspect
from typing import Any, ClassVar

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


class OpenToUsers(eqx.Module):
    """A class of linkax that users may derive from; their classes must not take names that it has for itself.

    - `_open`: names that a user's class may define, besides new ones.
    """

    _open: ClassVar[frozenset[str]] = frozenset()

    def __init_subclass__(cls, **options: Any) -> None:
        """**Raises:** `TypeError` for a name of a user's class that linkax has for itself, and for a field that is a
        method or property there.
        """
        super().__init_subclass__(**options)
        if _is_linkax(cls):
            return
        annotations = inspect.get_annotations(cls)
        fields = {name for name, annotation in annotations.items() if "ClassVar" not in str(annotation)}
        for name in sorted(name for name in {*vars(cls), *annotations} if not name.startswith("__")):
            bases = [base for base in cls.__mro__ if _is_linkax(base) and name in vars(base)]
            for base in bases:
                own = vars(base)[name]
                if name not in vars(base).get("_open", {name}):
                    raise TypeError(
                        f"{cls.__name__} defines {name!r}, which {base.__name__} has for itself; give it another name"
                    )
                is_other = name in fields or not (callable(vars(cls)[name]) or isinstance(own, property))
                if is_other and (inspect.isfunction(own) or isinstance(own, property)):
                    raise TypeError(
                        f"{cls.__name__} has a field {name!r}, and {base.__name__} a method or property of that name; "
                        "define such a one, or give the field another name"
                    )


def _is_linkax(kind):
    return kind.__module__.startswith("linkax.")


class AbstractElement(OpenToUsers):
    """A force element or a constraint."""

    _open = frozenset({"name", "terms", "frames", "joints", "extent", "display_name"})

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
