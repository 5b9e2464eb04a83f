"""Code in this process: functions compiled by LLVM at once, with little care, and with more where they run often."""

import atexit
import threading
import weakref
from typing import Any

import numpy as np

from scalarjit import files
from scalarjit.compiler import Beside, digest, file_of, kept_or_compiled, loaded
from scalarjit.emission import CALLEES, emitted
from scalarjit.function import Function

OFTEN = 2000  # calls after which a function is compiled with care, and passes of loops in it
PAUSE = 0.02  # between two looks at how often functions have been called [s]
CARE = 1  # level of optimisation then
SYMBOL = "scalars"

_lock = threading.RLock()


class Unit:
    """Code of a function for a number of members at once, without addresses: another process may have it too.

    - `callees`: what it calls, in the order of its cell; `memory`: bytes that it needs, with what it calls.
    - `key`: what tells it from others, by its text and what it calls.
    """

    def __init__(self, text: str, own_memory: int, callees: "list[Unit]") -> None:
        self.text, self.callees = text, callees
        self.memory = own_memory + max((each.memory for each in callees), default=0)
        self.key = digest(text, *(each.key for each in callees))


_units: "weakref.WeakKeyDictionary[Function, dict[int, Unit]]" = weakref.WeakKeyDictionary()


def unit(function: Function, lanes: int) -> Unit:
    """Give the code of a function, which is written once."""
    with _lock:
        versions = _units.setdefault(function, {})
        if lanes not in versions:
            code = emitted(function, lanes, SYMBOL)
            versions[lanes] = Unit(code.text, code.own_memory, [unit(each, lanes) for each in code.callees])
        return versions[lanes]


class Compiled:
    """A unit in this process.

    - `cell`: address of its code, number of calls, and the addresses of the cells of what it calls.
    """

    def __init__(self, unit: Unit) -> None:
        self.text = unit.text
        self.callees = [compiled(each) for each in unit.callees]
        self.cell = np.zeros(CALLEES + len(self.callees), np.int64)
        self.cell[CALLEES:] = [each.cell.ctypes.data for each in self.callees]
        self.engines: list[Any] = []

    def load(self, code: bytes) -> None:
        """Have code called from now on."""
        engine = loaded(code)
        self.engines.append(engine)
        self.cell[0] = engine.get_function_address(SYMBOL)


_compiled: "weakref.WeakValueDictionary[str, Compiled]" = weakref.WeakValueDictionary()


def compiled(unit: Unit) -> Compiled:
    """Give a unit that is ready to be called; equal ones are compiled once."""
    with _lock:
        made = _compiled.get(unit.key)
        if made is None:
            made = Compiled(unit)
            made.load(kept_or_compiled(unit.text, 0))
            _compiled[unit.key] = made
            _watch(made)
        return made


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
    """Compile again what has been called often, the most often called first."""
    while not _stop.wait(PAUSE):
        made = _called_often()
        if made is None:
            continue
        try:
            code = files.read(file_of(made.text, CARE)) or _compiled_beside(made.text)
        except (OSError, EOFError):  # no process may be started here, or it has ended
            return
        if not _stop.is_set():
            made.load(code)


def _called_often() -> Compiled | None:
    """What has been called most often, if it is often; it is watched no longer."""
    with _lock:  # others may add to these meanwhile
        often = [made for made in _watched if made.cell[1] > OFTEN]
        if not often:
            return None
        made = max(often, key=lambda made: made.cell[1])
        _watched.discard(made)
        return made


def _compiled_beside(text: str) -> bytes:
    global _beside
    _beside = _beside or Beside(CARE)
    code = _beside.object_code(text)
    files.write(file_of(text, CARE), code)
    return code
