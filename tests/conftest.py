import os
import sys
from pathlib import Path

# Tests spend their time on compiling, which these halve and more; they change how code is made, not what it computes.
os.environ.setdefault(
    "XLA_FLAGS",
    "--xla_cpu_use_fusion_emitters=false --xla_llvm_disable_expensive_passes=true --xla_backend_optimization_level=0",
)

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
