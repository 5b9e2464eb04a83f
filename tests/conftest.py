import gc
import os
import sys
import tempfile
from contextlib import contextmanager
from pathlib import Path
from zlib import crc32

# The settings that users have, for tests marked users_settings.
AS_USERS_DO = os.environ.get("AS_USERS_DO") == "1"
# Tests spend their time on compiling, which these halve and more; they change how code is made, not what it computes.
if not AS_USERS_DO:
    os.environ.setdefault(
        "XLA_FLAGS",
        "--xla_cpu_use_fusion_emitters=false --xla_llvm_disable_expensive_passes=true "
        "--xla_backend_optimization_level=0 --xla_cpu_parallel_codegen_split_count=1",
    )
# What one test file has compiled, in this process or another, the next one reads. Errors of Equinox as numbers that are
# not finite: a program with a callback in it cannot be kept.
if not AS_USERS_DO and "JAX_COMPILATION_CACHE_DIR" not in os.environ:
    _compiled = tempfile.TemporaryDirectory()  # removed with the process that made it, the others inherit its name
    os.environ |= {"JAX_COMPILATION_CACHE_DIR": _compiled.name, "EQX_ON_ERROR": "nan"}
    os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0.2"

# Programs without lines of source code in them: less to lower and to carry along.
os.environ.setdefault("JAX_TRACEBACK_IN_LOCATIONS_LIMIT", "0")

import jax  # noqa: E402
import pytest  # noqa: E402
from hypothesis import Phase, settings  # noqa: E402
from jax.experimental.compilation_cache import compilation_cache  # noqa: E402

# The same examples in each run; `--hypothesis-profile thorough` takes many others, and makes failing ones small.
_quick = [Phase.explicit, Phase.generate]
settings.register_profile("repeatable", deadline=None, derandomize=True, max_examples=30, database=None, phases=_quick)
settings.register_profile("thorough", deadline=None, max_examples=1000)
settings.load_profile("repeatable")

sys.path.insert(0, str(Path(__file__).parent))
from unchecked import unchecked  # noqa: E402

from linkax.xla.kept_programs import keep_in  # noqa: E402

_raises = pytest.raises


@contextmanager
def _raises_unchecked(*args, **options):
    with unchecked(), _raises(*args, **options) as told:
        yield told


pytest.raises = _raises_unchecked

# Files that take longest begin first, so that at the end no process waits for another.
LONGEST = (
    "test_processes",
    "test_telescopic_crane",
    "test_notebooks",
    "test_gradients",
    "test_known_answers",
    "test_singular_starts",
    "test_compiler",
)
gc.set_threshold(20_000, 20, 50)  # tracing makes many objects at a time, few of them in cycles
CACHE_SETTINGS = {name: value for name, value in jax.config.values.items() if "cache" in name}
MOST_MAPS = 40_000  # of the 65 530 that Linux gives a process; beyond them the compiler crashes


def pytest_addoption(parser):
    parser.addoption("--share", metavar="K/N", help="run share K = 0, ..., N - 1 of N of the tests that are chosen")


def pytest_collection_modifyitems(config, items):
    if config.option.share:
        share, shares = map(int, config.option.share.split("/"))
        in_share = lambda item: crc32(item.nodeid.encode()) % shares == share
        config.hook.pytest_deselected(items=[item for item in items if not in_share(item)])
        items[:] = filter(in_share, items)
    place = {name: index for index, name in enumerate(LONGEST)}
    items.sort(key=lambda item: place.get(item.path.stem, len(LONGEST)))


@pytest.fixture(autouse=True)
def _programs_are_kept_no_longer():
    """Undo what `lx.cache_programs` changes, which the command line calls too; programs kept on disk run otherwise."""
    yield
    keep_in(None)
    if changed := {name: value for name, value in CACHE_SETTINGS.items() if jax.config.values[name] != value}:
        for name, value in changed.items():
            jax.config.update(name, value)
        compilation_cache.reset_cache()  # which is open in the folder of the test


@pytest.fixture(autouse=True)
def _room_for_compiled_programs():
    """Each compiled program holds hundreds of memory maps, so forget them in time."""
    maps = Path("/proc/self/maps")
    if maps.exists() and maps.read_bytes().count(b"\n") > MOST_MAPS:
        jax.clear_caches()
        gc.collect()
