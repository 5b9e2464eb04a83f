"""Which slow tests run: those of the layers that a change touches, then a share of the others, as far as time allows.

What did not run is printed.
"""

import re
import subprocess
import time
from collections import Counter
from pathlib import Path
from zlib import crc32

import pytest
from layers import LAYERS, layer

NO_TIME = "no time is left"
LEFT, END = pytest.StashKey[Counter](), pytest.StashKey[float]()


def pytest_addoption(parser):
    group = parser.getgroup("slow tests")
    group.addoption("--share", metavar="K/N", help="run share K = 0, ..., N - 1 of N of the tests that are chosen")
    group.addoption(
        "--changed-since",
        metavar="COMMIT",
        help="run tests of layers that have changed since a commit, and of those above them, first and in all shares",
    )
    group.addoption("--minutes", type=float, help="begin no test later than that")


def pytest_configure(config):
    if config.option.minutes is not None:
        config.stash[END] = time.monotonic() + 60.0 * config.option.minutes


@pytest.hookimpl(trylast=True)  # of the tests that other options leave
def pytest_collection_modifyitems(config, items):
    share, shares = map(int, (config.option.share or "0/1").split("/"))
    touched = _touched_by(_changed(config.option.changed_since, config.rootpath), config.rootpath)
    is_touched = {path: touched(path) for path in {_path(item) for item in items}}
    # Tests of this share come first, then those of the next, so that over many commits time is left for each.
    after = {item: (crc32(item.nodeid.partition("@")[0].encode()) - share) % shares for item in items}
    first = sorted((item for item in items if is_touched[_path(item)]), key=after.get)
    others = [item for item in items if not is_touched[_path(item)]]
    left = [item for item in others if after[item]]
    config.hook.pytest_deselected(items=left)
    config.stash[LEFT] = Counter(_path(item).as_posix() for item in left)
    items[:] = first + [item for item in others if not after[item]]


def _path(item):
    return item.path.relative_to(item.config.rootpath)


def _changed(commit, root):
    """Files that have changed since a commit, relative to the root; none for None."""
    if commit is None:
        return []
    command = ["git", "diff", "--name-only", commit, "--", "src", "tests"]
    told = subprocess.run(command, cwd=root, capture_output=True, text=True, check=True)
    return [Path(line) for line in told.stdout.splitlines()]


def _touched_by(changed, root):
    """Whether a change touches the tests of a file: its layer or one below, the file, or what it imports of tests."""
    if not changed:
        return lambda path: False
    lowest = min((_layer_of(path) for path in changed if path.parts[0] == "src"), default=len(LAYERS) + 1)
    modules = "|".join(path.stem for path in changed if path.parts[0] == "tests")
    imports = re.compile(rf"^(from|import) ({modules or '(?!)'})\b", re.MULTILINE)
    in_tests = lambda path: path in changed or bool(imports.search((root / path).read_text()))
    return lambda path: _highest_layer(path) >= lowest or in_tests(path)


def _layer_of(path):
    """The layer of a source; above all of them where it is in none."""
    _, _, *names = path.with_suffix("").parts
    try:
        return layer(*names)
    except StopIteration:
        return len(LAYERS)


def _highest_layer(path):
    """The highest layer that a file of tests is of; above all of them where its folder is named after none."""
    of_folder = (index for index, name in enumerate(LAYERS) if name.split(".")[0] == path.parent.name)
    return max(of_folder, default=len(LAYERS))


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item):
    if time.monotonic() > item.config.stash.get(END, float("inf")):
        pytest.skip(NO_TIME)


def pytest_sessionfinish(session):
    if hasattr(session.config, "workeroutput"):
        session.config.workeroutput["left"] = dict(session.config.stash.get(LEFT, {}))


@pytest.hookimpl(optionalhook=True)  # of pytest-xdist
def pytest_testnodedown(node):
    if hasattr(node, "workeroutput"):
        node.config.stash[LEFT] = Counter(node.workeroutput["left"])


def pytest_terminal_summary(terminalreporter, config):
    late = [report.nodeid for report in terminalreporter.stats.get("skipped", []) if NO_TIME in str(report.longrepr)]
    left = config.stash.get(LEFT, Counter())
    if not late and not left:
        return
    terminalreporter.section("did not run")
    for nodeid in late:
        terminalreporter.line(f"{nodeid}: {NO_TIME}")
    for path, count in sorted(left.items()):
        terminalreporter.line(f"{path}: {count} of layers that have not changed, and of another share")
