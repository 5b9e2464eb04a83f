"""Joints to sections of a beam: their motion is that of the beam's axis, by its strains.

Along a beam the section's axes R and its place p follow the strains of the axis, twist and curvatures κ
and stretch and shears γ: R' = R κ̂, p' = R (e₁ + γ) (Reissner, 1973; Simo, 1985). Strains are linear
between nodes; from one section to another within an element the solution is the exponential of a
screw (Magnus series to fourth order, exact where strains are constant).
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from linkax.model.joints.joint import AbstractJoint, JointKind, Motion
from linkax.model.terms import Term
from linkax.spatial.screws import chain, exponential, product, screw_matrix

NUM_STRAINS = 6
# Where an element has sections: at its nodes, and between them where Gauss's rule with two points has its mass. (Its
# error and that of the strains have opposite signs in frequencies; those of Simpson's rule have equal ones.)
STATIONS = np.array([0.0, 0.5 - np.sqrt(1.0 / 12.0), 0.5 + np.sqrt(1.0 / 12.0), 1.0])


def strain_unit(strain: int) -> str:
    """Unit of a coordinate of a strain: of an element's turn, or of its elongation."""
    return "rad" if strain < 3 else "m"


def _along_element(first, second, length, begin, end):
    """The motion from one section to another of an element.

    `first`, `second`: strains at its nodes times its `length`, (6,) each; `begin`, `end`: from 0 to 1.
    """
    part, middle = end - begin, (begin + end) / 2.0
    straight = length * np.eye(NUM_STRAINS)[3]
    strain, slope = first + middle * (second - first) + straight, second - first
    strain, slope = screw_matrix(strain), screw_matrix(slope)
    bracket = product(strain, slope) - product(slope, strain)
    return exponential(part * strain + part**3 / 12.0 * bracket)


@dataclasses.dataclass(frozen=True)
class _OfStrains(Motion):
    """- `strains`: which components are coordinates; the others are zero."""

    strains: tuple[int, ...]

    def _of_nodes(self, coordinates):
        """All components of strain at the nodes, times the element's length, (n, 6)."""
        given = coordinates.reshape(-1, len(self.strains))
        return jnp.zeros((len(given), NUM_STRAINS), coordinates.dtype).at[:, np.array(self.strains)].set(given)


@dataclasses.dataclass(frozen=True)
class WithinElement(_OfStrains):
    """From one section of an element to another. Numbers: the element's length, and where both are in it."""

    def __call__(self, coordinates, numbers):
        return _along_element(*self._of_nodes(coordinates), *numbers)


@dataclasses.dataclass(frozen=True)
class AlongBeam(_OfStrains):
    """From a beam's base to a section anywhere on it, by way of the same sections as those of `Beam`.

    Numbers: the length of an element, and the section's place [m], which is the last coordinate where it
    `slides`. Beyond its ends the beam goes on with the strains of its last elements.
    """

    slides: bool

    def __call__(self, coordinates, numbers):
        length, *place = numbers
        if self.slides:
            coordinates, place = coordinates[:-1], [coordinates[-1]]
        strains = self._of_nodes(coordinates)
        element = np.repeat(np.arange(len(strains) - 1), len(STATIONS) - 1)
        begin, most = (np.tile(of_element, len(strains) - 1) for of_element in (STATIONS[:-1], np.diff(STATIONS)))
        first, last = np.arange(len(element)) == 0, np.arange(len(element)) == len(element) - 1
        part = place[0] / length - (element + begin)
        part = jnp.where((part > 0.0) | first, part, 0.0)
        part = jnp.where((part < most) | last, part, most)
        along = jax.vmap(_along_element, in_axes=(0, 0, None, 0, 0))
        return chain(along(strains[element], strains[element + 1], length, begin, begin + part))


