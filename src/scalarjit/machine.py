"""Code in this process: functions compiled by LLVM at once, with little care, and with more where they run often."""

import atexit
import threading
import weakref
from typing import Any

import numpy as np

from scalarjit.compiler import Beside, loaded, object_code
from scalarjit.emission import CALLEES, Code, emitted
from scalarjit.function import Function

OFTEN = 2000  # calls after which a function is compiled with care, and passes of loops in it
PAUSE = 0.02  # between two looks at how often functions have been called [s]
CARE = 2  # level of optimisation then

_lock = threading.RLock()


class Compiled:
    """A function in this process, for a number of members at once.

    - `cell`: address of its code, number of calls, and the addresses of the cells of what it calls.
    - `memory`: bytes that it needs, with what it calls.
    """

    def __init__(self, function: Function, lanes: int) -> None:
        # Not the function itself: what is compiled goes with it.
        self.symbol = "scalars"
        self.code: Code = emitted(function, lanes, self.symbol)
        self.callees = [compiled(each, lanes) for each in self.code.callees]
        self.memory = self.code.own_memory + max((each.memory for each in self.callees), default=0)
        self.cell = np.zeros(CALLEES + len(self.callees), np.int64)
        self.cell[CALLEES:] = [each.cell.ctypes.data for each in self.callees]
        self.engines: list[Any] = []

    def load(self, code: bytes) -> None:
        """Have code called from now on."""
        engine = loaded(code)
        self.engines.append(engine)
        self.cell[0] = engine.get_function_address(self.symbol)


_compiled: "weakref.WeakKeyDictionary[Function, dict[int, Compiled]]" = weakref.WeakKeyDictionary()


def compiled(function: Function, lanes: int) -> Compiled:
    """Give a function that is ready to be called."""
    with _lock:
        versions = _compiled.setdefault(function, {})
        if lanes not in versions:
            made = Compiled(function, lanes)
            made.load(object_code(made.code.text, 0))
            versions[lanes] = made
            _watch(made)
        return versions[lanes]


# A thread that has compiled again what runs often.

_watched: "weakref.WeakSet[Compiled]" = weakref.WeakSet()
_stop = threading.Event()
_thread: threading.Thread | None = None
_beside: Beside | None = None


def _watch(made: Compiled) -> None:
    global _thread
    _watched.add(made)
    if _thread is None:
        _thread = threading.Thread(target=_improve, name="scalarjit", daemon=True)
        _thread.start()
        atexit.register(_end)


def _end() -> None:
    _stop.set()
    if _beside is not None:
        _beside.end()


def _improve() -> None:
    global _beside
    while not _stop.wait(PAUSE):
        for made in list(_watched):
            if made.cell[1] <= OFTEN or _stop.is_set():
                continue
            _watched.discard(made)
            try:
                _beside = _beside or Beside(CARE)
                code = _beside.object_code(made.code.text)
            except (OSError, EOFError):  # no process may be started here, or it has ended
                return
            if not _stop.is_set():
                made.load(code)
