"""Actuators of a model: forces that are affine in control, length and rate."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from linkax.machines.write_mjcf.model import Model, add, refused, words
from linkax.model.terms import Term


def write_actuator(
    model: Model,
    force: Any,
    name: str,
    terms: Mapping[Term, float],
    gain: np.ndarray,
    bias: np.ndarray,
    force_range: Any = None,
) -> None:
    """Write an actuator on a joint, or on a fixed tendon where there are several.

    **Raises:** `ValueError` for one along a ball.
    """
    (first, *others), factor = terms, 1.0
    joint = model.joint(force, first)
    if joint.get("type") == "ball":
        raise refused(force, f"no actuator of MuJoCo keeps to an axis of the parent of {first.joint!r}")
    if others:
        on = {"tendon": model.fixed(force, f"{name}.transmission", terms)}
    else:
        on, factor = {"joint": joint.get("name", "")}, terms[first]
    attributes = {"gear": words([factor, 0.0, 0.0, 0.0, 0.0, 0.0]), "biastype": "affine", "biasprm": words(bias)}
    attributes |= {"gaintype": "fixed" if len(gain) == 1 else "affine", "gainprm": words(gain)}
    if force_range is not None:
        attributes |= {"forcelimited": "true", "forcerange": words(force_range)}
    add(model.section("actuator"), "general", name=name, **on, **attributes)
