"""Flexible beams: what they are, and their elastic forces (`linkax.model.discretisation` takes them apart).

Strains of the axis are the coordinates, linear between nodes: the beam is geometrically exact, its
elastic forces are linear in its coordinates, and a slender one neither shears nor stretches unless it
is asked to. (Of the alternatives, nodes with absolute coordinates or corotated elements need
constraints to join a tree of relative coordinates, and rigid segments with springs converge with the
second order only, where strains that are linear between nodes converge with the sixth.)
"""

from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from linkax.model.bodies import AbstractBody, Frame, body_name
from linkax.model.elements import Configuration, Motion
from linkax.model.forces import AbstractForce, Load
from linkax.model.numbers import (
    Matrix,
    Number,
    Vector,
    number,
    one_of,
    positive,
    real,
    require,
    require_bool,
    require_type,
    rotation_matrix,
    whole_number,
    zero_or_more,
)
from linkax.model.sections import Section
from linkax.model.terms import Term
from linkax.xla.arrays import Array, Scalar
from linkax.xla.tracing import concrete

NUM_STRAINS = 6
# Where an element has its mass, between its nodes: Gauss's rule with two points. (Its error and that of the strains
# have opposite signs in frequencies; those of Simpson's rule have equal ones.)
MASS_PLACES = np.array([0.5 - np.sqrt(1.0 / 12.0), 0.5 + np.sqrt(1.0 / 12.0)])
# What a section needs against each component of strain.
STIFFNESSES = ("torsional_stiffness", *2 * ("bending_stiffness",), "axial_stiffness", *2 * ("shear_stiffness",))
PLACED = 1e-9  # of an element: rounding of places at its ends


class Place(Frame):
    """A frame on a section of a beam, whose name is `body`, at offset[0] [m]; the section is in that element."""

    element: int = eqx.field(static=True)


