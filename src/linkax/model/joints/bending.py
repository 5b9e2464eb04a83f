"""Joints to sections of a beam: their motion is that of the beam's axis, by its strains.

Along a beam the section's axes R and its place p follow the strains of the axis, twist and curvatures κ
and stretch and shears γ: R' = R κ̂, p' = R (e₁ + γ) (Reissner, 1973; Simo, 1985). Strains are linear
between nodes; from an element's first node to a section of it the solution is the exponential of a
screw (Magnus series to sixth order: Blanes, Casas, Oteo and Ros, Physics Reports 470, 2009; exact
where strains are constant).
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
from linkax.spatial.rotations import compose
from linkax.spatial.screws import exponential, screw_matrix
from linkax.xla.arrays import Array, Scalar


def strain_unit(strain: int) -> str:
    """Unit of a coordinate of a strain: of an element's turn, or of its elongation."""
    return "rad" if strain < 3 else "m"


def _along_element(
    first: Float[Array, "6"], second: Float[Array, "6"], length: Scalar, end: Scalar
) -> Float[jax.Array, "4 4"]:
    """The motion from an element's first node to a section.

    `first`, `second`: strains at its nodes times its `length`, (6,) each; `end`: where the section is, from 0 to 1.
    """
    slope, straight = second - first, length * np.eye(NUM_STRAINS)[3]
    begin, slope = screw_matrix(first + straight), screw_matrix(slope)
    middle, slope = end * (begin + end / 2.0 * slope), end**2 * slope
    turned = _bracket(middle, slope)
    return exponential(middle + _bracket(turned - 20.0 * middle, slope - _bracket(middle, turned) / 60.0) / 240.0)


def _bracket(first: Float[Array, "4 4"], second: Float[Array, "4 4"]) -> Float[jax.Array, "4 4"]:
    """Of screws along which motions follow each other from the left to the right."""
    return compose(second, first) - compose(first, second)


def _all_strains(coordinates: Float[Array, " n"], strains: tuple[int, ...]) -> Float[jax.Array, "nodes 6"]:
    """All components of strain at nodes, times the element's length, (n, 6), where coordinates are some of them."""
    given = coordinates.reshape(-1, len(strains))
    return jnp.zeros((len(given), NUM_STRAINS), coordinates.dtype).at[:, np.array(strains)].set(given)


def section_at(
    coordinates: Float[Array, " n"], strains: tuple[int, ...], length: Scalar, place: Scalar
) -> tuple[Float[jax.Array, "4 4"], Int[jax.Array, ""]]:
    """A section at a place [m], seen from the first node of its element, and which element that is.

    `coordinates`: of the whole beam; `strains`: which ones they are; `length`: of an element.
    """
    of_nodes = _all_strains(coordinates, strains)
    element = jnp.clip(jnp.floor(place / length), 0, len(of_nodes) - 2).astype(int)
    return _along_element(of_nodes[element], of_nodes[element + 1], length, place / length - element), element


@dataclasses.dataclass(frozen=True)
class WithinElement(RelativeMotion):
    """From an element's first node to a section of it, at a distance that a last coordinate may add to.

    Parameters: the element's length, where the section is from 0 to 1 without that coordinate, and whether the way
    may go on before the element, and behind it; else it ends there.

    - `strains`: which components are coordinates; the others are zero.
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
    """A joint in the tree that moves as an element of a beam bends; it is never cut.

    - `beam`: the name of the joint that has the beam's strains as coordinates.
    - `strains`: see `linkax.Beam`; `elements`: their number; `length`: of an element [m]; `element`: which one.
    """

    locked_rotations = ()
    locked_translations = ()
    aligned_axes = ()

    beam: str = eqx.field(static=True)
    strains: tuple[int, ...] = eqx.field(static=True)
    elements: int = eqx.field(static=True)
    length: Scalar
    element: int = eqx.field(static=True)

    def __init__(self, name: str, parent: BodyOrFrame, child: BodyOrFrame, beam: Beam, element: int):
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
        """The axes about which it can turn its child, see `linkax.model.immobile_rows`."""
        return tuple(map(tuple, np.eye(3)[[strain for strain in self.strains if strain < 3]]))

    @property
    def linear_subspace(self) -> tuple[tuple[float, float, float], ...]:
        """The directions in which it can move its child, likewise."""
        bends = [strain for strain in self.strains if strain in (1, 2)]
        stretches = [strain - 3 for strain in self.strains if strain >= 3]
        across = [3 - strain for strain in bends]
        return tuple(map(tuple, np.eye(3)[sorted({*stretches, *across, *(0 for _ in bends)})]))

    @staticmethod
    def rotation(coordinates: Any) -> NoReturn:
        raise NotImplementedError("joints of a beam have a `motion`")

    @staticmethod
    def measure(rotation: Any, separation: Any) -> NoReturn:
        raise NotImplementedError("joints of a beam are never cut")


class BeamSegment(OnBeam):
    """From the first node of an element to a section of it, at a `place` from 0 to 1.

    The one that has the beam's name has the strains of all nodes as coordinates.
    """

    place: Scalar | float

    def __init__(self, name: str, parent: Frame, child: Frame, beam: Beam, element: int, place: Scalar | float):
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
    """A part of `Sliding`, in one element. The last one has the sleeve's name and its coordinate."""

    sleeve: str = eqx.field(static=True)

    def __init__(self, name: str, parent: Frame, child: Frame, beam: Beam, element: int, sleeve: str):
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
    """A sleeve on a beam that bends: the child slides along the bent axis and turns with its sections.

    Coordinate: distance [m] of the child's frame from the beam's base along the axis, unstretched. The
    child's frame has the axes of the section where it is. It is always in the tree. For a pad or a wheel,
    which does not turn with the section, put a massless body on the sleeve and another joint on that.
    Beyond its ends the beam goes on as its last elements end.

    A mechanism takes it apart into parts, one for each element, with massless bodies such as "sleeve[1]"
    between them; the last part keeps its name, its coordinate and its reaction.

    **Arguments:** `name`, unique among joints; `beam`, a `linkax.Beam`; `child`: a body (its reference
    frame) or `body.at(...)`.
    """

    def __init__(self, name: str, beam: Beam, child: BodyOrFrame):
        if not isinstance(beam, Beam):
            raise ValueError(f"joint {name!r}: beam is {beam!r}; give a lx.Beam, and any body as child")
        super().__init__(name, beam, child, beam, beam.elements - 1)

    @property
    def kind(self) -> JointKind:
        return JointKind("Sliding", WithinElement(self.strains), ("m",))
