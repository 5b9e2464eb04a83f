"""Settings of all tests, and which of them share a process.

`annotations` and `slow_tests` say which run, `processor_time` how long they take.
"""

import ctypes
import gc
import os
import re
import sys
from collections import Counter
from functools import cache
from pathlib import Path

# The settings that users have, for tests marked users_settings.
AS_USERS_DO = os.environ.get("AS_USERS_DO") == "1"
# Tests spend their time on compiling, which these halve and more; they change how code is made, not what it computes.
if not AS_USERS_DO:
    os.environ.setdefault(
        "XLA_FLAGS",
        "--xla_cpu_use_fusion_emitters=false --xla_llvm_disable_expensive_passes=true "
        "--xla_backend_optimization_level=0 --xla_cpu_parallel_codegen_split_count=1",
    )
    # Errors of Equinox as numbers that are not finite: a program with a callback in it cannot be kept.
    os.environ.setdefault("EQX_ON_ERROR", "nan")
# Programs without lines of source code in them: less to lower and to carry along.
os.environ.setdefault("JAX_TRACEBACK_IN_LOCATIONS_LIMIT", "0")

import jax  # noqa: E402
import psutil  # noqa: E402
import pytest  # noqa: E402
from hypothesis import Phase, settings  # noqa: E402
from jax.experimental.compilation_cache import compilation_cache  # noqa: E402
from xdist.scheduler import LoadScopeScheduling  # noqa: E402

sys.path.insert(0, str(Path(__file__).parent))
from program_folder import forget_oldest, program_folder  # noqa: E402

from linkax.xla import memory_maps  # noqa: E402
from scalarjit import keep_in, machine  # noqa: E402

# Nor is code compiled again with more care where it runs often.
if not AS_USERS_DO:
    machine.OFTEN = sys.maxsize

pytest_plugins = ["annotations", "processor_time", "slow_tests"]

# What one test has compiled, in this run or an earlier one, the next one reads; so do processes that tests start. Small
# programs, too, of which there are thousands: to read one takes 7 ms, to compile it 25 ms.
if not AS_USERS_DO and "JAX_COMPILATION_CACHE_DIR" not in os.environ:
    folder = program_folder()
    forget_oldest(folder)
    os.environ |= {
        "JAX_COMPILATION_CACHE_DIR": str(folder),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
    }
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)

# The same examples in each run; `--hypothesis-profile thorough` takes many others, and makes failing ones small.
_quick = [Phase.explicit, Phase.generate]
settings.register_profile("repeatable", deadline=None, derandomize=True, max_examples=30, database=None, phases=_quick)
settings.register_profile("thorough", deadline=None, max_examples=1000)
settings.load_profile("repeatable")

gc.set_threshold(20_000, 20, 50)  # tracing makes many objects at a time, few of them in cycles
CACHE_SETTINGS = {name: value for name, value in jax.config.values.items() if "cache" in name}


SHARED = re.compile(r"^from (?:mechanisms import (\w+)|(known_answers) import)", re.MULTILINE)


@cache
def _group(path):
    """What tests share programs by: the first mechanism that their file takes, or scenes with known answers."""
    found = SHARED.search(path.read_text())
    return path.stem if found is None else found[1] or found[2]


class ByGroup(LoadScopeScheduling):
    """Give tests that share programs to one worker, as `--dist loadfile` does those of a file.

    `--dist loadgroup` does not: pytest-xdist 3.8 writes the group into what pytest 9.2 does not read any more.
    """

    def _split_scope(self, nodeid):
        return _group(self.config.rootpath / nodeid.partition("::")[0])


def pytest_xdist_make_scheduler(config, log):
    return ByGroup(config, log) if config.option.dist == "loadfile" else None


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items):
    """Begin with the longest groups, so that none is waited for at the end."""
    length = Counter()
    for path in {item.path for item in items}:
        length[_group(path)] += path.stat().st_size
    items.sort(key=lambda item: (-length[_group(item.path)], _group(item.path)))


# Compiled programs hold memory maps, of which Linux gives a process 65 530 unless it is told otherwise. Programs of the
# largest file of tests take fewer than these.
MAPS_OF_A_FILE = 15_000


def _forget_programs():
    gc.unfreeze()
    memory_maps.clear_caches()
    gc.freeze()
    if sys.platform == "linux":
        ctypes.CDLL(None).malloc_trim(0)  # the C library keeps what is freed


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item, nextitem):
    """Keep the memory of this process in order between tests, none of which is charged for it.

    Programs are forgotten before a test where this process holds more memory than the machine has left: the smallest
    takes 1.4 MB. And after a file where the next one may run out of memory maps, in the middle of which linkax would do
    so with a warning.
    """
    if psutil.Process().memory_info().rss > psutil.virtual_memory().available:
        _forget_programs()
    result = yield
    if nextitem is None or nextitem.path != item.path:
        if memory_maps.has_room(MAPS_OF_A_FILE):
            # What a file leaves is mostly programs in caches. To look through those of all files for garbage takes 7 s.
            gc.collect(1)
            gc.freeze()
        else:
            _forget_programs()
    return result


@pytest.fixture(autouse=True)
def _programs_are_kept_no_longer():
    """Undo what `lx.cache_programs` changes, which the command line calls too; programs kept on disk run otherwise."""
    yield
    keep_in(None)
    if changed := {name: value for name, value in CACHE_SETTINGS.items() if jax.config.values[name] != value}:
        for name, value in changed.items():
            jax.config.update(name, value)
        compilation_cache.reset_cache()  # which is open in the folder of the test
