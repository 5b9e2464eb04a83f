"""Joints to sections of a beam, whose motion follows the strains of its axis.

Along a beam the axes R and the position p of its sections follow R' = R κ̂ and p' = R (e₁ + γ), where κ are twist and
curvatures, γ stretch and shears (Reissner, 1973; Simo, 1985). Strains are linear between nodes. From the first node
of an element to a section of it the solution is the exponential of a screw, by a Magnus series of sixth order (Blanes,
Casas, Oteo and Ros, Physics Reports 470, 2009), which is exact where strains are constant.
"""

import dataclasses
from typing import Any, NoReturn

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from linkax.model.beams import NUM_STRAINS, Beam
from linkax.model.bodies import BodyOrFrame, Frame
from linkax.model.joints.joint import AbstractJoint, JointKind, RelativeMotion
from linkax.model.terms import Term
from linkax.spatial.screws import bracket, exponential
from linkax.xla.arrays import Array, Scalar, ScalarLike


def strain_unit(strain: int) -> str:
    """Return the unit of the coordinate of a strain: rad for twist and bending, m for stretch and shear."""
    return "rad" if strain < 3 else "m"


def _along_element(
    first: Float[Array, "6"], second: Float[Array, "6"], length: Scalar, end: Scalar
) -> Float[jax.Array, "4 4"]:
    """Compute the motion from the first node of an element to a section of it.

    **Arguments:** `first`, `second`: strains at its nodes × its `length`, (6,) each; `end`: where the section is, from
    0 to 1.
    """
    slope, straight = second - first, length * np.eye(NUM_STRAINS, dtype=first.dtype)[3]
    middle, slope = end * (first + straight + end / 2.0 * slope), end**2 * slope
    # Motions follow each other from left to right, so that brackets are those of the series backwards.
    turned = bracket(slope, middle)
    return exponential(middle + bracket(slope - bracket(turned, middle) / 60.0, turned - 20.0 * middle) / 240.0)


def _all_strains(coordinates: Float[Array, " n"], strains: tuple[int, ...]) -> Float[jax.Array, "nodes 6"]:
    """Compute all six strains at nodes, × the element's length, (nodes, 6), from coordinates that are some of them."""
    given = coordinates.reshape(-1, len(strains))
    return jnp.zeros((len(given), NUM_STRAINS), coordinates.dtype).at[:, np.array(strains)].set(given)


def section_at(
    coordinates: Float[Array, " n"], strains: tuple[int, ...], length: Scalar, place: Scalar
) -> tuple[Float[jax.Array, "4 4"], Int[jax.Array, ""]]:
    """Compute the motion from the first node of an element to the section at a place [m], and find that element.

    **Arguments:** `coordinates`: those of the whole beam; `strains`: which strains they are; `length`: that of an
    element [m]; `place` [m]: from the base.
    """
    of_nodes = _all_strains(coordinates, strains)
    element = jnp.clip(jnp.floor(place / length), 0, len(of_nodes) - 2).astype(int)
    return _along_element(of_nodes[element], of_nodes[element + 1], length, place / length - element), element


@dataclasses.dataclass(frozen=True)
class WithinElement(RelativeMotion):
    """The motion from the first node of an element to a section of it; a last coordinate [m] may move the section.

    Parameters: the element's length [m]; where the section is, from 0 to 1, without that coordinate; whether the way
    goes on before the element, and behind it (1 or 0). Where it does not, the section stays at that end.

    - `strains`: which strains are coordinates; the others are zero.
    """

    strains: tuple[int, ...]

    def __call__(self, coordinates: Float[Array, " n"], parameters: Float[Array, "4"]) -> Float[jax.Array, "4 4"]:
        length, place, goes_before, goes_behind = parameters
        strains, along = jnp.split(coordinates, [2 * len(self.strains)])
        end = place + jnp.sum(along) / length
        end = jnp.where((end >= 0.0) | (goes_before > 0.0), end, 0.0)
        end = jnp.where((end < 1.0) | (goes_behind > 0.0), end, 1.0)
        first, second = _all_strains(strains, self.strains)
        return _along_element(first, second, length, end)


