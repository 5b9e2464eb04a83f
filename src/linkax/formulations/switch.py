"""Many classical formulations in one program, by `lax.switch`."""

import dataclasses
from typing import Any, cast

import numpy as np
from jax import lax
from jaxtyping import Float

from linkax.formulations.classical import AbstractAcceleration, AbstractCorrection, ClassicalFormulation
from linkax.xla.arrays import Array


class _OneAcceleration(AbstractAcceleration):
    """One of several accelerations, chosen by a traced number."""

    choices: tuple[AbstractAcceleration, ...]
    index: np.ndarray

    def __call__(
        self,
        mass: Float[Array, "n n"],
        jacobian: Float[Array, "m n"],
        force: Float[Array, " n"],
        gamma: Float[Array, " m"],
    ) -> tuple[Float[Array, " n"], Float[Array, " m"]]:
        choices = [lambda *system, choice=choice: choice(*system) for choice in self.choices]
        return lax.switch(self.index, choices, mass, jacobian, force, gamma)


class _OneCorrection(AbstractCorrection):
    """One of several corrections, chosen by a traced number."""

    choices: tuple[AbstractCorrection, ...]
    index: np.ndarray

    def right_inverse(self, mass: Float[Array, "n n"], jacobian: Float[Array, "m n"]) -> Float[Array, "n m"]:
        choices = [lambda *system, choice=choice: choice.right_inverse(*system) for choice in self.choices]
        return lax.switch(self.index, choices, mass, jacobian)


def in_one_program(formulations: list[ClassicalFormulation]) -> list[ClassicalFormulation]:
    """The same formulations, such that all without correction share one program, and all with one another.

    Compiling takes seconds each, the choice within a program a microsecond in each evaluation.
    """
    found = list(formulations)
    for corrected in (False, True):
        group = [place for place, chosen in enumerate(formulations) if (chosen.correction is not None) == corrected]
        accelerations = tuple(formulations[place].acceleration for place in group)
        corrections = tuple(formulations[place].correction for place in group)
        for index, place in enumerate(group):
            number = np.asarray(index)
            shared: dict[str, Any] = {"acceleration": _OneAcceleration(accelerations, number)}
            if corrected:
                shared["correction"] = _OneCorrection(cast(tuple[AbstractCorrection, ...], corrections), number)
            found[place] = dataclasses.replace(formulations[place], **shared)
    return found
