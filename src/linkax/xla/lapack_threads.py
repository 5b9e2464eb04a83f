"""Threads of the LAPACK that compiled programs call, which is SciPy's.

Its matrices are of one mechanism each: up to 400 rows a factorisation takes as long with two threads as with one. But
threads that wait for each other spin. Of two processes on two cores, each took 89 s for a dome of 48 scissors, now 30,
and 376 s of processor time in all, now 162.
"""

import os
import sys
from functools import cache
from pathlib import Path
from typing import Any

import jax
import numpy as np
from threadpoolctl import ThreadpoolController

from linkax.xla.memory_maps import COMPILING

LIBRARY = "scipy.linalg.cython_lapack"  # that JAX loads where it lowers the first call
CHOSEN_BY = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")  # variables of the environment


def watch_lapack() -> None:
    """Have `use_one_thread` called before each compilation in this process."""
    jax.monitoring.register_scalar_listener(_before_compiling)


def _before_compiling(event: str, *_time: Any, **_what: Any) -> None:
    if event == COMPILING and LIBRARY in sys.modules:
        use_one_thread()


@cache
def use_one_thread() -> None:
    """Have SciPy's library use one thread, unless the environment says how many; NumPy's own one stays as it is."""
    if any(name in os.environ for name in CHOSEN_BY):
        return
    of_numpy = str(Path(np.__file__).parent)  # beside which, and in which, its wheels have theirs
    for library in ThreadpoolController().select(user_api="blas").lib_controllers:
        if not library.filepath.startswith(of_numpy):
            library.set_num_threads(1)
