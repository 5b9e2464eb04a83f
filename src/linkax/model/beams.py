"""Flexible beams: what they are, and the rigid sections, joints and forces that they are made of.

Strains of the axis are the coordinates, linear between nodes: the beam is geometrically exact, its
elastic forces are linear in its coordinates, and a slender one neither shears nor stretches unless it
is asked to. (Of the alternatives, nodes with absolute coordinates or corotated elements need
constraints to join a tree of relative coordinates, and rigid segments with springs converge with the
second order only, where strains that are linear between nodes converge with the fourth.)
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from linkax.model.bodies import AbstractBody, Frame, RigidBody, body_name
from linkax.model.constraints import AbstractConstraint
from linkax.model.forces import AbstractForce, Load
from linkax.model.joints.bending import NUM_STRAINS, STATIONS, AlongBeam, BeamSegment, BeamStation, OnBeam
from linkax.model.joints.joint import AbstractJoint
from linkax.model.numbers import number, require, rotation_matrix
from linkax.model.sections import Section, positive
from linkax.model.terms import Term

# What a section needs against each component of strain.
STIFFNESSES = ("torsional_stiffness", *2 * ("bending_stiffness",), "axial_stiffness", *2 * ("shear_stiffness",))


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
    - `elements`: number of elements. Errors fall with its fourth power.
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
    length: Float[Array, ""]
    section: Section
    elements: int = eqx.field(static=True)
    strains: tuple[int, ...] = eqx.field(static=True)
    damping: Float[Array, ""]

    def __init__(
        self, name, length, section, *, elements=8, bends="yz", torsion=True, stretch=True, shear=False, damping=0.0
    ):
        self.name = body_name(name)
        what = f"beam {name!r}"
        self.length = positive(length, f"{what}: length [m]")
        if not isinstance(section, Section):
            raise ValueError(f"{what}: section is {section!r}; give a lx.Section, lx.rectangle(...) or lx.circle(...)")
        self.section = section
        if isinstance(elements, bool) or not isinstance(elements, int) or elements < 1:
            raise ValueError(f"{what}: elements is {elements!r}; give an integer of at least 1")
        self.elements = elements
        if bends not in ("yz", "y", "z", ""):
            raise ValueError(f"{what}: bends is {bends!r}; known: 'yz', 'y', 'z', ''")
        asked = [torsion, "y" in bends, "z" in bends, stretch, shear and "z" in bends, shear and "y" in bends]
        self.strains = tuple(np.flatnonzero(asked).tolist())
        if not self.strains:
            raise ValueError(f"{what} neither bends, twists nor stretches; use lx.rod")
        for strain in self.strains:
            if section.stiffness(strain) is None:
                raise ValueError(f"{what}: its section has no {STIFFNESSES[strain]}; give it, or leave that strain out")
        if torsion or shear:
            remedy = f"{what} twists or shears, which turns sections and takes some; give it, or axial_stiffness"
            require(section.rotary_inertia, np.any, "section: rotary_inertia [kg m]", remedy)
        seconds = f"{what}: damping [s]"
        self.damping = require(number(damping, (), seconds), lambda x: x >= 0.0, seconds, "it must be zero or more")

    @property
    def reference(self):
        return self.at("base")

    def at(self, where, rotation=None) -> Frame:
        """A frame on this beam, with axes `rotation` in those of its section.

        `where`: "base", "tip", a distance [m] from the base along the axis, or [x, y, z] off the axis.
        """
        axes = rotation_matrix(rotation, f"rotation of a frame on beam {self.name!r}")
        if isinstance(where, str):
            ends = {"base": self.sections[0], "tip": self.sections[-1]}
            if where not in ends:
                raise ValueError(f"beam {self.name!r} has no frame {where!r}; give 'base', 'tip', or a distance [m]")
            return Frame(ends[where], np.zeros(3), axes)
        what = f"place of a frame on beam {self.name!r} [m]"
        if np.ndim(where) == 0:
            along = number(where, (), what)
            return Frame(self.name, along * np.eye(3)[0], axes)
        return Frame(self.name, number(where, (3,), what), axes)

    @property
    def element_length(self) -> Float[Array, ""]:
        """[m]."""
        return self.length / self.elements

    @property
    def sections(self) -> tuple[str, ...]:
        """Names of its sections: nodes, and where it has its mass between them, counted in elements from the base."""
        places = np.add.outer(np.arange(self.elements), STATIONS[:-1]).reshape(-1)
        return tuple(f"{self.name}[{np.round(place, 2):g}]" for place in (*places, self.elements))

    def section_at(self, coordinates, place) -> Float[Array, "4 4"]:
        """The section at a place [m] on the axis, seen from the base, see `linkax.spatial.screws`."""
        return AlongBeam(self.strains, slides=False)(coordinates, (self.element_length, place))

    def strain(self, coordinates) -> Float[Array, "... n 6"]:
        """Strains at the nodes: twist, curvatures about y and z [rad/m], stretch, shear along y and z."""
        of_nodes = coordinates.reshape(*coordinates.shape[:-1], self.elements + 1, len(self.strains))
        found = jnp.zeros((*of_nodes.shape[:-1], NUM_STRAINS), coordinates.dtype)
        length = jnp.reshape(jnp.asarray(self.length), (*np.shape(self.length), 1, 1, 1)[-coordinates.ndim - 1 :])
        return found.at[..., np.array(self.strains)].set(of_nodes * self.elements / length)

    def _bodies(self):
        density, (about_y, about_z) = self.section.linear_density, self.section.rotary_inertia
        inertia = jnp.stack([about_y + about_z, about_y, about_z])
        part = len(STATIONS) - 1
        shares = np.where(np.arange(len(self.sections)) % part == 0, 0.0, 0.5) * self.element_length
        return [
            RigidBody(name, share * density, inertia=share * inertia)
            for name, share in zip(self.sections, shares, strict=True)
        ]

    def _joints(self):
        parts = [divmod(index, len(STATIONS) - 1) for index in range(len(self.sections) - 1)]
        on = lambda section: Frame(section, np.zeros(3), rotation_matrix(None, section))
        return [
            BeamSegment(
                name=self.name if index == 0 else self.sections[index + 1],
                parent=on(self.sections[index]),
                child=on(self.sections[index + 1]),
                beam=self.name,
                strains=self.strains,
                elements=self.elements,
                length=self.element_length,
                element=element,
                begin=float(STATIONS[part]),
                end=float(STATIONS[part + 1]),
            )
            for index, (element, part) in enumerate(parts)
        ]

    def _station(self, name, place):
        """A massless body at a place on the axis, and the joint that holds it there."""
        body = RigidBody(name, 0.0)
        joint = BeamStation(
            name,
            parent=self.reference,
            child=body.reference,
            beam=self.name,
            strains=self.strains,
            elements=self.elements,
            length=self.element_length,
            place=place,
        )
        return body, joint


class BeamElasticity(AbstractForce):
    """The elastic and damping forces of a beam: −K (q + damping × v), K constant.

    - `stiffness`: of each component of strain, for a coordinate of the whole element [N m/rad or N/m].
    """

    beam: str = eqx.field(static=True)
    elements: int = eqx.field(static=True)
    stiffness: Float[Array, " n"]
    damping: Float[Array, ""]

    def __init__(self, beam: Beam):
        self.beam, self.elements = beam.name, beam.elements
        self.stiffness = jnp.stack([jnp.asarray(beam.section.stiffness(strain)) for strain in beam.strains])
        self.stiffness = self.stiffness / beam.element_length
        self.damping = beam.damping

    @property
    def terms(self):
        return (Term(self.beam, 0),)

    def _forces(self, coordinates):
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

    def load(self, t, motion):
        none, topology = Load.none(motion.system), motion.system.topology
        q, v = motion.configuration.joint_coordinates(self.beam), motion.joint_speeds(self.beam)
        forces = -self._forces(q + self.damping * v)
        return none._replace(joint_force=none.joint_force.at[topology.speeds[self.beam]].set(forces))

    def potential_energy(self, configuration):
        q = configuration.joint_coordinates(self.beam)
        return q @ self._forces(q) / 2.0


class Parts(NamedTuple):
    """What a mechanism is made of, with beams taken apart."""

    bodies: list[RigidBody]
    joints: list[AbstractJoint]
    forces: list[AbstractForce]
    constraints: list[AbstractConstraint]


def taken_apart(bodies, joints, forces, constraints) -> Parts:
    """Beams as sections, joints and forces, where they are not yet; frames at places on them as massless bodies."""
    names = {body.name for body in bodies}
    beams = {body.name: body for body in bodies if isinstance(body, Beam) and body.sections[0] not in names}
    bodies = [body for body in bodies if not isinstance(body, Beam) or body.name in beams]
    if not beams:
        return Parts(bodies, joints, forces, constraints)
    stations = []

    def resolved(frame):
        if not (isinstance(frame, Frame) and frame.body in beams):
            return frame
        name = f"{frame.body}({sum(body.name.startswith(frame.body + '(') for body, _ in stations) + 1})"
        stations.append(beams[frame.body]._station(name, frame.offset[0]))
        return Frame(name, jnp.asarray(frame.offset) * np.array([0.0, 1.0, 1.0]), frame.rotation)

    with_frames = lambda elements: [
        jax.tree.map(resolved, element, is_leaf=lambda part: isinstance(part, Frame)) for element in elements
    ]
    joints, forces, constraints = map(with_frames, (joints, forces, constraints))
    of_beams = beams.values()
    return Parts(
        [part for body in bodies for part in (body._bodies() if isinstance(body, Beam) else [body])]
        + [body for body, _ in stations],
        [*(segment for beam in of_beams for segment in beam._joints()), *(joint for _, joint in stations), *joints],
        [*forces, *map(BeamElasticity, of_beams)],
        constraints,
    )


def held_first(joints) -> list[set[str]]:
    """Names of joints that must be in the tree, those of beams themselves before those that slide on them."""
    of_beams = {joint.name for joint in joints if isinstance(joint, BeamSegment | BeamStation)}
    return [of_beams, {joint.name for joint in joints if isinstance(joint, OnBeam)}]
