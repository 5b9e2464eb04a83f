"""Formulations by name, such as "lagrange-multipliers+baumgarte"."""

import dataclasses

from linkax.formulations.augmented_lagrangian import AugmentedLagrangian
from linkax.formulations.classical import Baumgarte, ClassicalFormulation
from linkax.formulations.coordinate_partitioning import CoordinatePartitioning
from linkax.formulations.formulation import AbstractFormulation
from linkax.formulations.lagrange_multipliers import LagrangeMultipliers
from linkax.formulations.moore_penrose import MassOrthogonalProjection, MoorePenrose
from linkax.formulations.projection_operator import ProjectionOperator
from linkax.formulations.tangent_space import TangentSpace

TANGENT_SPACE = "tangent-space"

BASES = {
    "lagrange-multipliers": ClassicalFormulation(LagrangeMultipliers()),
    "lagrange-multipliers-block": ClassicalFormulation(LagrangeMultipliers(block=True)),
    "augmented-lagrangian": ClassicalFormulation(AugmentedLagrangian(), Baumgarte(10.0, 10.0)),
    "moore-penrose-svd": ClassicalFormulation(MoorePenrose("svd")),
    "moore-penrose-gram-schmidt": ClassicalFormulation(MoorePenrose("gram-schmidt")),
    "udwadia-kalaba": ClassicalFormulation(MoorePenrose("svd", 0.0)),  # the same, cut off at rounding
    "projection-operator": ClassicalFormulation(ProjectionOperator()),
}
ADDITIONS = {
    "baumgarte": ("stabilisation", Baumgarte()),
    "partitioning": ("correction", CoordinatePartitioning()),
    "projection": ("correction", MassOrthogonalProjection()),
}


def formulation(name: str) -> AbstractFormulation:
    """The formulation of that name: one of `BASES`, then "+baumgarte", and "+partitioning" or "+projection".

    "tangent-space" is the paper's method, `linkax.TangentSpace()`.

    **Raises:** `ValueError` naming the known words.
    """
    base, *additions = name.split("+")
    if name == TANGENT_SPACE:
        return TangentSpace()
    added = {ADDITIONS[word][0]: ADDITIONS[word][1] for word in additions if word in ADDITIONS}
    twice = base == "augmented-lagrangian" and "baumgarte" in additions
    if base not in BASES or len(added) < len(additions) or twice:
        raise ValueError(
            f"unknown formulation {name!r}; known: {TANGENT_SPACE}, or one of {', '.join(BASES)}, "
            "to which may be added +baumgarte (the augmented one has it), and +partitioning or +projection"
        )
    return dataclasses.replace(BASES[base], **added)


# The paper's, the eleven of its Table 5, and four more that are in use.
COMPARED = (
    TANGENT_SPACE,
    "lagrange-multipliers",
    "lagrange-multipliers+baumgarte",
    "lagrange-multipliers+partitioning",
    "augmented-lagrangian",
    "augmented-lagrangian+partitioning",
    "moore-penrose-svd",
    "moore-penrose-svd+baumgarte",
    "moore-penrose-svd+partitioning",
    "moore-penrose-gram-schmidt",
    "moore-penrose-gram-schmidt+baumgarte",
    "moore-penrose-gram-schmidt+partitioning",
    "lagrange-multipliers-block",
    "lagrange-multipliers+projection",
    "udwadia-kalaba",
    "projection-operator",
)
