"""Objects as a few lines: a title and small tables, in text and for notebooks, from the same rows.

Nothing here compiles, and no array comes from another device that is not small: of others, and of what JAX traces, the
shape is told.
"""

from collections.abc import Callable, Sequence
from html import escape
from typing import Any, NamedTuple, TypeVar

import equinox as eqx
import jax
import numpy as np
from jax.core import Tracer

MOST_ROWS = 8
MOST_NUMBERS = 6  # in a cell
SMALL = 100_000  # numbers of an array that are looked at
CELL = "text-align:left; padding:0 1em 0 0"
Printed = TypeVar("Printed", bound=type)


class Rows(NamedTuple):
    """Rows of cells with a head; `what` they are, of which only the first are shown."""

    head: Sequence[str]
    rows: Sequence[Sequence[str]]
    what: str = "rows"

    @property
    def shown(self) -> list[Sequence[str]]:
        """The rows that are shown, and how many are not."""
        if len(self.rows) <= MOST_ROWS:
            return list(self.rows)
        return [*self.rows[: MOST_ROWS - 1], [f"… and {len(self.rows) - MOST_ROWS + 1} more {self.what}"]]


class Table(NamedTuple):
    """A title, and rows in several parts."""

    title: str
    parts: Sequence[Rows] = ()

    def text(self) -> str:
        """In lines, with aligned columns."""
        lines = [self.title]
        for part in self.parts:
            rows = [*filter(any, [part.head]), *part.shown]
            columns = max(map(len, rows), default=0)
            full = [row for row in rows if len(row) == columns]
            widths = [max(len(row[column]) for row in full) for column in range(columns)]
            padded = lambda row, widths=widths: [cell.ljust(width) for cell, width in zip(row, widths, strict=False)]
            lines += ["  " + "  ".join(padded(row)).rstrip() for row in rows]
        return "\n".join(lines)

    def html(self) -> str:
        """As HTML tables."""
        tables = []
        for part in self.parts:
            rows = [("th", part.head)] * any(part.head) + [("td", row) for row in part.shown]
            cells = lambda tag, row: "".join(f'<{tag} style="{CELL}">{escape(cell)}</{tag}>' for cell in row)
            tables.append("<table>" + "".join(f"<tr>{cells(*row)}</tr>" for row in rows) + "</table>")
        return f"<div>{escape(self.title)}</div>" + "".join(tables)


def printed_as(table: Callable[[Any], Table]) -> Callable[[Printed], Printed]:
    """Let a class print as a table of its instances; by its fields where these hold what no table can be made of.

    Such are trees in the making, with None or objects in place of arrays, which JAX and Equinox show in errors.
    """

    def decorated(kind: Printed) -> Printed:
        def told(self, told):
            try:
                return told(table(self))
            except Exception:
                return None

        shown: Any = kind
        shown.__repr__ = lambda self: told(self, Table.text) or eqx.tree_pformat(self, struct_as_array=True)
        shown._repr_html_ = lambda self: told(self, Table.html)
        return kind

    return decorated


def known(array: Any) -> Any:
    """Numbers of an array that is small and here; None for others, and for what JAX traces."""
    if isinstance(array, Tracer) or not isinstance(array, jax.Array | np.ndarray | np.generic | float | int):
        return None
    if np.size(array) > SMALL or (isinstance(array, jax.Array) and not array.is_fully_addressable):
        return None
    return np.asarray(array)


def numbers(array: Any, unit: str = "", axes: int = 0) -> str:
    """Show an array: its entries over the last `axes` axes, and of each its range over those before them."""
    values = known(array)
    if values is None:
        return "none" if array is None else _shape(array)
    parts = values.reshape(-1, int(np.prod(values.shape[values.ndim - axes :])))
    entries = [_range(parts[:, column]) for column in range(min(parts.shape[1], MOST_NUMBERS))]
    more = [f"… ({parts.shape[1]} in all)"] if parts.shape[1] > MOST_NUMBERS else []
    several = "({})" if len(entries) > 1 and unit else "{}"
    return f"{several.format(', '.join([*entries, *more]))} {unit}".strip()


def by_axis(*rows: tuple[str, Any, str]) -> Rows:
    """Rows of vectors along the last axis, each with its name and unit: a column for each component."""

    def cells(name, array, unit):
        values = known(array)
        columns = [numbers(array)] if values is None else [numbers(values[..., i, None], unit, 1) for i in range(3)]
        return [name, *columns]

    return Rows(("", "x", "y", "z"), [cells(*row) for row in rows])


def _shape(array):
    return eqx.tree_pformat(array, struct_as_array=True)


def _range(values):
    if values.dtype == bool:
        count = int(np.sum(values))
        return ("yes" if values[0] else "no") if count in (0, len(values)) and len(values) else _of(count, len(values))
    finite = values[np.isfinite(values)]
    if not len(finite):
        return one(values[0]) if len(values) == 1 else "none finite"
    lowest, highest = one(np.min(finite)), one(np.max(finite))
    missing = f" ({len(values) - len(finite)} not finite)" if len(finite) < len(values) else ""
    return (lowest if lowest == highest else f"{lowest} to {highest}") + missing


def _of(count, total):
    return f"{count} of {total}"


def one(number: Any) -> str:
    """Show one number in six digits."""
    return f"{number + 0:.6g}" if np.iscomplexobj(number) else f"{float(number) + 0.0:.6g}"


def count(number: int, what: str) -> str:
    """So many of something: "1 joint", "3 joints"."""
    plural = f"{what[:-1]}ies" if what.endswith("y") else f"{what}s"
    return f"{number} {what if number == 1 else plural}"


def among(shape: Sequence[int]) -> str:
    """Words for the title of what has been read at some times, perhaps of a batch, of which ranges are shown."""
    return f", {' × '.join(map(str, shape))} times" if shape else ""


def batch(shape: Sequence[int]) -> str:
    """Words for the title of a batch."""
    return f", a batch of {' × '.join(map(str, shape))}" if shape else ""