class OnBeam(AbstractJoint):
    """A joint in the tree that moves as a beam bends; it is never cut.

    - `beam`: the name of the joint that has the beam's strains as coordinates.
    - `strains`: see `linkax.Beam`; `elements`: their number; `length`: of an element [m].
    """

    locked_rotations = ()
    locked_translations = ()
    aligned_axes = ()

    beam: str = eqx.field(static=True)
    strains: tuple[int, ...] = eqx.field(static=True)
    elements: int = eqx.field(static=True)
    length: Float[Array, ""]

    def __init__(self, name, parent, child, beam, strains, elements, length):
        super().__init__(name, parent, child, "x")
        self.beam, self.strains, self.elements, self.length = beam, strains, elements, length

    def _terms(self, first_node, last_node):
        count = len(self.strains)
        return tuple(Term(self.beam, index) for index in range(first_node * count, (last_node + 1) * count))

    @property
    def movers(self):
        return self._terms(0, self.elements)

    @property
    def speed_units(self):
        return self.kind.speed_units

    @property
    def reach(self):
        return self.length * self.elements

    @property
    def angular_subspace(self):
        """The axes about which it can turn its child, see `linkax.model.immobile_rows`."""
        return tuple(map(tuple, np.eye(3)[[strain for strain in self.strains if strain < 3]]))

    @property
    def linear_subspace(self):
        """The directions in which it can move its child, likewise."""
        bends = [strain for strain in self.strains if strain in (1, 2)]
        stretches = [strain - 3 for strain in self.strains if strain >= 3]
        across = [3 - strain for strain in bends]
        return tuple(map(tuple, np.eye(3)[sorted({*stretches, *across, *(0 for _ in bends)})]))

    @staticmethod
    def rotation(coordinates):
        raise NotImplementedError("joints of a beam have a `motion`")

    @staticmethod
    def measure(rotation, separation):
        raise NotImplementedError("joints of a beam are never cut")


class BeamSegment(OnBeam):
    """From one section of a beam to the next; `begin`, `end`: where both are in their `element`, from 0 to 1.

    The one that has the beam's name has the strains of all nodes as coordinates.
    """

    element: int = eqx.field(static=True)
    begin: float = eqx.field(static=True)
    end: float = eqx.field(static=True)

    def __init__(self, name, parent, child, beam, strains, elements, length, element, begin, end):
        super().__init__(name, parent, child, beam, strains, elements, length)
        self.element, self.begin, self.end = element, begin, end

    @property
    def kind(self):
        of_node = tuple(map(strain_unit, self.strains)) if self.name == self.beam else ()
        return JointKind("BeamSegment", WithinElement(self.strains), (self.elements + 1) * of_node)

    @property
    def movers(self):
        return self._terms(self.element, self.element + 1)

    @property
    def numbers(self):
        return jnp.stack(jnp.broadcast_arrays(self.length, self.begin, self.end))

    @property
    def reach(self):
        return self.length * (self.end - self.begin)


class BeamStation(OnBeam):
    """From a beam's base to the section at a `place` [m] on it."""

    place: Float[Array, ""]

    def __init__(self, name, parent, child, beam, strains, elements, length, place):
        super().__init__(name, parent, child, beam, strains, elements, length)
        self.place = place

    @property
    def kind(self):
        return JointKind("BeamStation", AlongBeam(self.strains, slides=False), ())

    @property
    def numbers(self):
        return jnp.stack(jnp.broadcast_arrays(self.length, self.place))


class Sliding(OnBeam):
    """A sleeve on a beam that bends: the child slides along the bent axis and turns with its sections.

    Coordinate: distance [m] of the child's frame from the beam's base along the axis, unstretched. The
    child's frame has the axes of the section where it is. It is always in the tree. For a pad or a wheel,
    which does not turn with the section, put a massless body on the sleeve and another joint on that.
    Beyond its ends the beam goes on as its last elements end.

    **Arguments:** `name`, unique among joints; `beam`, a `linkax.Beam`; `child`: a body (its reference
    frame) or `body.at(...)`.
    """

    def __init__(self, name: str, beam, child):
        if not hasattr(beam, "elements"):
            raise ValueError(f"joint {name!r}: beam is {beam!r}; give a lx.Beam, and any body as child")
        super().__init__(name, beam, child, beam.name, beam.strains, beam.elements, beam.element_length)

    @property
    def kind(self):
        return JointKind("Sliding", AlongBeam(self.strains, slides=True), ("m",))

    @property
    def movers(self):
        return (*super().movers, Term(self.name, None))

    @property
    def numbers(self):
        return jnp.reshape(self.length, (1,))

    @property
    def linear_subspace(self):
        return tuple(dict.fromkeys([(1.0, 0.0, 0.0), *super().linear_subspace]))
