"""Where code lies that no user changes."""

import os
import sysconfig
from pathlib import Path

import jax
import numpy as np

LIBRARIES = tuple(
    {os.fspath(Path(path).parent) + os.sep for path in (os.__file__, Path(jax.__file__).parent, np.__path__[0])}
    | {sysconfig.get_path("purelib") + os.sep, sysconfig.get_path("platlib") + os.sep}
    | {os.fspath(Path(__file__).parents[1]) + os.sep}
)  # folders of Python, of installed packages, and of what is distributed with this one