class Beam(AbstractBody):
    """An initially straight, uniform, flexible body along its x axis, from frame "base" to "tip".

    Bending, torsion, stretch and shear of any size that the material's law, linear in the strains of the
    axis, stands for (a geometrically exact beam: Reissner 1973, Simo 1985). Its coordinates, under its
    name as of a joint, are the strains at the nodes times the length of an element, node by node, in the
    order twist, bending about y, about z [rad], stretch, shear along y, along z [m], as many of them as
    the beam has. Its mass is in two sections of each element (Gauss's rule).

    **Arguments:**

    - `name`: unique in the mechanism, among joints too.
    - `length` [m]; `section`: a `Section`.
    - `elements`: number of elements. Errors of deflections fall with its sixth power, of frequencies with its fourth.
    - `bends`: axes about which it bends, "yz" (default), "y", "z" or "".
    - `torsion`, `stretch`: whether it twists and stretches. Without, it is rigid against that, and motion
      has no fast waves.
    - `shear`: False for Euler and Bernoulli, True for Timoshenko; shear goes with the bending.
    - `damping`: time [s] by which strain rates count as strains (Kelvin and Voigt): a mode of frequency ω
      has the damping ratio ω damping / 2.

    Joints, forces and other bodies attach to `beam.at("tip")`, `beam.at(2.5)` (a section [m] from the
    base) or `beam.at([x, y, z])` (a point off the axis, fixed to the section at x). Moments on sections
    in the middle, which make the bending jump, are resolved best between two beams joined there by
    `Fixed`.

    **Raises:** `ValueError` for what cannot be, and for a section without the stiffness that a strain needs.
    """

    name: str = eqx.field(static=True)
    length: Scalar
    section: Section
    elements: int = eqx.field(static=True)
    strains: tuple[int, ...] = eqx.field(static=True)
    damping: Scalar

    def __init__(
        self,
        name: str,
        length: Number,
        section: Section,
        *,
        elements: int = 8,
        bends: Literal["yz", "y", "z", ""] = "yz",
        torsion: bool = True,
        stretch: bool = True,
        shear: bool = False,
        damping: Number = 0.0,
    ):
        self.name = body_name(name)
        what = f"beam {name!r}"
        self.length = positive(length, f"{what}: length [m]")
        sections = "give a lx.Section, lx.rectangle(...) or lx.circle(...)"
        self.section = require_type(section, Section, f"{what}: section", sections)
        self.elements = whole_number(elements, f"{what}: elements")
        flags = {"torsion": torsion, "stretch": stretch, "shear": shear}
        torsion, stretch, shear = (require_bool(entry, f"{what}: {name}") for name, entry in flags.items())
        one_of(bends, ("yz", "y", "z", ""), f"{what}: bends")
        asked = [torsion, "y" in bends, "z" in bends, stretch, shear and "z" in bends, shear and "y" in bends]
        self.strains = tuple(np.flatnonzero(asked).tolist())
        if not self.strains:
            raise ValueError(f"{what} neither bends, twists nor stretches; use lx.rod")
        for strain in self.strains:
            if section.stiffness(strain) is None:
                raise ValueError(f"{what}: its section has no {STIFFNESSES[strain]}; give it, or leave that strain out")
        if torsion or shear:
            remedy = f"{what} twists or shears, which turns sections and takes some; give it, or axial_stiffness"
            resists = require(section.rotary_inertia, lambda x: x.any(), "section: rotary_inertia [kg m]", remedy)
            self.section = eqx.tree_at(lambda of: of.rotary_inertia, section, resists)
        self.damping = zero_or_more(damping, f"{what}: damping [s]")

    @property
    def reference(self) -> Frame:
        return self.at("base")

    def at(self, where: str | Number | Vector, rotation: Matrix | None = None, *, element: int | None = None) -> Frame:
        """A frame on this beam, with axes `rotation` in those of its section.

        `where`: "base", "tip", a distance [m] from the base along the axis, or [x, y, z] off the axis.
        `element`: in which element that is, counted from 0; needed where JAX traces the distance or the length.
        """
        axes = rotation_matrix(rotation, f"rotation of a frame on beam {self.name!r}")
        if isinstance(where, str):
            ends = {"base": self.nodes[0], "tip": self.nodes[-1]}
            if where not in ends:
                raise ValueError(f"beam {self.name!r} has no frame {where!r}; give 'base', 'tip', or a distance [m]")
            return Frame(ends[where], np.zeros(3), axes)
        what = f"place of a frame on beam {self.name!r} [m]"
        offset = real(where, what)
        offset = number(offset, () if offset.shape == () else (3,), what)
        offset = offset * np.eye(3)[0] if offset.shape == () else offset
        if element is not None:
            whole_number(element, f"{what}: element", least=0, most=self.elements - 1)
            return Place(self.name, self.within(offset, what, element, element + 1), axes, int(element))
        along = concrete(offset[0] / self.element_length)
        if along is None:
            raise ValueError(f"{what} is traced by JAX; say which element it is in: beam.at(..., element=0)")
        element = int(np.clip(np.floor(along), 0, self.elements - 1))
        return Place(self.name, self.within(offset, what), axes, element)

    def within(self, offset: Array, what: str, first: int = 0, last: int | None = None) -> Float[Array, "3"]:
        """A place [x, y, z], checked to be between two nodes, by default the base and the tip."""
        begin, end = (node * self.element_length for node in (first, self.elements if last is None else last))
        slack = PLACED * self.element_length
        inside = lambda place: ((place[0] >= begin - slack) & (place[0] <= end + slack)).all()
        return require(offset, inside, what, f"its distance from the base must be from {begin} m to {end} m")

    @property
    def element_length(self) -> Scalar:
        """[m]."""
        return self.length / self.elements

    @property
    def fastest_frequency(self) -> Scalar:
        """Of its natural frequencies the highest, about [rad/s]: of waves as short as its elements.

        Masses that it carries lower that little. Factors as found for beams of 2 to 8 elements, within a third.
        """
        section, order = self.section, 5.5 / self.element_length
        about, turning = section.bending_stiffness, section.rotary_inertia

        def square(strain: int) -> Any:
            stiffness: Any = section.stiffness(strain)
            if strain == 0:
                return order**2 * stiffness / jnp.sum(turning)
            if strain in (1, 2):
                return (50.0 / self.element_length**2) ** 2 * stiffness / section.linear_density
            if strain == 3:
                return order**2 * stiffness / section.linear_density
            axis = 5 - strain  # sections that shear along y turn about z
            return (stiffness + order**2 * about[axis]) / turning[axis]

        return jnp.sqrt(jnp.max(jnp.stack([square(strain) for strain in self.strains])))

    @property
    def nodes(self) -> tuple[str, ...]:
        """Names of the sections at its nodes, from the base to the tip."""
        return tuple(self.section_name(node) for node in range(self.elements + 1))

    @property
    def sections(self) -> tuple[str, ...]:
        """Names of its sections: nodes, and where it has its mass between them, counted in elements from the base."""
        places = np.add.outer(np.arange(self.elements), [0.0, *MASS_PLACES]).reshape(-1)
        return tuple(self.section_name(place) for place in (*places, self.elements))

    def section_name(self, place: float | int) -> str:
        """The name of the section at a place, counted in elements from the base."""
        return f"{self.name}[{np.round(place, 2):g}]"

    def strain(self, coordinates: Float[Array, "*batch coordinates"]) -> Float[jax.Array, "*batch nodes 6"]:
        """Strains at the nodes: twist, curvatures about y and z [rad/m], stretch, shear along y and z."""
        of_nodes = coordinates.reshape(*coordinates.shape[:-1], self.elements + 1, len(self.strains))
        found = jnp.zeros((*of_nodes.shape[:-1], NUM_STRAINS), coordinates.dtype)
        length = jnp.reshape(jnp.asarray(self.length), (*np.shape(self.length), 1, 1, 1)[-coordinates.ndim - 1 :])
        return found.at[..., np.array(self.strains)].set(of_nodes * self.elements / length)


