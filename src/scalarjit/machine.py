"""Code in this process: functions compiled by LLVM at once, with little care, and with more where they run often."""

import atexit
import threading
import time
import weakref
from typing import Any

import numpy as np
from llvmlite import binding as llvm

from scalarjit.emission import CALLEES, Code, emitted
from scalarjit.function import Function

OFTEN = 2000  # calls after which a function is compiled with care, and passes of loops in it
PAUSE = 0.02  # between two looks at how often functions have been called [s]
# LLVM compiles one function at a time. A program is compiled function by function: while it is, none is compiled again.
QUIET = 0.3  # since a function has been compiled at once [s]
CARE = 2  # level of optimisation then
MOST_CARE = 2_000_000  # characters of a function up to which it is compiled again: it takes a second

_lock = threading.RLock()


class Compiled:
    """A function in this process, for a number of members at once.

    - `cell`: address of its code, number of calls, and the addresses of the cells of what it calls.
    - `memory`: bytes that it needs, with what it calls.
    """

    def __init__(self, function: Function, lanes: int) -> None:
        self.function = function
        self.lanes = lanes
        self.symbol = "scalars"
        self.code: Code = emitted(function, lanes, self.symbol)
        self.callees = [compiled(each, lanes) for each in self.code.callees]
        self.memory = self.code.own_memory + max((each.memory for each in self.callees), default=0)
        self.cell = np.zeros(CALLEES + len(self.callees), np.int64)
        self.cell[CALLEES:] = [each.cell.ctypes.data for each in self.callees]
        self.engines: list[Any] = []
        self.level = -1

    def load(self, level: int) -> None:
        """Compile the function and have it called from now on."""
        engine = engine_of(self.code.text, level, self.lanes)
        with _lock:
            self.engines.append(engine)
            self.level = level
            self.cell[0] = engine.get_function_address(self.symbol)


_last_compiled = 0.0  # on the clock of `time.monotonic`
_compiled: "weakref.WeakKeyDictionary[Function, dict[int, Compiled]]" = weakref.WeakKeyDictionary()


def compiled(function: Function, lanes: int) -> Compiled:
    """Give a function that is ready to be called."""
    global _last_compiled
    with _lock:
        versions = _compiled.setdefault(function, {})
        if lanes not in versions:
            made = Compiled(function, lanes)
            made.load(0)
            _last_compiled = time.monotonic()
            versions[lanes] = made
            _watch(made)
        return versions[lanes]


def _target(level: int) -> llvm.TargetMachine:
    _initialise()
    features = llvm.get_host_cpu_features().flatten()
    return llvm.Target.from_default_triple().create_target_machine(
        opt=level, jit=True, cpu=llvm.get_host_cpu_name(), features=features
    )


_is_initialised = False


def _initialise() -> None:
    global _is_initialised
    if not _is_initialised:
        llvm.initialize_native_target()
        llvm.initialize_native_asmprinter()
        _is_initialised = True


def engine_of(text: str, level: int, lanes: int) -> Any:
    _initialise()
    module = llvm.parse_assembly(text)
    machine = _target(level)
    if level:
        tuning = llvm.create_pipeline_tuning_options(speed_level=level)
        tuning.slp_vectorization = False
        builder = llvm.create_pass_builder(machine, tuning)
        builder.getModulePassManager().run(module, builder)
    engine = llvm.create_mcjit_compiler(module, machine)
    engine.finalize_object()
    return engine


# A thread that compiles again what runs often.

_watched: "weakref.WeakSet[Compiled]" = weakref.WeakSet()
_stop = threading.Event()
_thread: threading.Thread | None = None


def _watch(made: Compiled) -> None:
    global _thread
    _watched.add(made)
    if _thread is None:
        _thread = threading.Thread(target=_improve, name="scalarjit", daemon=True)
        _thread.start()
        atexit.register(_end)


def _end() -> None:
    """LLVM's own memory goes as the process ends: nothing may be compiled then."""
    _stop.set()
    if _thread is not None:
        _thread.join()


def _improve() -> None:
    while not _stop.wait(PAUSE):
        for made in list(_watched):
            if _stop.is_set() or time.monotonic() < _last_compiled + QUIET:
                break
            if made.cell[1] > OFTEN:
                _watched.discard(made)
                if len(made.code.text) <= MOST_CARE:
                    made.load(CARE)
