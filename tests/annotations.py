"""The tests that check annotations: one of each file, and all of the files in which nothing large is compiled.

Other runs leave annotations alone, as to check them takes two fifths of the time: `pytest -m annotations
--jaxtyping-packages=linkax,beartype.beartype` is the one that does not.
"""

import re
from contextlib import contextmanager
from functools import cache

import jaxtyping
import pytest


@contextmanager
def unchecked():
    """Switch the checks of annotations off: what linkax refuses, it is to refuse itself, by an error of its own."""
    jaxtyping.config.update("jaxtyping_disable", True)
    try:
        yield
    finally:
        jaxtyping.config.update("jaxtyping_disable", False)


_raises = pytest.raises


@contextmanager
def _raises_unchecked(*args, **options):
    with unchecked(), _raises(*args, **options) as told:
        yield told


def pytest_configure(config):
    if config.option.jaxtyping_packages:
        pytest.raises = _raises_unchecked


COMPILES = re.compile("simulate|assemble|jit")


@cache
def _is_quick(path):
    return not COMPILES.search(path.read_text())


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items):
    begun = set()
    for item in items:
        if item.get_closest_marker("slow") or item.get_closest_marker("users_settings"):
            continue
        if _is_quick(item.path) or item.path not in begun:
            item.add_marker("annotations")
        begun.add(item.path)
