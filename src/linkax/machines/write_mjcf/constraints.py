"""Couplings of a model: equalities of joints, and of tendons that are linear combinations of coordinates."""

from typing import Any

import numpy as np

from linkax.machines.mjcf.equalities import MOST_COEFFICIENTS
from linkax.machines.write_mjcf.model import Model, polynomial, refused, terms_of
from linkax.model.constraints.constraint import Coupling
from linkax.model.constraints.polynomial_coupling import PolynomialCoupling


def write_constraint(model: Model, constraint: Any) -> None:
    """Write a constraint.

    **Raises:** `ValueError` for one that MuJoCo has no equality for.
    """
    if type(constraint) is Coupling:
        _write_coupling(model, constraint)
    elif type(constraint) is PolynomialCoupling:
        name, coefficients = constraint.name, np.asarray(constraint.coefficients)
        if len(coefficients) > MOST_COEFFICIENTS:
            raise refused(constraint, f"MuJoCo's polynomials have {MOST_COEFFICIENTS} coefficients at most")
        follower = model.fixed(constraint, f"{name}.joint", terms_of(constraint.joint))
        leader = model.fixed(constraint, f"{name}.of", terms_of(constraint.of))
        model.equality("tendon", name, tendon1=follower, tendon2=leader, polycoef=polynomial(*coefficients))
    else:
        raise refused(constraint, "MuJoCo has no such equality; say it by Coupling or PolynomialCoupling")


def _write_coupling(model: Model, coupling: Coupling) -> None:
    """Write Σ factor × coordinate = offset: of one or two joints as theirs, of more as that of a tendon."""
    name, terms, offset = coupling.name, terms_of(coupling.combination), float(coupling.offset)
    first, *others = terms
    if len(others) > 1:
        model.equality("tendon", name, tendon1=model.fixed(coupling, name, terms), polycoef=polynomial(offset))
        return
    names = [model.joint(coupling, term).get("name", "") for term in terms]
    related = dict(zip(("joint1", "joint2"), names, strict=False))
    slope = -sum(terms[term] for term in others) / terms[first]
    model.equality("joint", name, **related, polycoef=polynomial(offset / terms[first], slope))
