"""Where annotations are not checked: what linkax refuses, it is to refuse itself, by an error of its own."""

from contextlib import contextmanager

import jaxtyping


@contextmanager
def unchecked():
    """Switch the checks of annotations off."""
    jaxtyping.config.update("jaxtyping_disable", True)
    try:
        yield
    finally:
        jaxtyping.config.update("jaxtyping_disable", False)
