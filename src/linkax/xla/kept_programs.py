"""Compiled programs on disk, found by what they are asked, so that another process need not even trace them.

JAX keeps programs too, but finds them by their text, which takes tracing, about as long as compiling. What JAX has read
from its own files cannot be written again: it would not run. So these programs have names of their own, and none is
written of which JAX tells that it found it.
"""

import hashlib
import pickle
import threading
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
from jaxtyping import PyTree

from linkax.files import written_whole
from linkax.xla.descriptions import description, of_libraries, of_processor, of_settings, settings
from linkax.xla.flat import Flat
from linkax.xla.lapack_threads import use_one_thread
from linkax.xla.memory_maps import CACHES, make_room

FOUND = "/jax/compilation_cache/cache_hits"  # what JAX tells its listeners where it reads a program from its files
DIGEST = hashlib.sha256().digest_size
_folder: list[Path] = []
_met: dict[Any, "KeptProgram | None"] = {}
_thread = threading.local()
CACHES.append(_met.clear)


def keep_in(folder: Path | None) -> None:
    """Keep programs in a folder from now on, or no longer."""
    _folder[:] = [] if folder is None else [folder]
    of_libraries()  # while the sources are those that run


def are_kept() -> bool:
    """Whether programs are kept; settings of JAX may forbid it, or ask where a number is none."""
    config: Any = jax.config
    asks = config.jax_disable_jit or config.jax_debug_nans or config.jax_debug_infs
    return bool(_folder) and config.jax_enable_compilation_cache and not asks


class KeptProgram:
    """A program on disk, or on its way there.

    - `blank`: zeros in place of what it returns.
    """

    def __init__(self, blank: PyTree, compile: Callable[[], Compiled]) -> None:
        self.blank, self._compile = blank, compile
        self._compiled: Compiled | None = None

    def compile(self) -> Compiled:
        """The program, which is compiled and written first if need be."""
        if self._compiled is None:
            self._compiled = self._compile()
        return self._compiled


def kept_program(program: tuple[Any, ...], given: Flat, lower: Callable[[Flat, str], Lowered]) -> KeptProgram | None:
    """The program of these arguments; None where it cannot be kept.

    **Arguments:** `program`: what tells it from others; `lower`: traces it under a name.
    """
    if not _at_home(given):
        return None
    shapes = tuple((array.shape, array.dtype, bool(getattr(array, "weak_type", False))) for array in given.arrays)
    asked = program, jax.tree.structure(given), shapes, settings()
    if asked in _met:
        return _met[asked]
    place = _place(*asked)
    found = None if place is None else _read(place, given) or _new(place, lower(given, place.name))
    _met[asked] = found
    return found


def _at_home(given):
    """Whether all arrays are on the device that computes, a processor; nothing else has been tried."""
    home = {jax.devices()[0]}
    elsewhere = (isinstance(array, jax.Array) and array.devices() != home for array in given.arrays)
    return jax.default_backend() == "cpu" and jax.process_count() == 1 and not any(elsewhere)


def _place(program, structure, shapes, given_settings):
    """The file of a program; None where only this process knows what is asked."""
    around = of_settings(given_settings), of_libraries(), of_processor()
    try:
        found = program, description(structure), shapes, around
    except Exception:  # `Undescribed`, or of an object of a user
        return None
    return _folder[0] / "linkax" / hashlib.sha256(repr(found).encode()).hexdigest()[:40]


def _read(place, given):
    make_room()
    try:
        text = place.read_bytes()
    except OSError:
        return None
    digest, text = text[:DIGEST], text[DIGEST:]
    try:
        if hashlib.sha256(text).digest() != digest:
            raise ValueError
        program, blank = pickle.loads(text)
        if b"lapack_" in program:
            _load_lapack()
        structures = jax.tree.structure(((given,), {})), jax.tree.structure(Flat.of(blank))
        compiled = serialize_executable.deserialize_and_load(program, *structures, execution_devices=jax.devices()[:1])
    except Exception:  # a file that is damaged, or that JAX cannot read any more
        with suppress(OSError):
            place.unlink()
        return None
    return KeptProgram(blank, lambda: compiled)


@cache
def _load_lapack():
    """Have JAX load LAPACK, as it does where it lowers a call; programs that come from disk crash without."""
    jax.jit(jnp.linalg.cholesky).lower(jax.ShapeDtypeStruct((1, 1), float))
    use_one_thread()


def _new(place, lowered):
    if "callback" in lowered.as_text():  # to Python, of this process
        return None
    blank = jax.tree.map(lambda leaf: np.zeros(leaf.shape, leaf.dtype), lowered.out_info).tree

    def compile():
        _listen()
        _thread.found = False
        compiled = lowered.compile()
        if not _thread.found:
            with suppress(Exception):  # of what cannot be written, or a full disk
                _write(place, pickle.dumps((serialize_executable.serialize(compiled)[0], blank)))
                for copy in place.parents[1].glob(f"jit_*_{place.name}-*"):  # of JAX's
                    copy.unlink(missing_ok=True)
        return compiled

    return KeptProgram(blank, compile)


@cache
def _listen():
    jax.monitoring.register_event_listener(_note)


def _note(event: str, **_what: Any) -> None:
    if event == FOUND:
        _thread.found = True


def _write(place, text):
    place.parent.mkdir(parents=True, exist_ok=True)
    with written_whole(place) as part:
        part.write_bytes(hashlib.sha256(text).digest() + text)
