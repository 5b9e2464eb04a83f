"""Read MJCF, the format of MuJoCo, by MuJoCo's own parser and compiler.

What the elements mean: https://mujoco.readthedocs.io/en/stable/XMLreference.html. MuJoCo resolves defaults, angles,
includes and inertias from shapes; what it compiles is read here.
"""

import itertools
from collections import defaultdict
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from linkax.machines.draft import Draft, Pose
from linkax.machines.machine import Start
from linkax.machines.parts import Place
from linkax.machines.poses import exact, from_quaternion, inverse, pose, relative, to_quaternion, turned
from linkax.machines.visuals import find_mesh
from linkax.machines.xml import MachineFileError, Node, Where, below, library, read_xml
from linkax.model.bodies import GROUND_NAME
from linkax.model.constraints.constraint import Coupling
from linkax.model.constraints.polynomial_coupling import PolynomialCoupling
from linkax.model.forces.affine_actuator import AffineActuator
from linkax.model.forces.joint_forces import JointInertia
from linkax.model.joints.fixed import Fixed
from linkax.model.joints.free import Free
from linkax.model.joints.prismatic import Prismatic
from linkax.model.joints.revolute import Revolute
from linkax.model.joints.spherical import Spherical

FILES = ("mesh", "texture", "hfield", "skin", "flex", "flexcomp", "model", "include")  # elements that name a file
HIDDEN_GROUP = 3  # geoms of this group and later ones, MuJoCo's viewer hides, such as those of contact alone
NO_COLOUR = np.array([0.5, 0.5, 0.5, 1.0], np.float32)  # of a geom that has none of its own
DEEPEST = 20  # files that include each other
SHORTEST = 1e-9  # apart from each other, two points of a pair of connects make an axis [m]


def read_mjcf(root: Node, draft: Draft) -> None:
    """Fill a draft from an MJCF file.

    **Raises:** `MachineFileError` for what MuJoCo does not read, with its message, and without MuJoCo.
    """
    mujoco = library("mujoco", draft.path, "MJCF, which MuJoCo")
    missing = _files(root, draft)
    try:
        spec = mujoco.MjSpec.from_file(str(draft.path))
        _without_missing(spec, missing, draft)
        model = spec.compile()
    except (ValueError, RuntimeError, mujoco.FatalError) as error:
        raise MachineFileError(f"{draft.path.name}: MuJoCo does not read it: {' '.join(str(error).split())}") from error
    _Compiled(mujoco, spec, model, draft).read()


def _files(root: Node, draft: Draft) -> set[str]:
    """Check where the files lie that a file names, and return the names of meshes that are not there."""
    missing: set[str] = set()
    open_ones = [(root, 0)]
    while open_ones:
        node, depth = open_ones.pop()
        compilers = [each for each in _nested(node) if each.tag == "compiler"]
        folders = {name: text for each in compilers for name, text in each.attributes.items() if name.endswith("dir")}
        for each in _nested(node):
            file = each.attributes.get("file", "")
            if each.tag not in FILES or not file:
                continue
            folder = folders.get("texturedir" if each.tag == "texture" else "meshdir", folders.get("assetdir", ""))
            given = file if each.tag in ("include", "model") else f"{folder}/{file}" if folder else file
            path = below(draft.path.parent, given, draft.folders, each.where.error)
            if each.tag in ("include", "model"):
                if depth == DEEPEST:
                    raise each.where.error(f"{DEEPEST} files include each other; take one out")
                open_ones.append((read_xml(path), depth + 1))
            elif not path.is_file():
                missing.add(each.attributes.get("name") or path.stem)
                draft.leave_out(each.where, each.tag, f"file {file!r} is not there", False)
    return missing


def _nested(node: Node) -> Iterator[Node]:
    yield node
    for child in node:
        yield from _nested(child)


