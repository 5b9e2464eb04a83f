"""Compiled programs on disk, found by what they are asked, so that another process need not even trace them.

JAX keeps programs too, but finds them by their text, which takes tracing. What JAX has read from its own files cannot
be written again: it would not run. So these programs have names of their own, and none is written of which JAX tells
that it found it.
"""

import hashlib
import pickle
import re
import threading
import zlib
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import serialize_executable
from jax.stages import Compiled, Lowered

from scalarjit import files
from scalarjit.descriptions import description, of_libraries, of_processor, of_settings, settings
from scalarjit.flat import Flat
from scalarjit.transform import handlers

FOUND = "/jax/compilation_cache/cache_hits"  # what JAX tells its listeners where it reads a program from its files
_met: dict[Any, "KeptProgram | None"] = {}
_thread = threading.local()


def keep_in(folder: Path | None) -> None:
    """Keep programs, and object code, in a folder from now on, or no longer."""
    files.keep_in(folder)
    of_libraries()  # while the sources are those that run


def forget() -> None:
    """Let go of programs, which are read again where they are asked for."""
    _met.clear()


def are_kept() -> bool:
    """Whether programs are kept; settings of JAX may forbid it, or ask where a number is none."""
    config: Any = jax.config
    asks = config.jax_disable_jit or config.jax_debug_nans or config.jax_debug_infs
    return files.folder() is not None and config.jax_enable_compilation_cache and not asks


class KeptProgram:
    """A program on disk, or on its way there.

    - `blank`: zeros in place of what it returns.
    """

    def __init__(self, blank: Any, compile: Callable[[], Compiled]) -> None:
        self.blank = blank
        self.compile = cache(compile)


def kept_program(name: str, given: Flat, lower: Callable[[Flat, str], Lowered]) -> KeptProgram | None:
    """The program of these arguments; None where it cannot be kept.

    **Arguments:** `name`: what tells it from others; `lower`: traces it under a name.
    """
    if not _at_home(given):
        return None
    shapes = tuple((array.shape, array.dtype, bool(getattr(array, "weak_type", False))) for array in given.arrays)
    asked = name, jax.tree.structure(given), shapes, settings()
    if asked not in _met:
        place = _place(*asked)
        _met[asked] = None if place is None else _read(place, given) or _new(place, lower(given, place))
    return _met[asked]


def _at_home(given):
    """Whether all arrays are on the device that computes, a processor; nothing else has been tried."""
    home = {jax.devices()[0]}
    elsewhere = (isinstance(array, jax.Array) and array.devices() != home for array in given.arrays)
    return jax.default_backend() == "cpu" and jax.process_count() == 1 and not any(elsewhere)


def _place(name, structure, shapes, given_settings):
    """The file of a program; None where only this process knows what is asked."""
    around = of_settings(given_settings), of_libraries(), of_processor()
    try:
        found = name, description(structure), shapes, around
    except Exception:  # `Undescribed`, or of an object of a user
        return None
    return hashlib.sha256(repr(found).encode()).hexdigest()[:40]


def _read(place, given):
    text = files.read(place)
    if text is None:
        return None
    try:
        program, blank, called = pickle.loads(zlib.decompress(text))
        for handler in called:
            handler.register()
        if b"lapack_" in program:
            _load_lapack()
        structures = jax.tree.structure(((given,), {})), jax.tree.structure(Flat.of(blank))
        compiled = serialize_executable.deserialize_and_load(program, *structures, execution_devices=jax.devices()[:1])
    except Exception:  # a file that JAX cannot read any more
        files.remove(place)
        return None
    return KeptProgram(blank, lambda: compiled)


@cache
def _load_lapack():
    """Have JAX load LAPACK, as it does where it lowers a call; programs that come from disk crash without."""
    jax.jit(jnp.linalg.cholesky).lower(jax.ShapeDtypeStruct((1, 1), float)).compile()


def _new(place, lowered):
    text = lowered.as_text()
    if "callback" in text:  # to Python, of this process
        return None
    blank = jax.tree.map(lambda leaf: np.zeros(leaf.shape, leaf.dtype), lowered.out_info).tree
    names = [] if handlers is None else sorted(set(re.findall(handlers.NAMES, text)))
    called = [handlers.registered[name].handler for name in names]

    def compile():
        _listen()
        _thread.found = False
        compiled = lowered.compile()
        if not _thread.found:
            with suppress(Exception):  # of what cannot be written
                program, _, _ = serialize_executable.serialize(compiled)
                files.write(place, zlib.compress(pickle.dumps((program, blank, called)), 1))
                folder: Any = files.folder()
                for copy in folder.parent.glob(f"jit_*_{place}-*"):  # of JAX's
                    copy.unlink(missing_ok=True)
        return compiled

    return KeptProgram(blank, compile)


@cache
def _listen():
    jax.monitoring.register_event_listener(_note)


def _note(event: str, **_what: Any) -> None:
    if event == FOUND:
        _thread.found = True
