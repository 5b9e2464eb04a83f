"""Numbers that users give for joints, checked."""

import equinox as eqx
import jax
import numpy as np

from linkax.model.mechanism import Mechanism
from linkax.model.numbers import known, number
from linkax.model.terms import Term, term


class Given(eqx.Module):
    """Numbers that a user gives for joints.

    - `terms`: whose they are; one number for a term with an index, else all of the joint's.
    - `values`: as many arrays.
    """

    terms: tuple[Term, ...] = eqx.field(static=True)
    values: tuple[jax.Array, ...]

    def speeds(self, motion) -> list[jax.Array]:
        """The speeds of these joints in a motion, in the shapes of `values`."""
        of_joint = lambda along: motion.joint_speeds(along.joint)
        return [of_joint(along) if along.index is None else of_joint(along)[along.index][None] for along in self.terms]


def by_joint(mechanism: Mechanism, given, what: str, count) -> Given:
    """Numbers for joints, checked: {joint or (joint, index): number or array}; `count` tells how many a joint has."""
    terms, values = [], []
    for key, entry in (given or {}).items():
        along = term(key, what)
        joint = mechanism.joint(along.joint)
        expected = count(joint) if along.index is None else 1
        if along.index is not None and not 0 <= along.index < len(joint.speed_units):
            raise ValueError(
                f"{what} of joint {joint.name!r}: index {along.index}; it has {len(joint.speed_units)} speeds"
            )
        scalar = np.ndim(entry) == 0
        if scalar and expected != 1:
            raise ValueError(f"{what} of joint {joint.name!r} is one number; the joint has {expected} of them")
        terms.append(along)
        values.append(number([entry] if scalar else entry, (expected,), f"{what} of joint {joint.name!r}"))
    return Given(tuple(terms), tuple(values))


def coordinates_by_joint(mechanism: Mechanism, given, what: str) -> Given:
    """Coordinates of joints, quaternions whole and not zero."""
    found = by_joint(mechanism, given, what, lambda joint: joint.num_coordinates)
    for along, entry in zip(found.terms, found.values, strict=True):
        joint = mechanism.joint(along.joint)
        if joint.has_quaternion and along.index is None and known(entry) is not None and not np.any(known(entry)[:4]):
            raise ValueError(f"{what} of joint {joint.name!r} has a quaternion of zeros; no rotation is (1, 0, 0, 0)")
        if joint.has_quaternion and along.index in (0, 1, 2):
            raise ValueError(
                f"{what} of joint {joint.name!r}: index {along.index} is part of a quaternion; give all of it"
            )
    return found
