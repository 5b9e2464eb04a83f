import sys
from pathlib import Path

import jax
import pytest

sys.path.insert(0, str(Path(__file__).parent))

MOST_MAPS = 40_000  # of the 65 530 that Linux gives a process; beyond them the compiler crashes


@pytest.fixture(autouse=True)
def _room_for_compiled_programs():
    """Each compiled program holds hundreds of memory maps, so forget them in time."""
    maps = Path("/proc/self/maps")
    if maps.exists() and maps.read_bytes().count(b"\n") > MOST_MAPS:
        jax.clear_caches()
