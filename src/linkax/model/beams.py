"""Flexible beams and their elastic forces; `linkax.model.discretisation` takes beams apart.

The coordinates of a beam are the strains of its axis, linear between nodes. The beam is geometrically exact, its
elastic forces are linear in its coordinates, and a slender one shears and stretches only where asked to. (The
alternatives: nodes with absolute coordinates and corotated elements need constraints to join a tree of relative
coordinates; rigid segments with springs converge with the second order, strains linear between nodes with the sixth.)
"""

from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from linkax.model.bodies import AbstractBody, Frame, body_name
from linkax.model.elements import Configuration, Motion
from linkax.model.forces.force import AbstractForce, Load
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
# Where an element has its mass, from 0 to 1: Gauss's rule with two points. (In frequencies its error and that of the
# strains have opposite signs; the errors of Simpson's rule and of the strains have equal ones.)
MASS_PLACES = np.array([0.5 - np.sqrt(1.0 / 12.0), 0.5 + np.sqrt(1.0 / 12.0)])
# What a section needs for each strain.
STIFFNESSES = ("torsional_stiffness", *2 * ("bending_stiffness",), "axial_stiffness", *2 * ("shear_stiffness",))
PLACED = 1e-9  # rounding of places at the ends of an element, in its lengths


class FrameOnBeam(Frame):
    """A frame on the section at offset[0] [m] of the beam named `body`.

    - `element`: the element that this section is in, from 0.
    """

    element: int = eqx.field(static=True)


class Beam(AbstractBody):
    """A flexible body along its x axis, initially straight and uniform, from frame "base" to frame "tip".

    It is geometrically exact (Reissner 1973, Simo 1985): bending, torsion, stretch and shear may be as large as a
    material law holds that is linear in the strains of the axis. Its coordinates, found under its name like those of
    a joint, are strain × element length at each node, node by node: twist, bending about y and z [rad], stretch,
    shear along y and z [m], those of them that the beam has. Its mass is in two sections of each element (Gauss's
    rule).

    **Arguments:**

    - `name`: unique in the mechanism, among joints too.
    - `length` [m].
    - `section`: a `Section`.
    - `elements`: number n of elements. Errors of deflections fall as n⁻⁶, those of frequencies as n⁻⁴.
    - `bends`: axes about which it bends, "yz" (default), "y", "z" or "".
    - `torsion`, `stretch`: whether it twists and stretches. Where it does not, it is rigid, and the motion has none
      of these fast waves.
    - `shear`: False for an Euler-Bernoulli beam, True for a Timoshenko beam, which shears in the directions in which
      it bends.
    - `damping`: time constant τ [s] of Kelvin-Voigt damping: elastic forces are those of strain + τ × strain rate,
      and a mode of frequency ω has the damping ratio ω τ / 2.

    Joints and forces attach to `beam.at("tip")`, to `beam.at(2.5)`, the section 2.5 m from the base, or to
    `beam.at([x, y, z])`, a point off the axis that is fixed to the section at x. A moment on a section in the middle
    makes the bending jump; two beams joined there by `Fixed` resolve it best.

    **Raises:** `ValueError` for a length that is not positive and a negative damping, for a beam without strains,
    and for a section without the stiffness or inertia that a strain needs.
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
    ) -> None:
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
        """Make a frame on this beam.

        **Arguments:**

        - `where`: "base", "tip", a distance [m] from the base along the axis, or [x, y, z] off the axis.
        - `rotation`: its axes as columns, in those of its section, shape (3, 3) (default: parallel).
        - `element`: the element that it is in, from 0; needed where JAX traces the distance or the length.

        **Raises:** `ValueError` for a place that is not on the beam, or not in that element.
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
            return FrameOnBeam(self.name, self.within(offset, what, element, element + 1), axes, int(element))
        along = concrete(offset[0] / self.element_length)
        if along is None:
            raise ValueError(f"{what} is traced by JAX; say which element it is in: beam.at(..., element=0)")
        element = int(np.clip(np.floor(along), 0, self.elements - 1))
        return FrameOnBeam(self.name, self.within(offset, what), axes, element)

    def within(self, offset: Array, what: str, first: int = 0, last: int | None = None) -> Float[Array, "3"]:
        """Check that a place [x, y, z] is between two nodes, by default the base and the tip."""
        begin, end = (node * self.element_length for node in (first, self.elements if last is None else last))
        slack = PLACED * self.element_length
        inside = lambda place: ((place[0] >= begin - slack) & (place[0] <= end + slack)).all()
        return require(offset, inside, what, f"its distance from the base must be from {begin} m to {end} m")

    @property
    def element_length(self) -> Float[Array | np.floating, "*batch"]:
        """Length of an element [m]."""
        return self.length / self.elements

    @property
    def fastest_frequency(self) -> Scalar:
        """Estimate of its highest natural frequency [rad/s], that of waves as short as an element.

        Its factors were found for beams of 2 to 8 elements, and hold within a third. Masses that the beam carries
        hardly lower this frequency.
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
        """Names of the sections at nodes, from the base to the tip."""
        return tuple(self.section_name(node) for node in range(self.elements + 1))

    @property
    def sections(self) -> tuple[str, ...]:
        """Names of all sections from the base to the tip: those at nodes, and those that have the mass between them."""
        places = np.add.outer(np.arange(self.elements), [0.0, *MASS_PLACES]).reshape(-1)
        return tuple(self.section_name(place) for place in (*places, self.elements))

    def section_name(self, place: float | int) -> str:
        """Name the section at a place, which is counted in elements from the base."""
        return f"{self.name}[{np.round(place, 2):g}]"

    def strain(self, coordinates: Float[Array, "*batch coordinates"]) -> Float[jax.Array, "*batch nodes 6"]:
        """Compute the strains at nodes: twist, curvatures about y and z [rad/m], stretch, shear along y and z."""
        of_nodes = coordinates.reshape(*coordinates.shape[:-1], self.elements + 1, len(self.strains))
        found = jnp.zeros((*of_nodes.shape[:-1], NUM_STRAINS), coordinates.dtype)
        length = jnp.reshape(jnp.asarray(self.length), (*np.shape(self.length), 1, 1, 1)[-coordinates.ndim - 1 :])
        return found.at[..., np.array(self.strains)].set(of_nodes * self.elements / length)


class BeamElasticity(AbstractForce):
    """The elastic and damping forces of a beam, −K (q + damping × v), where K is constant.

    - `stiffness`: that of an element for each strain, by its coordinate [N m/rad or N/m].
    """

    beam: str = eqx.field(static=True)
    elements: int = eqx.field(static=True)
    stiffness: Float[Array, " n"]
    damping: Scalar

    def __init__(self, beam: Beam) -> None:
        self.beam, self.elements = beam.name, beam.elements
        self.stiffness = jnp.stack([jnp.asarray(beam.section.stiffness(strain)) for strain in beam.strains])
        self.stiffness = self.stiffness / beam.element_length
        self.damping = beam.damping

    @property
    def terms(self) -> tuple[Term, ...]:
        return (Term(self.beam, 0),)

    def _forces(self, coordinates: Float[Array, " n"]) -> Float[jax.Array, " n"]:
        """Compute K q, the gradient of the elastic energy of strains that are linear between nodes.

        Second differences of strains count a little less, which makes the speed of waves accurate to one order more.
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
        """Compute the elastic energy [J] at its coordinates, qᵀ K q / 2."""
        return coordinates @ self._forces(coordinates) / 2.0

    def potential_energy(self, configuration: Configuration) -> Scalar:
        return self.energy(configuration.joint_coordinates(self.beam))
