"""What `import linkax` brings: public names alone, and no library that few runs need."""

import os
import subprocess
import sys
from pathlib import Path

import linkax as lx

LATE = ("scipy", "zarr", "matplotlib", "optax", "PIL", "fsspec")
SOURCE = Path(lx.__file__).parents[1]


def test_libraries_that_few_runs_need_come_when_they_are_needed():
    told = f"import sys, linkax; print([name for name in {LATE} if name in sys.modules])"
    environment = os.environ | {"PYTHONPATH": str(SOURCE)}
    found = subprocess.run([sys.executable, "-c", told], capture_output=True, text=True, env=environment, check=True)
    assert found.stdout == "[]\n"


def test_completion_shows_public_names_alone():
    assert dir(lx) == sorted(lx.__all__)
    assert {"simulate", "Mechanism", "GROUND", "RESULTS"} <= set(dir(lx))
    for name in dir(lx):
        entry = getattr(lx, name)
        assert type(entry) is not type(lx) or name == "plot", name
        assert getattr(entry, "__module__", "linkax").startswith("linkax"), name