class OnBeam(AbstractJoint):
    """A joint in the tree that moves as an element of a beam deforms. It is never cut.

    - `beam`: the name of the beam, and of the joint that has its strains as coordinates.
    - `strains`: which strains the beam has, see `linkax.Beam`.
    - `elements`: the number of its elements.
    - `length`: that of an element [m].
    - `element`: the element, from 0.
    """

    beam: str = eqx.field(static=True)
    strains: tuple[int, ...] = eqx.field(static=True)
    elements: int = eqx.field(static=True)
    length: Scalar
    element: int = eqx.field(static=True)

    def __init__(self, name: str, parent: BodyOrFrame, child: BodyOrFrame, beam: Beam, element: int) -> None:
        super().__init__(name, parent, child, "x")
        self.beam, self.strains = beam.name, beam.strains
        self.elements, self.element, self.length = beam.elements, element, beam.element_length

    @property
    def driven_by(self) -> tuple[Term, ...]:
        count = len(self.strains)
        return tuple(Term(self.beam, index) for index in range(self.element * count, (self.element + 2) * count))

    @property
    def speed_units(self) -> tuple[str, ...]:
        return self.kind.speed_units

    @property
    def angular_subspace(self) -> tuple[tuple[float, float, float], ...]:
        """Axes about which it can turn its child, for `linkax.model.immobile_rows`."""
        return tuple(map(tuple, np.eye(3)[[strain for strain in self.strains if strain < 3]]))

    @property
    def linear_subspace(self) -> tuple[tuple[float, float, float], ...]:
        """Directions in which it can move its child, likewise."""
        bends = [strain for strain in self.strains if strain in (1, 2)]
        stretches = [strain - 3 for strain in self.strains if strain >= 3]
        across = [3 - strain for strain in bends]
        return tuple(map(tuple, np.eye(3)[sorted({*stretches, *across, *(0 for _ in bends)})]))

    def transform(self, coordinates: Any) -> NoReturn:
        raise NotImplementedError("joints of a beam move by its strains")


class BeamSegment(OnBeam):
    """The joint from the first node of an element to a section of it, at a `place` from 0 to 1.

    The one with the beam's name has the strains at all nodes as coordinates.
    """

    place: ScalarLike

    def __init__(self, name: str, parent: Frame, child: Frame, beam: Beam, element: int, place: ScalarLike) -> None:
        super().__init__(name, parent, child, beam, element)
        self.place = place

    @property
    def kind(self) -> JointKind:
        of_node = tuple(map(strain_unit, self.strains)) if self.name == self.beam else ()
        return JointKind("BeamSegment", WithinElement(self.strains), (self.elements + 1) * of_node)

    @property
    def parameters(self) -> Float[jax.Array, "4"]:
        return jnp.stack(jnp.broadcast_arrays(self.length, self.place, 1.0, 1.0))

    @property
    def length_estimate(self) -> Scalar:
        return self.length * self.place


class SleevePart(OnBeam):
    """The part of a `Sliding` in one element. The last part has the sleeve's name and its coordinate."""

    sleeve: str = eqx.field(static=True)

    def __init__(self, name: str, parent: Frame, child: Frame, beam: Beam, element: int, sleeve: str) -> None:
        super().__init__(name, parent, child, beam, element)
        self.sleeve = sleeve

    @property
    def kind(self) -> JointKind:
        return JointKind("Sliding", WithinElement(self.strains), ("m",) if self.name == self.sleeve else ())

    @property
    def driven_by(self) -> tuple[Term, ...]:
        return (*super().driven_by, Term(self.sleeve, None))

    @property
    def parameters(self) -> Float[jax.Array, "4"]:
        ends = float(self.element == 0), float(self.element == self.elements - 1)
        return jnp.stack(jnp.broadcast_arrays(self.length, -float(self.element), *ends))

    @property
    def length_estimate(self) -> Scalar:
        return self.length

    @property
    def linear_subspace(self) -> tuple[tuple[float, float, float], ...]:
        return tuple(dict.fromkeys([(1.0, 0.0, 0.0), *super().linear_subspace]))


class Sliding(OnBeam):
    """A sleeve on a flexible beam: the child slides along the bent axis and turns with its sections.

    Coordinate: distance [m] of the child's frame from the beam's base, along the unstretched axis. The child's frame
    has the axes of the section where it is. The joint is always in the tree. A pad or a wheel does not turn with the
    section: put a massless body on the sleeve, and another joint on that body. Beyond its ends the beam goes on as
    its first and last elements do.

    A mechanism splits the joint into parts, one for each element, with massless bodies such as "sleeve[1]" between
    them. The last part keeps its name, its coordinate and its reaction.

    **Arguments:** `name`: unique among joints; `beam`: a `linkax.Beam`; `child`: a body (its reference frame) or
    `body.at(...)`.
    """

    def __init__(self, name: str, beam: Beam, child: BodyOrFrame) -> None:
        if not isinstance(beam, Beam):
            raise ValueError(f"joint {name!r}: beam is {beam!r}; give a lx.Beam, and any body as child")
        super().__init__(name, beam, child, beam, beam.elements - 1)

    @property
    def kind(self) -> JointKind:
        return JointKind("Sliding", WithinElement(self.strains), ("m",))
