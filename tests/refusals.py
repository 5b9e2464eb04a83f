"""What a clear error is, as a check: one of linkax's own, which names the element, the value and a remedy."""

import contextlib
import re
import traceback
from pathlib import Path

import jax
import numpy as np
from annotations import unchecked

import linkax as lx

DOCUMENTED = (ValueError, lx.AssemblyError, lx.SimulationError, lx.EquilibriumError)
SOURCE = Path(lx.__file__).parent
REMEDY = re.compile(
    r"\b(must|give|known|add|choose|use|remove|check|ask|make|take|join|put|relate|counted|start|simulate|cannot)\b",
    re.IGNORECASE,
)


class Shown:
    """A value, in any of the ways in which a message may show it: as it was given, its numbers, or its shape."""

    def __init__(self, value):
        self.value = value

    def __contains__(self, message):
        ways = [repr(self.value)]
        if isinstance(self.value, list | tuple | np.ndarray | jax.Array | np.generic | int | float):
            with contextlib.suppress(ValueError):  # lists of unlike parts
                array = np.asarray(self.value)
                ways += [str(array.tolist()), f"shape {array.shape}"]
                ways += [str(array.astype(float).tolist())] if array.dtype.kind in "iuf" else []
        return any(way in message for way in ways)

    def __repr__(self):
        return repr(self.value)


def refused(call, *words):
    """Make a call, and check that it ends in a clear error with all `words`: texts, or values as `Shown`.

    **Returns:** the error.
    """
    try:
        with unchecked():
            found = call()
    except Exception as caught:
        return clear(caught, words)
    raise AssertionError(f"accepted; it returned {found!r}")


def clear(error, words):
    """Check that an error is a clear one with all `words`, and return it."""
    told = lambda: f"{type(error).__name__}: {error}\n{''.join(traceback.format_tb(error.__traceback__))}"
    assert type(error) in DOCUMENTED, f"no error of linkax's own\n{told()}"
    last = traceback.extract_tb(error.__traceback__, limit=-1)[-1]
    assert SOURCE in Path(last.filename).parents, f"not raised by linkax\n{told()}"
    assert "raise" in last.line, f"not raised on purpose\n{told()}"
    message = str(error)
    for word in words:
        named = message in word if isinstance(word, Shown) else word in message
        assert named, f"{word!r} is not named\n{told()}"
    assert REMEDY.search(message), f"no remedy\n{told()}"
    assert len(re.split(r"[;:,.] ", message)) > 1, f"no more than one clause\n{told()}"
    return error
