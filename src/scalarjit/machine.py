"""Code in this process: functions compiled by LLVM at once, with little care, and with more where they run often."""

import atexit
import threading
import weakref
from contextlib import suppress
from typing import Any

import numpy as np

from scalarjit import files
from scalarjit.compiler import AT_ONCE, CARE, HEAVY_LOOPS, Beside, file_of, kept_or_compiled, loaded
from scalarjit.emission import CALLEES
from scalarjit.units import SYMBOL, Unit

OFTEN = 2000  # calls after which a function is compiled with care, and passes of loops in it
PAUSE = 0.02  # between two looks at how often functions have been called [s]
# Characters of a function up to which it is compiled again. A longer one takes a process beside 14 s (a crane's
# derivative, of 13 MB), and runs of it 7 % less.
MOST = 2_000_000

_lock = threading.RLock()


class Compiled:
    """A unit in this process.

    - `cell`: address of its code, number of calls, and the addresses of the cells of what it calls.
    """

    def __init__(self, unit: Unit) -> None:
        self.callees = [compiled(each) for each in unit.callees]
        self.cell = np.zeros(CALLEES + len(self.callees), np.int64)
        self.cell[CALLEES:] = [each.cell.ctypes.data for each in self.callees]
        self.engines: list[Any] = []

    def load(self, *code: bytes) -> None:
        """Have code called from now on, which may be of several modules."""
        engine = loaded(*code)
        self.engines.append(engine)
        self.cell[0] = engine.get_function_address(SYMBOL)


_compiled: "weakref.WeakValueDictionary[str, Compiled]" = weakref.WeakValueDictionary()


def compiled(unit: Unit) -> Compiled:
    """Give a unit that is ready to be called; equal ones are compiled once."""
    with _lock:
        made = _compiled.get(unit.key)
        if made is None:
            made = Compiled(unit)
            loops = [kept_or_compiled(unit.loops, HEAVY_LOOPS)] if unit.loops else []
            made.load(kept_or_compiled(unit.text, AT_ONCE), *loops)
            _compiled[unit.key] = made
            if unit.own_size <= MOST:
                _watch(made, unit)
        return made


# A thread that has compiled again what runs often.

_watched: "weakref.WeakKeyDictionary[Compiled, Unit]" = weakref.WeakKeyDictionary()
_stop = threading.Event()
_thread: threading.Thread | None = None
_beside: Beside | None = None


def _watch(made: Compiled, unit: Unit) -> None:
    global _thread
    _watched[made] = unit
    if _thread is None:
        _thread = threading.Thread(target=_improve, name="scalarjit", daemon=True)
        _thread.start()
        atexit.register(_end)


def _end() -> None:
    _stop.set()
    if _beside is not None:
        _beside.end()


def _improve() -> None:
    """Compile again what has been called often."""
    with suppress(OSError, EOFError):  # no process may be started here, or it has ended
        while not _stop.wait(PAUSE):
            _improve_one()


def _improve_one():
    often = _called_often()
    if often is None:
        return
    made, unit = often
    text = unit.text_together()
    code = files.read(file_of(text, CARE)) or _compiled_beside(text)
    if _stop.is_set():
        return
    made.load(code)
    for part in unit.together:  # which are called no longer, or not counted
        if callee := _compiled.get(part.key):
            callee.cell[1] = 0


def _called_often() -> tuple[Compiled, Unit] | None:
    """Of what has been called often, that which has computed most; it is watched no longer.

    A row of ten four-bars runs in 3.6 ms in place of 5.6 after four seconds, where it took ten with the largest first.
    """
    with _lock:  # others may add to these meanwhile
        often = [(made, unit) for made, unit in _watched.items() if made.cell[1] > OFTEN]
        found = max(often, key=lambda each: int(each[0].cell[1]) * each[1].size, default=None)
        if found is not None:
            del _watched[found[0]]
        return found


def _compiled_beside(text: str) -> bytes:
    global _beside
    _beside = _beside or Beside(CARE)
    code = _beside.object_code(text)
    files.write(file_of(text, CARE), code)
    return code