def _without_missing(spec: Any, missing: set[str], draft: Draft) -> None:
    """Take out what is only drawn, and meshes that are not there; of a body whose inertia comes from one, note that."""
    for material in spec.materials:
        material.textures = [""] * len(material.textures)
    for texture in list(spec.textures):
        spec.delete(texture)
    for geom in list(spec.geoms):
        if geom.meshname not in missing:
            continue
        body = geom.parent
        if not body.explicitinertial and _moves(body) and geom.mass != 0.0:
            where = Where(draft.path, _line(geom), "geom", geom.name or geom.meshname)
            draft.leave_out(where, "mesh", "its file is not there, from which body has its inertia")
        spec.delete(geom)
    for mesh in [mesh for mesh in spec.meshes if mesh.name in missing]:
        spec.delete(mesh)


def _moves(body: Any) -> bool:
    """Whether a body, or one that carries it, has a joint."""
    while body is not None:
        if len(body.joints):
            return True
        body = body.parent
    return False


def _line(element: Any) -> int:
    """The line of an element, 0 where MuJoCo does not know it."""
    words = element.info.split()
    return int(words[1]) if len(words) > 1 and words[1].isdigit() else 0


class _Compiled:
    """A model that MuJoCo has compiled."""

    def __init__(self, mujoco: Any, spec: Any, model: Any, draft: Draft) -> None:
        self.mujoco, self.model, self.draft = mujoco, model, draft
        self.spec, self._found = spec, dict[str, dict[int, Any]]()
        self.body_names = [GROUND_NAME, *self._names("body")[1:]]
        kinds = [mujoco.mjtJoint(int(kind)).name.removeprefix("mjJNT_").lower() for kind in model.jnt_type]
        bodies = [self.body_names[body] for body in model.jnt_bodyid]
        self.joint_names = self._names("joint", [f"{body}.{kind}" for body, kind in zip(bodies, kinds, strict=True)])

    def read(self) -> None:
        """Read bodies with their joints, then all else."""
        model, draft = self.model, self.draft
        draft.name = self.spec.modelname
        whole = Where(draft.path, 1, "mujoco", draft.name)
        self.gravity = np.array(model.opt.gravity) * self._has("GRAVITY")
        draft.gravity(self.gravity, whole)
        if model.opt.density or model.opt.viscosity:
            draft.leave_out(whole, "fluid", "forces of the medium: density, viscosity and wind of <option>")
        for count, kind in ((model.nflex, "flex"), (model.nplugin, "plugin"), (model.nskin, "skin")):
            if count:
                draft.leave_out(whole, kind, f"{count} <{kind}>", kind != "skin")
        for body in range(1, model.nbody):
            self._body(body)
        if self._has("EQUALITY"):
            self._equalities()
        for tendon in range(model.ntendon):
            self._tendon(tendon)
        for actuator in range(model.nu if self._has("ACTUATION") else 0):
            self._actuator(actuator)
        for sensor in sorted(self._elements("sensor")):
            draft.leave_out(self._where("sensor", sensor), "sensor", "a sensor does not move anything", False)
        for key in range(model.nkey):
            self._start(key)

    def _has(self, what: str) -> bool:
        """Whether a kind of force is not disabled by a <flag>."""
        return not self.model.opt.disableflags & int(getattr(self.mujoco.mjtDisableBit, f"mjDSBL_{what}"))

    def _elements(self, kind: str) -> dict[int, Any]:
        """The elements of a kind as the file has them, by their index in the model."""
        if kind not in self._found:
            plural = {"body": "bodies", "equality": "equalities", "mesh": "meshes"}.get(kind, f"{kind}s")
            self._found[kind] = {element.id: element for element in getattr(self.spec, plural)}
        return self._found[kind]

    def _names(self, kind: str, instead: Sequence[str] | None = None) -> list[str]:
        """Names by index; for what has none the one given instead, with a number where that is taken."""
        given, found = self._elements(kind), list[str]()
        taken = {element.name for element in given.values()} | {GROUND_NAME}
        for index in range(len(given)):
            name = given[index].name if given[index].name != GROUND_NAME else ""
            stem = kind if instead is None else instead[index]
            candidates = (stem + (f"_{count}" if count else "") for count in itertools.count())
            found.append(name or next(candidate for candidate in candidates if candidate not in taken))
            taken.add(found[-1])
        return found

    def _where(self, kind: str, index: int) -> Where:
        """The place of an element by its index in the model."""
        element = self._elements(kind)[index]
        return Where(self.draft.path, _line(element), kind, element.name)

    def _body(self, index: int) -> None:
        """A body, and massless ones between its joints where it has several."""
        model, draft = self.model, self.draft
        where = self._where("body", index)
        name, parent = self.body_names[index], self.body_names[model.body_parentid[index]]
        own = pose(model.body_pos[index], from_quaternion(model.body_quat[index]))
        drawn = draft.poses[parent] @ own
        first, count = int(model.body_jntadr[index]), int(model.body_jntnum[index])
        chain = [f"{name}[{step}]" for step in range(1, count)]
        for between in chain:
            draft.body(between, drawn, 0.0, np.zeros(3), np.zeros((3, 3)), where)
        principal = from_quaternion(model.body_iquat[index])
        inertia = turned(np.diag(model.body_inertia[index]), principal)
        at = np.array(model.body_ipos[index])
        sites = self._elements("site")
        of_body = [site for site in range(model.nsite) if model.site_bodyid[site] == index and sites[site].name]
        frames = {sites[site].name: np.array(model.site_pos[site]) for site in of_body}
        mass = float(model.body_mass[index])
        draft.body(name, drawn, mass, at, inertia, where, frames)
        if model.body_gravcomp[index]:
            draft.carry(name, at, -mass * float(model.body_gravcomp[index]) * self.gravity, where)
        if model.body_mocapid[index] >= 0:
            draft.leave_out(where, "mocap", "the body is moved by motion capture; it stays as drawn")
        begin = int(model.body_geomadr[index])
        for geom in range(begin, begin + int(model.body_geomnum[index])):
            if self._has("CONTACT") and model.geom_contype[geom] | model.geom_conaffinity[geom]:
                draft.leave_out(self._where("geom", geom), "contact", f"contact of body {name!r} with others")
            if model.geom_group[geom] < HIDDEN_GROUP:
                self._shape(geom, name)
        stations = [Place.at(parent, own), *(Place.at(between, np.eye(4)) for between in (*chain, name))]
        if not count:
            draft.joint_at(Fixed, f"{name}.fixed", stations[0], stations[-1], where)
        for step in range(count):
            self._joint(first + step, stations[step], stations[step + 1])

    def _shape(self, index: int, body: str) -> None:
        """A geom as it is seen, in the colour that MuJoCo's own viewer gives it; what is not kept of it is noted."""
        model, where = self.model, self._where("geom", index)
        kind = self.mujoco.mjtGeom(int(model.geom_type[index])).name.removeprefix("mjGEOM_").lower()
        at = pose(model.geom_pos[index], from_quaternion(model.geom_quat[index]))
        colour, material = np.array(model.geom_rgba[index], dtype=float), int(model.geom_matid[index])
        if np.all(colour == NO_COLOUR):
            colour = np.array(model.mat_rgba[material], dtype=float) if material >= 0 else None
        x, y, z = map(float, model.geom_size[index])
        sizes = {
            "sphere": [x], "capsule": [x, 2.0 * y], "cylinder": [x, 2.0 * y], "ellipsoid": [x, y, z],
            "box": [2.0 * x, 2.0 * y, 2.0 * z],
        }  # fmt: skip
        try:
            if kind == "mesh":
                path, scale, in_geom = self._mesh(int(model.geom_dataid[index]), where)
                self.draft.shape(body, kind, scale, at @ in_geom, path, colour)
            elif kind in sizes:
                self.draft.shape(body, kind, sizes[kind], at, None, colour)
            else:
                raise ValueError(f"a geom of type {kind!r} is not drawn")
        except ValueError as error:
            self.draft.leave_out(where, "geom", str(error), False)

    def _mesh(self, index: int, where: Where) -> tuple[Path, np.ndarray, Pose]:
        """The file of a mesh, its scale, and its pose in the geom, which MuJoCo has put at the centre of the mesh.

        **Raises:** `ValueError` for a mesh that is in no file, and one that its scale shears.
        """
        model, element = self.model, self._elements("mesh")[index]
        scale, back = np.array(model.mesh_scale[index]), from_quaternion(element.refquat).T
        address = int(model.mesh_pathadr[index])
        if address < 0 or (np.ptp(scale) and not np.allclose(back, np.eye(3))):
            raise ValueError("its mesh is in no file, or turned before it is scaled, and not drawn")
        file = Path(model.paths[address:].split(b"\0")[0].decode()).absolute()
        path = find_mesh(self.draft, str(file), where)
        centre = pose(model.mesh_pos[index], from_quaternion(model.mesh_quat[index]))
        return path, scale, inverse(centre) @ pose(-scale * (back @ element.refpos), back)

    def _joint(self, index: int, parent: Place, child: Place) -> None:
        model, draft, kinds = self.model, self.draft, self.mujoco.mjtJoint
        where, name, kind = self._where("joint", index), self.joint_names[index], kinds(int(model.jnt_type[index]))
        dof = int(model.jnt_dofadr[index])
        if kind == kinds.mjJNT_FREE:
            draft.joint_at(Free, name, parent, child, where)
            terms = [(name, place) for place in (3, 4, 5, 0, 1, 2)]
        else:
            at = np.array(model.jnt_pos[index])
            first, second = (Place(end.body, end.offset + end.rotation @ at, end.rotation) for end in (parent, child))
            if kind == kinds.mjJNT_BALL:
                draft.joint_at(Spherical, name, first, second, where)
                terms = [(name, place) for place in range(3)]
            else:
                of_type = Revolute if kind == kinds.mjJNT_HINGE else Prismatic
                draft.joint_at(of_type, name, first, second, where, axis=np.array(model.jnt_axis[index]))
                terms = [name]
        self._along(index, name, where, terms, dof)

    def _along(self, index: int, name: str, where: Where, terms: list[Any], dof: int) -> None:
        """Spring, damper, friction, rotor and stops along a joint."""
        model, draft = self.model, self.draft
        ref = float(model.qpos0[model.jnt_qposadr[index]])
        for place, along in enumerate(terms):
            label = name if len(terms) == 1 else f"{name}[{along[1]}]"
            damping = float(model.dof_damping[dof + place]) * self._has("DAMPER")
            friction = float(model.dof_frictionloss[dof + place]) * self._has("FRICTIONLOSS")
            draft.along(along, label, where, damping=damping, friction=friction)
            if armature := float(model.dof_armature[dof + place]):
                draft.force(JointInertia, f"{label}.armature", where, joint=along, inertia=armature)
        if stiffness := float(model.jnt_stiffness[index]) * self._has("SPRING"):
            if len(terms) == 1:
                free = float(model.qpos_spring[model.jnt_qposadr[index]]) - ref
                draft.along(name, name, where, stiffness=stiffness, free=free)
            else:
                draft.leave_out(where, "spring", "a spring along several coordinates")
        of_newer = [(field, getattr(model, field, None)) for field in ("jnt_stiffnesspoly", "dof_dampingpoly")]
        rows = {"jnt_stiffnesspoly": index, "dof_dampingpoly": slice(dof, dof + len(terms))}
        for field, entries in of_newer:
            if entries is not None and np.any(entries[rows[field]]):
                draft.leave_out(where, "spring", f"nonlinear terms, {field}")
        if model.jnt_limited[index] and self._has("LIMIT"):
            if len(terms) > 1:
                draft.leave_out(where, "limit", "a range of a ball")
                return
            lower, upper = (float(end) - ref for end in model.jnt_range[index])
            draft.limit(name, name, where, lower, upper, stiffness=self._stop_stiffness(index, dof))

    def _stop_stiffness(self, index: int, dof: int) -> float | None:
        """The stiffness that MuJoCo's `solreflimit` means for the inertia that the joint has as drawn."""
        time, ratio = map(float, self.model.jnt_solref[index])
        if time <= 0.0:
            return -time or None
        most = float(self.model.jnt_solimp[index][1])
        return 1.0 / (most * time**2 * ratio**2 * float(self.model.dof_invweight0[dof]))

    def _equalities(self) -> None:
        """Joints that close loops, and couplings."""
        model, kinds = self.model, self.mujoco.mjtEq
        names, places = (
            self._names("equality", [self._between(index) for index in range(model.neq)]),
            [self._where("equality", index) for index in range(model.neq)],
        )
        pairs = defaultdict[tuple[str, str], list[tuple[int, Place, Place]]](list)
        for index, (name, where) in enumerate(zip(names, places, strict=True)):
            kind = kinds(int(model.eq_type[index]))
            if not model.eq_active0[index]:
                self.draft.leave_out(where, "equality", "it is not active", False)
            elif kind in (kinds.mjEQ_CONNECT, kinds.mjEQ_WELD):
                first, second = self._ends(index, kind == kinds.mjEQ_WELD)
                if kind == kinds.mjEQ_CONNECT:
                    pairs[first.body, second.body].append((index, first, second))
                else:
                    holds_turns = model.eq_data[index][10] != 0.0  # torquescale
                    self.draft.joint_at(Fixed if holds_turns else Spherical, name, first, second, where, cut=True)
            elif kind in (kinds.mjEQ_JOINT, kinds.mjEQ_TENDON):
                self._coupling(index, name, where, kind == kinds.mjEQ_TENDON)
            else:
                self.draft.leave_out(where, "equality", "an equality that is no connect, weld, joint or tendon")
        for connects in pairs.values():
            self._connects(connects, names, places)

    def _between(self, index: int) -> str:
        """What to call an equality without a name: by what it is between."""
        element = self._elements("equality")[index]
        return "-".join(filter(None, (element.name1, element.name2)))

    def _ends(self, index: int, is_weld: bool) -> tuple[Place, Place]:
        """The places of an equality on its two bodies, which coincide where it holds."""
        model = self.model
        objects, data = (model.eq_obj1id[index], model.eq_obj2id[index]), np.array(model.eq_data[index])
        if self.mujoco.mjtObj(int(model.eq_objtype[index])) == self.mujoco.mjtObj.mjOBJ_SITE:
            on = [pose(model.site_pos[site], from_quaternion(model.site_quat[site])) for site in objects]
            first, second = (
                Place.at(self.body_names[model.site_bodyid[site]], at) for site, at in zip(objects, on, strict=True)
            )
            return first, second
        first, second = (self.body_names[body] for body in objects)
        if not is_weld:
            return Place(first, data[:3], np.eye(3)), Place(second, data[3:6], np.eye(3))
        turn = from_quaternion(data[6:10])  # of the second body, seen from the first; the anchor is on both
        return Place(first, data[3:6], turn), Place(second, data[:3], np.eye(3))

    def _connects(
        self, connects: list[tuple[int, Place, Place]], names: Sequence[str], places: Sequence[Where]
    ) -> None:
        """Balls at the points where two bodies are connected; two points make a hinge."""
        if len(connects) == 2:
            (index, first, second), (_, other, other_second) = connects
            axis = other.offset - first.offset
            if np.linalg.norm(axis) > SHORTEST:
                drawn = relative(self.draft.poses[first.body], self.draft.poses[second.body])[:3, :3]
                turn = _turn_between(drawn @ axis, other_second.offset - second.offset) @ drawn
                parent, child = Place(first.body, first.offset, np.eye(3)), Place(second.body, second.offset, turn)
                self.draft.joint_at(Revolute, names[index], parent, child, places[index], axis=axis, cut=True)
                return
        for index, first, second in connects:
            self.draft.joint_at(Spherical, names[index], first, second, places[index], cut=True)

    def _coupling(self, index: int, name: str, where: Where, of_tendons: bool) -> None:
        """y = a₀ + a₁ x + … of coordinates, or lengths, measured from where the machine is drawn."""
        model, coefficients = self.model, np.array(self.model.eq_data[index][:5])
        objects = int(model.eq_obj1id[index]), int(model.eq_obj2id[index])
        if of_tendons:
            follower, leader = (self._transmission(t, where) for t in objects)
        else:
            follower, leader = ({self.joint_names[joint]: 1.0} if joint >= 0 else {} for joint in objects)
        if follower is None or leader is None:
            return
        if np.any(coefficients[2:]) and leader:
            arguments = {"joint": follower, "of": leader, "coefficients": coefficients}
            self.draft.constraint(PolynomialCoupling, name, where, **arguments)
            return
        terms = dict(follower)
        for joint, factor in leader.items():
            terms[joint] = terms.get(joint, 0.0) - coefficients[1] * factor
        terms = {joint: float(factor) for joint, factor in terms.items() if factor}
        self.draft.constraint(Coupling, name, where, coefficients=terms, offset=float(coefficients[0]))

    def _transmission(self, tendon: int, where: Where) -> dict[str, float] | None:
        """The coefficients of a fixed tendon; None for a spatial one, which is noted."""
        model = self.model
        if tendon < 0:
            return {}
        span = range(model.tendon_adr[tendon], model.tendon_adr[tendon] + model.tendon_num[tendon])
        if any(model.wrap_type[wrap] != int(self.mujoco.mjtWrap.mjWRAP_JOINT) for wrap in span):
            self.draft.leave_out(where, "tendon", "a spatial tendon; take linkax.Rope or ElasticRope")
            return None
        return {self.joint_names[model.wrap_objid[wrap]]: float(model.wrap_prm[wrap]) for wrap in span}

    def _tendon(self, index: int) -> None:
        """Spring and damper of a fixed tendon."""
        model, where = self.model, self._where("tendon", index)
        stiffness = float(model.tendon_stiffness[index]) * self._has("SPRING")
        damping = float(model.tendon_damping[index]) * self._has("DAMPER")
        if model.tendon_limited[index] or model.tendon_frictionloss[index] or model.tendon_armature[index]:
            self.draft.leave_out(where, "tendon", "range, dry friction or armature of a tendon")
        if not stiffness and not damping:
            return
        lower, upper = model.tendon_lengthspring[index]
        if stiffness and lower != upper:
            self.draft.leave_out(where, "tendon", "a spring with a range of lengths without force")
            return
        if terms := self._transmission(index, where):
            rest = float(lower - model.tendon_length0[index])
            bias = np.array([stiffness * rest, -stiffness, -damping])
            name = f"{self._names('tendon')[index]}.spring"
            self.draft.force(AffineActuator, name, where, transmission=terms, gain=0.0, bias=bias)

    def _actuator(self, index: int) -> None:
        """A force along a joint or a fixed tendon, affine in control, length and rate."""
        model, kinds = self.model, self.mujoco
        where, name = self._where("actuator", index), self._names("actuator")[index]
        if self.draft.ignores("actuator", where, "the actuator"):
            return
        transmission, target = kinds.mjtTrn(int(model.actuator_trntype[index])), int(model.actuator_trnid[index][0])
        gain_type, bias_type = (
            kinds.mjtGain(int(model.actuator_gaintype[index])),
            kinds.mjtBias(int(model.actuator_biastype[index])),
        )
        terms: dict[str, float] | None = None
        if transmission in (kinds.mjtTrn.mjTRN_JOINT, kinds.mjtTrn.mjTRN_JOINTINPARENT):
            if model.jnt_type[target] in (int(kinds.mjtJoint.mjJNT_HINGE), int(kinds.mjtJoint.mjJNT_SLIDE)):
                terms = {self.joint_names[target]: 1.0}
        elif transmission == kinds.mjtTrn.mjTRN_TENDON:
            terms = self._transmission(target, where)
        known = (
            gain_type in (kinds.mjtGain.mjGAIN_FIXED, kinds.mjtGain.mjGAIN_AFFINE)
            and bias_type in (kinds.mjtBias.mjBIAS_NONE, kinds.mjtBias.mjBIAS_AFFINE)
            and model.actuator_dyntype[index] == int(kinds.mjtDyn.mjDYN_NONE)
        )
        if not terms or not known:
            if terms is not None or transmission != kinds.mjtTrn.mjTRN_TENDON:
                reason = "an actuator that is not affine, has a state, or acts on no hinge, slide or fixed tendon"
                self.draft.leave_out(where, "actuator", reason)
            return
        gear = float(model.actuator_gear[index][0])
        terms = {joint: gear * factor for joint, factor in terms.items()}
        drawn = sum(
            factor * float(model.qpos0[model.jnt_qposadr[self.joint_names.index(joint)]])
            for joint, factor in terms.items()
        )
        from_drawn = lambda prm: np.array([prm[0] + prm[1] * drawn, prm[1], prm[2]])
        given, bias_given = model.actuator_gainprm[index], model.actuator_biasprm[index]
        gain = float(given[0]) if gain_type == kinds.mjtGain.mjGAIN_FIXED else from_drawn(given)
        bias = np.zeros(3) if bias_type == kinds.mjtBias.mjBIAS_NONE else from_drawn(bias_given)
        arguments: dict[str, Any] = {"transmission": terms, "control": 0.0, "gain": gain, "bias": bias}
        if model.actuator_forcelimited[index]:
            arguments["force_range"] = np.array(model.actuator_forcerange[index])
        self.draft.force(AffineActuator, name, where, **arguments)

    def _start(self, index: int) -> None:
        """A keyframe, as coordinates and speeds of linkax."""
        model, kinds = self.model, self.mujoco.mjtJoint
        qpos, qvel = np.array(model.key_qpos[index]), np.array(model.key_qvel[index])
        positions: dict[str, Any] = {}
        speeds: dict[str, Any] = {}
        for joint, name in enumerate(self.joint_names):
            at, dof, kind = (
                int(model.jnt_qposadr[joint]),
                int(model.jnt_dofadr[joint]),
                kinds(int(model.jnt_type[joint])),
            )
            if kind == kinds.mjJNT_FREE:
                drawn = self._free_frame(joint)
                turn = from_quaternion(qpos[at + 3 : at + 7])
                seen = relative(pose(qpos[at : at + 3], turn), drawn)
                positions[name] = np.concatenate([to_quaternion(seen[:3, :3]), seen[:3, 3]])
                into = drawn[:3, :3].T
                speeds[name] = np.concatenate([into @ turn @ qvel[dof + 3 : dof + 6], into @ qvel[dof : dof + 3]])
            elif kind == kinds.mjJNT_BALL:
                positions[name] = qpos[at : at + 4]
                speeds[name] = from_quaternion(qpos[at : at + 4]) @ qvel[dof : dof + 3]
            else:
                positions[name] = float(qpos[at] - model.qpos0[at])
                speeds[name] = float(qvel[dof])
        name = self._names("key")[index]
        self.draft.starts[name] = Start(positions, speeds)
        if np.any(model.key_ctrl[index]):
            self.draft.leave_out(self._where("key", index), "key", "controls of a keyframe; give them as params", False)

    def _free_frame(self, joint: int) -> Pose:
        """The parent's frame of a free joint in the world, where the file draws its body."""
        return self.draft.poses[self.body_names[self.model.jnt_bodyid[joint]]]


def _turn_between(first: Float[np.ndarray, "3"], second: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """The shortest rotation from one direction to another; two sites may be drawn where their loop is open."""
    from scipy.spatial.transform import Rotation

    across = np.cross(first, second)
    angle, size = np.arctan2(np.linalg.norm(across), first @ second), np.linalg.norm(across)
    if size == 0.0 and angle > 0.0:  # opposite: half a turn about any axis across
        across = np.cross(first, np.eye(3)[np.argmin(np.abs(first))])
        size = np.linalg.norm(across)
    return exact(Rotation.from_rotvec(across * (angle / size)).as_matrix()) if size else np.eye(3)
