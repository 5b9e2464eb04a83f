"""Functions that users give to a mechanism: laws of drives and forces."""

import inspect
from collections.abc import Callable, Sequence
from difflib import get_close_matches
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from linkax.model.numbers import converted, number
from linkax.xla.arrays import Array
from scalarjit.code import Code, OwnClasses, codes_of_classes
from scalarjit.code_walk import NotComparable

# What JAX raises where a function asks a traced number for its value.
BY_TRACING = (
    jax.errors.ConcretizationTypeError,
    jax.errors.NonConcreteBooleanIndexError,
    jax.errors.TracerArrayConversionError,
    jax.errors.TracerIntegerConversionError,
    jax.errors.UnexpectedTracerError,
)
Numbers = TypeVar("Numbers", bound=Array | np.floating)


GIVE_VALUES = "linkax would not see it change, so let it read numbers, arrays or plain objects instead"


class Function(eqx.Module):
    """A user's function as a pytree: its numbers are leaves, the rest is structure (see `Code`).

    Both are taken when this is made, and do not follow later changes; `what` names it in errors.
    """

    numbers: tuple[jax.Array, ...]
    code: Code = eqx.field(static=True)

    def __init__(self, function: Callable[..., Any], what: str = "a function") -> None:
        try:
            self.code, self.numbers = Code.of(function)
        except NotComparable as error:
            raise ValueError(f"{what}: its function reads {error}; {GIVE_VALUES}") from error

    def __call__(self, *arguments: Any) -> Any:
        return self.code.with_numbers(self.numbers)(*arguments)


class Law(eqx.Module):
    """A user's function in a mechanism, which returns numbers of a given shape; `what` names it in errors."""

    function: Function
    shape: tuple[int, ...] = eqx.field(static=True)
    what: str = eqx.field(static=True)

    def __init__(self, function: Callable[..., Any], shape: tuple[int, ...], what: str) -> None:
        self.function, self.shape, self.what = Function(function, what), shape, what

    def check(self) -> None:
        """Raise a `ValueError` where what the function reads has changed since the mechanism was built."""
        check_unchanged(f"{self.what}: what its function reads", self.function.code)

    def __call__(self, *arguments: Any) -> Float[jax.Array, "..."]:
        self.check()
        try:
            found = self.function(*arguments)
        except Exception as error:
            told = raised(error, self.function.code.function, arguments)
            raise ValueError(f"{self.what}: its function raises {told}") from error
        found = converted(found, f"{self.what}: what its function returns", jnp.asarray)
        if found.shape != self.shape:
            expected = "a single number" if self.shape == () else f"an array of shape {self.shape}"
            raise ValueError(f"{self.what}: its function returns shape {found.shape}; it must return {expected}")
        return found if jnp.issubdtype(found.dtype, jnp.floating) else 1.0 * found


def check_unchanged(what: str, code: Code) -> None:
    """Raise a `ValueError` where what code reads has changed since the mechanism was built."""
    if code.has_changed():
        raise ValueError(
            f"{what} ({', '.join(code.variables)}) has changed since the mechanism was built; build it anew, or "
            "where it changes that itself, take that out"
        )


def own_classes(tree: Any) -> OwnClasses:
    """The code of a user's classes in a mechanism, see `codes_of_classes`."""
    try:
        return codes_of_classes(tree)
    except NotComparable as error:
        raise ValueError(f"a class of your own reads {error}; {GIVE_VALUES}") from error


# What a mistake in a user's own element raises.
MISTAKES = (ArithmeticError, AttributeError, LookupError, TypeError, ValueError)


def of_element(
    name: str, what: str, error: Exception, function: Callable[..., Any], arguments: Sequence[Any]
) -> Exception:
    """What to raise where a function of an element, such as its load, has raised an error: one that names both.

    An error that names the element is its own.
    """
    if isinstance(error, ValueError) and str(error).startswith(name):
        return error
    return ValueError(f"{name}: its {what} raises {raised(error, function, arguments)}")


def raised(error: Exception, function: Callable[..., Any], arguments: Sequence[Any]) -> str:
    """Describe what a user's function raised for some arguments, and what helps."""
    first, *_ = str(error).split("\n")
    return f"{type(error).__name__}: {first}{_remedy(error, function, arguments)}"


def _remedy(error, function, arguments):
    if isinstance(error, BY_TRACING):
        return "; JAX traces it, so make it of operations of jax.numpy, with jnp.where in place of if"
    if isinstance(error, ValueError):  # which says it
        return ""
    if isinstance(error, TypeError) and not _takes(function, arguments):
        names = ("t", "motion", *("states" if isinstance(more, dict) else "on" for more in arguments[2:]))
        return "; it must take t" if len(arguments) == 1 else f"; it must take ({', '.join(names)})"
    known = get_close_matches(getattr(error, "name", None) or "", dir(getattr(error, "obj", None)), 3)
    return f"; known: {', '.join(map(repr, known))}" if known else "; check it"


def _takes(function, arguments):
    try:
        inspect.signature(function).bind(*arguments)
    except TypeError:
        return False
    except ValueError:  # it has none
        return True
    return True


def number_or_law(entry: Any, shape: tuple[int, ...], what: str) -> Array | Law:
    """Read a number, or an array of the given shape, or a function that returns one."""
    return Law(entry, shape, what) if callable(entry) else number(entry, shape, what)


def evaluated(entry: Numbers | Law, *arguments: Any) -> Numbers | jax.Array:
    """Return a number, or what a `Law` returns for these arguments."""
    return entry(*arguments) if isinstance(entry, Law) else entry
