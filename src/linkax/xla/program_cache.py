"""Compiled programs on disk, for the next process."""

import os
import sys
import threading
from functools import cache
from pathlib import Path
from typing import Any, cast

import jax
from jax.experimental.compilation_cache import compilation_cache

from linkax.files import writable_folder
from linkax.xla.memory_maps import COMPILING
from linkax.xla.users_line import warn
from scalarjit import keep_in
from scalarjit.kept_programs import FOUND

ASKED = "/jax/compilation_cache/compile_requests_use_cache"  # what JAX tells its listeners of a program
FOUND_OR_KEPT = (FOUND, "/jax/compilation_cache/cache_misses")
LONG = 1.0  # time to compile that is worth a warning [s]

_thread = threading.local()


def cache_programs(folder: str | os.PathLike | None = None) -> str:
    """Keep compiled programs on disk, so that later processes need not compile them again.

    Call it before anything is computed: what has been compiled is not kept. The command line does so by itself, unless
    the environment has `JAX_ENABLE_COMPILATION_CACHE=false`. On a processor, later processes need not even trace what
    runs outside of JAX transformations, but where it has elements of one's own.

    **Arguments:** `folder`: may be shared by processes, and removed at any time; what is in it is run, so share it with
    no one whom you do not trust. By default it is `JAX_COMPILATION_CACHE_DIR` of the environment, or else `linkax` in
    the user's folder for caches.

    **Returns:** the folder.

    **Raises:** `ValueError` for a folder that cannot be written to.

    **Warns:** once, of a program that took long to compile and cannot be kept. JAX keeps none that calls back to
    Python, as progress meters, `jax.debug.print` and `equinox.error_if` do.
    """
    path = os.fspath(folder or cast(Any, jax.config).jax_compilation_cache_dir or users_folder())
    if "://" not in path:
        writable_folder(Path(path), "give another folder for programs")
    jax.config.update("jax_compilation_cache_dir", path)
    # By default JAX keeps only what took a second to compile.
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
    compilation_cache.reset_cache()  # which JAX opens when it compiles first
    keep_in(None if "://" in path else Path(path).absolute() / "linkax")
    _listen()
    return path


def users_folder() -> Path:
    """The folder for caches of linkax, by the convention of the system."""
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA") or Path.home() / "AppData" / "Local") / "linkax" / "Cache"
    if sys.platform == "darwin":
        return Path.home() / "Library" / "Caches" / "linkax"
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "linkax"


@cache
def _listen():
    jax.monitoring.register_event_listener(_note)
    jax.monitoring.register_event_duration_secs_listener(_tell)


def _note(event: str, **_what: Any) -> None:
    """Note whether the program that this thread compiles is missing in the cache."""
    if event == ASKED:
        # JAX asks where it has no folder, too, as in a process that keeps programs no longer.
        _thread.missing = cast(Any, jax.config).jax_compilation_cache_dir is not None
    elif event in FOUND_OR_KEPT:
        _thread.missing = False


def _tell(event: str, duration_secs: float, **_what: Any) -> None:
    if event == COMPILING and getattr(_thread, "missing", False):
        _thread.missing = False
        if duration_secs > LONG and jax.process_index() == 0:  # the others write nothing
            _warn()


@cache
def _warn():
    warn(
        f"a program that took long to compile is compiled again by the next process: JAX {jax.__version__} keeps none "
        "that calls back to Python, as progress meters, jax.debug.print and equinox.error_if do"
    )
