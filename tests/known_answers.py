"""Answers from elsewhere: the files in `data`, and closed forms."""

from pathlib import Path

import numpy as np
from scipy.special import ellipj, ellipk

from linkax.scenes import SCENES


def reference(name):
    """A file of `data` as a record array."""
    return np.genfromtxt(Path(__file__).parent / "data" / f"{name}.csv", delimiter=",", names=True)


def start(name, variant=None, changes=None):
    """Mechanism and initial state of a scene."""
    scene = SCENES[name]
    settings = scene.settings(variant, changes)
    mechanism = scene.mechanism(settings)
    return mechanism, scene.initial(mechanism, settings)


def n_four_bar(times, count, gravity=9.81):
    """Position of B0 in A02 (LIM/IFToMM library), by Jacobi's elliptic functions."""
    times = np.asarray(times)
    c = gravity * ((count + 1) / 2 + count) / ((count + 1) / 3 + count)
    m = 4 * c / (1 + 4 * c)
    sn, cn, _, _ = ellipj(times / 2 * np.sqrt(1 + 4 * c) - ellipk(m), m)
    return np.stack([-2 * cn * sn, 1 - 2 * cn**2], axis=-1)
