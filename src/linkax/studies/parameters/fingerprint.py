"""Recognise whether the results in a file belong to the same study."""

import hashlib
from collections.abc import Iterable

import numpy as np
from jaxtyping import ArrayLike


def fingerprint(text: str, arrays: Iterable[ArrayLike]) -> str:
    """A hash of a program's text and of its input numbers."""
    digest = hashlib.sha256(text.encode())
    for array in arrays:
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()