class BeamElasticity(AbstractForce):
    """The elastic and damping forces of a beam: −K (q + damping × v), K constant.

    - `stiffness`: of each component of strain, for a coordinate of the whole element [N m/rad or N/m].
    """

    beam: str = eqx.field(static=True)
    elements: int = eqx.field(static=True)
    stiffness: Float[Array, " n"]
    damping: Scalar

    def __init__(self, beam: Beam):
        self.beam, self.elements = beam.name, beam.elements
        self.stiffness = jnp.stack([jnp.asarray(beam.section.stiffness(strain)) for strain in beam.strains])
        self.stiffness = self.stiffness / beam.element_length
        self.damping = beam.damping

    @property
    def terms(self) -> tuple[Term, ...]:
        return (Term(self.beam, 0),)

    def _forces(self, coordinates: Float[Array, " n"]) -> Float[jax.Array, " n"]:
        """K q: strains that are linear between nodes, squared and integrated.

        Their second differences count a little less, so that waves have the right speed to one order more.
        """
        count = self.elements + 1
        weights = np.diag([1.0 / 3.0, *(count - 2) * [2.0 / 3.0], 1.0 / 3.0])
        weights += (np.eye(count, k=1) + np.eye(count, k=-1)) / 6.0
        bend = np.diff(np.eye(count), n=2, axis=0)
        weights -= bend.T @ bend / 720.0
        of_nodes = coordinates.reshape(self.elements + 1, -1)
        return (jnp.asarray(weights, coordinates.dtype) @ of_nodes * self.stiffness).reshape(-1)

    def load(self, t: Number, motion: Motion) -> Load:
        none, topology = Load.none(motion.system), motion.system.topology
        q, v = motion.configuration.joint_coordinates(self.beam), motion.joint_speeds(self.beam)
        forces = -self._forces(q + self.damping * v)
        return none._replace(joint_force=none.joint_force.at[topology.speeds[self.beam]].set(forces))

    @property
    def matrix(self) -> Float[jax.Array, "n n"]:
        """K, symmetric and positive definite."""
        return jax.vmap(self._forces)(jnp.eye((self.elements + 1) * len(self.stiffness)))

    def energy(self, coordinates: Float[Array, " n"]) -> Scalar:
        """Of its coordinates [J]."""
        return coordinates @ self._forces(coordinates) / 2.0

    def potential_energy(self, configuration: Configuration) -> Scalar:
        return self.energy(configuration.joint_coordinates(self.beam))
