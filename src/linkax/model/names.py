"""Names of elements: checked, and found among those that are known."""

import itertools
from collections.abc import Collection, Iterable, Mapping, Sequence
from difflib import get_close_matches
from typing import Any, TypeVar

from jax.tree_util import DictKey, register_pytree_with_keys

Entry = TypeVar("Entry")


class UnknownName(KeyError):
    """An error of a dictionary that prints its message as it is, which a `KeyError` quotes."""

    __str__ = Exception.__str__


class ByName(dict[str, Entry]):
    """A dictionary by the names of elements, `what`, whose error for an unknown one lists those that are known."""

    def __init__(self, entries: Mapping[str, Entry], what: str) -> None:
        super().__init__(entries)
        self.what = what

    def __missing__(self, name: Any) -> Entry:
        raise UnknownName(_unknown(name, tuple(self), self.what))


register_pytree_with_keys(
    ByName,
    lambda found: ([(DictKey(name), entry) for name, entry in found.items()], (tuple(found), found.what)),
    lambda names_what, entries: ByName(dict(zip(names_what[0], entries, strict=True)), names_what[1]),
)


def find(name: Any, names: Sequence[str], what: str) -> int:
    """Find the index of a name among those of bodies, joints or others.

    **Raises:** `ValueError` that lists the known names.
    """
    if not isinstance(name, str) or name not in names:
        raise ValueError(_unknown(name, names, what))
    return names.index(name)


def _unknown(name, names, what) -> str:
    return f"unknown {what} {name!r}{meant(name, names)}; known: {', '.join(map(repr, names)) or 'none'}"


def free_name(stem: str, taken: Collection[str]) -> str:
    """The stem itself, or with the first number that is free: stem, stem_1, stem_2."""
    candidates = (f"{stem}_{count}" if count else stem for count in itertools.count())
    return next(candidate for candidate in candidates if candidate not in taken)


def meant(name: Any, names: Iterable[str]) -> str:
    """Ask whether the closest of names was meant, in words for after an unknown one; nothing where none is close."""
    close = get_close_matches(name, names, 1) if isinstance(name, str) else []
    return "".join(f" (did you mean {other!r}?)" for other in close)


def optional_name(name: Any, kind: str) -> str | None:
    """Check the name of a force element, which may have none."""
    if name is not None and (not isinstance(name, str) or not name):
        raise ValueError(f"{kind}: name is {name!r}; give a non-empty string, or None")
    return name
