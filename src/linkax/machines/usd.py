"""Read USD Physics, by Pixar's own library: rigid bodies, joints and drives of a stage.

What the schemas mean: https://openusd.org/release/api/usd_physics_page_front.html. Units of the stage become kg, m and
rad; scale goes into lengths. Attributes are read at the earliest time.
"""

import os
import re
import zipfile
from collections import Counter
from collections.abc import Callable
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from jaxtyping import Float

from linkax.machines.draft import Draft, Pose
from linkax.machines.machine import Start
from linkax.machines.parts import Place
from linkax.machines.poses import exact, from_quaternion, pose, relative, to_quaternion, turned
from linkax.machines.xml import DEEPEST, MachineFileError, Where, below, library, read_file
from linkax.model.bodies import GROUND_NAME
from linkax.model.forces.affine_actuator import AffineActuator
from linkax.model.joints.cylindrical import Cylindrical
from linkax.model.joints.distance import Distance
from linkax.model.joints.fixed import Fixed
from linkax.model.joints.free import Free
from linkax.model.joints.planar import Planar
from linkax.model.joints.prismatic import Prismatic
from linkax.model.joints.rectangular import Rectangular
from linkax.model.joints.revolute import Revolute
from linkax.model.joints.spherical import Spherical
from linkax.model.joints.universal import Universal

SUFFIXES = (".usd", ".usda", ".usdc", ".usdz")
MODULES = ("Gf", "Sdf", "Tf", "Usd", "UsdGeom", "UsdPhysics")
KINDS = {
    "PhysicsRevoluteJoint": Revolute, "PhysicsPrismaticJoint": Prismatic, "PhysicsSphericalJoint": Spherical,
    "PhysicsFixedJoint": Fixed,
}  # fmt: skip
AXES = "XYZ"
EARTH = 9.81  # [m/s²], where a scene gives none
MOST_FILES = 1000  # that a stage is made of
OTHERS = ("physx", "newton", "mjc")  # beginnings of attributes of simulators, which USD Physics does not have
TOKEN = re.compile(  # of a text: strings, paths of files and comments, which may have brackets in them, and brackets
    rb'"""(?:\\.|[^\\])*?"""|"(?:\\.|[^"\\\n])*"'
    rb"|'''(?:\\.|[^\\])*?'''|'(?:\\.|[^'\\\n])*'"
    rb"|@@@.*?@@@|@[^@\n]*@|#[^\n]*|//[^\n]*|/\*.*?\*/|[{}()\[\]]",
    re.DOTALL,
)
DRAWN = 1e-6  # how far from zero a coordinate is drawn, at least, to make a start [rad or m]
NO_LIMIT = 1e30  # largest numbers of single precision stand for infinity
SHEAR = 1e-5  # of a scale, that is taken as rounding


def read_usd(draft: Draft) -> None:
    """Fill a draft from a USD file.

    **Raises:** `MachineFileError` for what USD does not read, with its message, for files outside of the folder, and
    without usd-core.
    """
    path = draft.path
    data = read_file(path)
    pxr = {name: library(f"pxr.{name}", path, "USD, which usd-core") for name in MODULES}
    with pxr["Tf"].DiagnosticTrap() as told:
        try:
            _check_files(pxr["Sdf"], path, draft)
            stage = pxr["Usd"].Stage.Open(str(path))
            if told.HasErrors() or told.HasWarnings():
                raise MachineFileError(f"{path.name}: USD warns: {_told([*told.GetErrors(), *told.GetWarnings()])}")
            _Stage(pxr, stage, draft, _lines(data)).read()
        except (pxr["Tf"].ErrorException, RuntimeError) as error:
            raise MachineFileError(f"{path.name}: USD does not read it: {_told([error])}") from error
        finally:
            told.Clear()


def _told(messages: list[Any]) -> str:
    """What USD says, without places in its own code."""
    texts = [" ".join(str(getattr(message, "commentary", message)).split()) for message in messages]
    found = [match[1] if (match := re.search(r" in file \S+ : '(.*)'", text)) else text for text in texts]
    return "; ".join(found)[:1000]


def _check_files(sdf: Any, path: Path, draft: Draft) -> None:
    """Check where all files lie that a stage is made of, before USD opens them.

    **Raises:** `MachineFileError` for one outside of the folder, one that is not there, no USD, or too large.
    """
    seen, open_ones = {path}, [path]
    while open_ones:
        file = open_ones.pop()
        fail = lambda message, file=file: MachineFileError(f"{file.name}: {message}")
        for layer, inside in _layers(sdf, file, fail):
            for named in _named(sdf, layer, fail):
                if inside is not None:
                    if str(inside[0] / named) not in inside[1]:
                        raise fail(f"{named[:200]!r} is not in the package; put it there")
                    continue
                below(file.parent, named, draft.folders, fail)
                found = Path(os.path.normpath(file.parent / named))  # USD does not resolve links on the way
                if found in seen:
                    continue
                if found.suffix.lower() not in SUFFIXES or not found.is_file() or len(seen) == MOST_FILES:
                    raise fail(
                        f"{named[:200]!r}, which it refers to, is not there, is no USD, or is one too many; take it out"
                    )
                read_file(found)
                seen.add(found)
                open_ones.append(found)


def _layers(sdf, file, fail):
    """The layers in a file; of a package also the folder of each in it, and all names in it."""
    if file.suffix.lower() != ".usdz":
        _check_depth(read_file(file), fail)
        yield sdf.Layer.FindOrOpen(str(file)), None
        return
    try:
        with zipfile.ZipFile(file) as package:
            members = [member for member in package.infolist() if member.filename.lower().endswith(SUFFIXES)]
            for member in members:
                if member.compress_type != zipfile.ZIP_STORED or member.filename.lower().endswith(".usdz"):
                    raise fail(f"{member.filename!r} is compressed, or a package in a package; take it out")
                _check_depth(package.read(member), fail)
            names = package.namelist()
    except (zipfile.BadZipFile, NotImplementedError, EOFError, RuntimeError) as error:
        raise MachineFileError(f"{file.name}: USD does not read it: no package, {error}") from error
    for member in members:
        layer = sdf.Layer.FindOrOpen(f"{file}[{member.filename}]")
        yield layer, (PurePosixPath(member.filename).parent, names)


def _check_depth(data: bytes, fail: Callable[[str], MachineFileError]) -> None:
    """Refuse a text with more brackets inside each other than USD's parser, which recurses, has room for."""
    depth = 0
    for match in TOKEN.finditer(data) if data.startswith(b"#usda") else ():
        depth += (match[0] in b"{([") - (match[0] in b"})]")
        if depth > DEEPEST:
            raise fail(f"more than {DEEPEST} prims or brackets inside each other; no machine has so many")


def _named(sdf, layer, fail):
    """The names of other files in a layer; clips, which name more, are refused."""
    if layer is None:
        raise fail("USD does not open it")

    def check(path):
        spec = layer.GetObjectAtPath(path)
        if isinstance(spec, sdf.PrimSpec) and spec.HasInfo("clips"):
            raise fail(f"{path} has value clips; take them out")

    layer.Traverse(sdf.Path.absoluteRootPath, check)
    return [name for name in layer.GetCompositionAssetDependencies() if name]


def _lines(data: bytes) -> dict[str, int]:
    """The line of each prim of a text, by its path; prims inside each other are indented."""
    found: dict[str, int] = {}
    if not data.startswith(b"#usda"):
        return found
    way: list[tuple[int, str]] = []
    for line, text in enumerate(data.decode(errors="replace").splitlines(), 1):
        if match := re.match(r'(\s*)(?:def|over|class)\b[^"(]*"(\w+)"', text):
            indent = len(match[1].expandtabs(4))
            while way and way[-1][0] >= indent:
                way.pop()
            way.append((indent, match[2]))
            found.setdefault("/" + "/".join(name for _, name in way), line)
    return found


class _Stage:
    """A stage that is read."""

    def __init__(self, pxr: Any, stage: Any, draft: Draft, lines: dict[str, int]) -> None:
        self.geometry, self.physics, self.gf = pxr["UsdGeom"], pxr["UsdPhysics"], pxr["Gf"]
        self.usd, self.stage, self.draft, self.lines = pxr["Usd"], stage, draft, lines
        self.time = self.usd.TimeCode.EarliestTime()
        self.placed = self.geometry.XformCache(self.time)
        self.length = self.geometry.GetStageMetersPerUnit(stage)
        self.mass = self.physics.GetStageKilogramsPerUnit(stage)
        if not (0.0 < self.length < np.inf and 0.0 < self.mass < np.inf):
            raise MachineFileError(f"{draft.path.name}: metersPerUnit and kilogramsPerUnit must be positive numbers")
        self.prims = list(stage.Traverse(self.usd.TraverseInstanceProxies()))
        names = Counter(prim.GetName() for prim in self.prims if self._moves(prim) or self._is_joint(prim))
        dotted = lambda prim: str(prim.GetPath())[1:].replace("/", ".")
        self.names = {
            prim.GetPath(): prim.GetName() if names[prim.GetName()] == 1 else dotted(prim) for prim in self.prims
        }

    def read(self) -> None:
        """Read gravity, bodies, then joints."""
        draft, default = self.draft, self.stage.GetDefaultPrim()
        draft.name = default.GetName() if default else ""
        gravity = self._gravity()
        for prim in self.prims:
            if self._moves(prim):
                self._body(prim, gravity)
            elif prim.HasAPI(self.physics.RigidBodyAPI) and self.geometry.Xformable(prim).TransformMightBeTimeVarying():
                draft.leave_out(self._where(prim), "kinematic", "a body that moves as drawn over time; it stands still")
            if prim.HasAPI(self.physics.CollisionAPI) and self._get(prim, "physics:collisionEnabled", True):
                draft.leave_out(self._where(prim), "contact", "contact of this shape with others")
        for prim in self.prims:
            if self._is_joint(prim):
                self._joint(prim)
        self._drawn()

    def _where(self, prim: Any) -> Where:
        path = str(prim.GetPath())
        return Where(self.draft.path, self.lines.get(path, 0), prim.GetTypeName() or "def", path)

    def _get(self, prim: Any, name: str, default: Any) -> Any:
        attribute = prim.GetAttribute(name)
        found = attribute.Get(self.time) if attribute else None
        return default if found is None else found

    def _number(self, prim: Any, name: str, default: float) -> float:
        return float(self._numbers(prim, name, default, ()))

    def _vector(self, prim: Any, name: str, default: Any = (0.0, 0.0, 0.0)) -> Float[np.ndarray, "3"]:
        return self._numbers(prim, name, default, (3,))

    def _numbers(self, prim: Any, name: str, default: Any, shape: tuple[int, ...]) -> Any:
        given = self._get(prim, name, default)
        try:
            found = np.array(given, dtype=float)
        except (TypeError, ValueError):
            found = np.array(np.nan)
        if found.shape != shape or np.any(np.isnan(found)):
            raise self._where(prim).error(f"{name} is {str(given)[:60]}; give {'3 numbers' if shape else 'a number'}")
        return found

    def _axis(self, prim: Any, name: str, default: str) -> int:
        axis = self._get(prim, name, default)
        if axis not in tuple(AXES):
            raise self._where(prim).error(f"{name} is {axis!r}; give one of X, Y, Z")
        return AXES.index(axis)

    def _rotation(self, prim: Any, name: str) -> Float[np.ndarray, "3 3"]:
        """The rotation of a quaternion; (0, 0, 0, 0) is the default of the schema for none."""
        found = self._get(prim, name, self.gf.Quatf(1.0))
        is_quaternion = isinstance(found, self.gf.Quatf | self.gf.Quatd | self.gf.Quath)
        numbers = np.array([found.GetReal(), *found.GetImaginary()] if is_quaternion else [np.nan])
        if not np.all(np.isfinite(numbers)):
            raise self._where(prim).error(f"{name} is {found}; it must be four finite numbers")
        return from_quaternion(numbers) if np.any(numbers) else np.eye(3)

    def _moves(self, prim: Any) -> bool:
        """Whether a prim is a body that forces move."""
        return (
            prim.HasAPI(self.physics.RigidBodyAPI)
            and bool(self._get(prim, "physics:rigidBodyEnabled", True))
            and not self._get(prim, "physics:kinematicEnabled", False)
        )

    def _is_joint(self, prim: Any) -> bool:
        return prim.IsA(self.physics.Joint)

    def _frame(self, prim: Any) -> tuple[Pose, Float[np.ndarray, "3 3"]]:
        """The pose of a prim in the world [m], and its scale, which maps its lengths to lengths in its frame."""
        matrix = np.array(self.placed.GetLocalToWorldTransform(prim)).T
        linear = matrix[:3, :3]
        if not np.all(np.isfinite(matrix)) or not np.linalg.det(linear) > 0.0:
            raise self._where(prim).error("its transform mirrors, is flat, or has a number that is not finite")
        left, _, right = np.linalg.svd(linear)
        rotation = exact(left @ right)
        return pose(matrix[:3, 3] * self.length, rotation), exact(rotation.T @ linear)

    def _gravity(self) -> Float[np.ndarray, "3"]:
        """Gravity [m/s²] of the first scene, or the earth's."""
        scenes = [prim for prim in self.prims if prim.IsA(self.physics.Scene)]
        for scene in scenes[1:]:
            self.draft.leave_out(self._where(scene), "scene", "a second scene; bodies move in the first one")
        up = -np.eye(3)[AXES.index(str(self.geometry.GetStageUpAxis(self.stage)).upper())]
        if not scenes:
            self.draft.gravity(EARTH * up, Where(self.draft.path, 0, "stage", ""))
            return EARTH * up
        magnitude = self._number(scenes[0], "physics:gravityMagnitude", -np.inf)
        direction = self._vector(scenes[0], "physics:gravityDirection")
        size = np.linalg.norm(direction)
        strength = EARTH if magnitude < 0.0 else magnitude * self.length
        acceleration = strength * (direction / size if size else up)
        if not np.all(np.isfinite(acceleration)):
            raise self._where(scenes[0]).error(f"gravity is {magnitude} along {direction}; give finite numbers")
        self.draft.gravity(acceleration, self._where(scenes[0]))
        return acceleration

    def _body(self, prim: Any, gravity: Float[np.ndarray, "3"]) -> None:
        draft, where, name = self.draft, self._where(prim), self.names[prim.GetPath()]
        at, scale = self._frame(prim)
        mass, center, moments, axes = self._inertia(prim, scale, where)
        draft.body(name, at, mass, center, turned(np.diag(moments), axes), where)
        if self._get(prim, "physxRigidBody:disableGravity", False):
            draft.carry(name, center, -mass * gravity, where)
        for attribute in ("physics:velocity", "physics:angularVelocity"):
            if np.any(self._vector(prim, attribute)):
                draft.leave_out(where, "velocity", f"{attribute} at the start; give it to linkax.assemble", False)
        self._others(prim, where)

    def _others(self, prim: Any, where: Where) -> None:
        """Note what other simulators add to USD Physics."""
        applied = prim.GetPrimTypeInfo().GetAppliedAPISchemas()
        for schema in applied:
            if "Mimic" in schema or "Tendon" in schema:
                self.draft.leave_out(where, "coupling", f"{schema}, which is not in USD Physics; take linkax.Coupling")
        named = [
            attribute.GetName()
            for attribute in prim.GetAuthoredAttributes()
            if attribute.GetName().startswith(OTHERS) and attribute.GetName() != "physxRigidBody:disableGravity"
        ]
        if named:
            reason = f"{', '.join(named[:3])}{', ...' * (len(named) > 3)}, which USD Physics does not have"
            self.draft.leave_out(where, "extension", reason, False)

    def _inertia(self, prim: Any, scale: Any, where: Where) -> tuple[float, Any, Any, Any]:
        """Mass, centre of mass, principal moments and axes, in SI units; from shapes what the file does not give."""
        mass = self._number(prim, "physics:mass", 0.0)
        center = self._vector(prim, "physics:centerOfMass", [-np.inf] * 3)
        moments = self._vector(prim, "physics:diagonalInertia")
        axes = self._rotation(prim, "physics:principalAxes")
        of_inertia = self.mass * self.length**2
        if mass > 0.0 and np.any(moments) and np.all(np.isfinite(center)):
            return mass * self.mass, scale @ center * self.length, moments * of_inertia, axes
        shapes, unknown = self._shapes(prim)
        if unknown or not shapes:
            what = f"has the shape {unknown[0].GetPath()}" if unknown else "has no shape"
            if not mass > 0.0 or not np.any(moments):
                reason = f"its mass or inertia is not given, and it {what}; it is taken as 1 kg and 1 kg m²"
                self.draft.leave_out(where, "inertia", reason)
            elif unknown:
                reason = f"its centre of mass is not given, and it {what}; it is taken at the origin"
                self.draft.leave_out(where, "inertia", reason)
            center = scale @ center * self.length if np.all(np.isfinite(center)) else np.zeros(3)
            mass = mass * self.mass if mass > 0.0 else 1.0
            return mass, center, moments * of_inertia if np.any(moments) else np.ones(3), axes
        found = self.physics.RigidBodyAPI(prim).ComputeMassProperties(lambda shape: shapes[shape.GetPath()])
        quaternion = np.array([found[3].GetReal(), *found[3].GetImaginary()])
        mass = mass if mass > 0.0 else float(found[0])
        center = scale @ center if np.all(np.isfinite(center)) else np.array(found[2], dtype=float)
        if not np.any(moments):
            moments, axes = np.array(found[1], dtype=float), from_quaternion(quaternion)
        return mass * self.mass, center * self.length, moments * of_inertia, axes

    def _shapes(self, body: Any) -> tuple[dict[Any, Any], list[Any]]:
        """Volume and inertia of the shapes of a body, in units of the stage, and the shapes that are not simple."""
        found: dict[Any, Any] = {}
        unknown = []
        whole = iter(self.usd.PrimRange(body, self.usd.TraverseInstanceProxies()))
        for prim in whole:
            if prim != body and prim.HasAPI(self.physics.RigidBodyAPI):
                whole.PruneChildren()
            elif prim.HasAPI(self.physics.CollisionAPI):
                shape = self._shape(prim, body)
                if shape is None:
                    unknown.append(prim)
                else:
                    found[prim.GetPath()] = shape
        return found, unknown

    def _shape(self, prim: Any, body: Any) -> Any:
        """Volume, and inertia at density one, of a box, ball, cylinder or capsule; None for another."""
        at, scale = self._frame(prim)
        factors = np.diag(scale)
        sheared = np.abs(scale - np.diag(factors)).max() > SHEAR * factors.max()
        kind = prim.GetTypeName()
        round_ones = ("Sphere", "Cylinder", "Capsule")
        if sheared or kind not in ("Cube", *round_ones):
            return None
        if kind in round_ones and np.ptp(factors) > SHEAR * factors.max():
            return None
        if kind == "Cube":
            sides = self._number(prim, "size", 2.0) * factors
            volume = float(np.prod(sides))
            moments = volume / 12.0 * (np.sum(sides**2) - sides**2)
        else:
            radius = self._number(prim, "radius", 1.0) * factors[0]
            height = self._number(prim, "height", 2.0) * factors[0]
            along = self._axis(prim, "axis", "Z")
            volume, moments = _round(kind, radius, height, along)
        seen = relative(at, self._frame(body)[0])
        information = self.physics.RigidBodyAPI.MassInformation()
        information.volume, information.centerOfMass = volume, self.gf.Vec3f(0.0)
        information.inertia = self.gf.Matrix3f(self.gf.Vec3f(*moments.tolist()))
        information.localPos = self.gf.Vec3f(*(seen[:3, 3] / self.length).tolist())
        information.localRot = self.gf.Quatf(*to_quaternion(seen[:3, :3]).tolist())
        return information

    def _place(self, prim: Any, end: str) -> Place:
        """Where a joint attaches at one end: on the body that holds a prim, or on the ground."""
        position, rotation = (
            self._vector(prim, f"physics:localPos{end}"),
            self._rotation(prim, f"physics:localRot{end}"),
        )
        if not np.all(np.isfinite(position)):
            raise self._where(prim).error(f"localPos{end} is {position}; give finite numbers")
        targets = prim.GetRelationship(f"physics:body{end}").GetTargets()
        if len(targets) > 1:
            raise self._where(prim).error(f"body{end} names {len(targets)} prims; name one")
        if not targets:
            return Place(GROUND_NAME, position * self.length, rotation)
        target = self.stage.GetPrimAtPath(targets[0])
        if not target:
            raise self._where(prim).error(f"body{end} is {targets[0]}, which is not in the file; name a body")
        if not self.geometry.Xformable(target):
            raise self._where(prim).error(f"body{end} is {targets[0]}, which is no body and has no place; name a body")
        at, scale = self._frame(target)
        on_target = pose(scale @ position * self.length, rotation)
        body = target
        while body and not self._moves(body) and not body.HasAPI(self.physics.RigidBodyAPI):
            body = body.GetParent()
        if not body or not self._moves(body):
            return Place.at(GROUND_NAME, at @ on_target)
        if body == target:
            return Place.at(self.names[body.GetPath()], on_target)
        return Place.at(self.names[body.GetPath()], relative(at @ on_target, self._frame(body)[0]))

    def _joint(self, prim: Any) -> None:
        draft, where, name = self.draft, self._where(prim), self.names[prim.GetPath()]
        if not self._get(prim, "physics:jointEnabled", True):
            draft.leave_out(where, "joint", "it is not enabled", False)
            return
        parent, child = self._place(prim, "0"), self._place(prim, "1")
        if parent.body == child.body:
            if parent.body != GROUND_NAME:
                raise where.error(f"both ends are on {parent.body!r}; name two bodies")
            draft.leave_out(where, "joint", "both ends stand still", False)
            return
        for attribute in ("physics:breakForce", "physics:breakTorque"):
            if self._number(prim, attribute, np.inf) < NO_LIMIT:
                draft.leave_out(where, "break", f"it breaks at its {attribute}")
        self._others(prim, where)
        if prim.GetTypeName() == "PhysicsDistanceJoint":
            least, most = (self._number(prim, f"physics:{end}Distance", -1.0) for end in ("min", "max"))
            if least == most > 0.0:
                draft.joint_at(Distance, name, parent, child, where, length=most * self.length)
            else:
                draft.leave_out(where, "joint", f"a distance between {least:g} and {most:g}; linkax has fixed ones")
            return
        kind, axes, along = self._kind(prim)
        if kind is None:
            draft.leave_out(where, "joint", f"no joint of linkax moves along {', '.join(along) or 'these axes'} alone")
            return
        arguments: dict[str, Any] = {}
        if axes is not None:
            parent, child = (Place(end.body, end.offset, exact(end.rotation @ axes)) for end in (parent, child))
            arguments["axis"] = "x"
        if kind is Universal:
            arguments["second_axis"] = "y"
        draft.joint_at(kind, name, parent, child, where, **arguments)
        for token, index in along.items():
            self._along(prim, token, name if len(kind.speed_units) == 1 else (name, index), name, where)
        if kind is Spherical and "Spherical" in prim.GetTypeName():
            cones = [self._number(prim, f"physics:coneAngle{end}Limit", -1.0) for end in "01"]
            if any(0.0 <= cone < np.inf for cone in cones):
                draft.leave_out(where, "limit", f"the cone of {cones} degrees that it stays in")

    def _kind(self, prim: Any) -> tuple[Any, Any, dict[str, int]]:
        """The class of a joint, its h¹, h² and h³ in the frame of the file, and its coordinates by USD's names."""
        if prim.GetTypeName() in KINDS:
            kind = KINDS[prim.GetTypeName()]
            if kind in (Revolute, Prismatic):
                return (
                    kind,
                    _cyclic(self._axis(prim, "physics:axis", "X")),
                    {"angular" if kind is Revolute else "linear": 0},
                )
            return kind, None, {}
        free = {way: [axis for axis in range(3) if not self._locks(prim, way + AXES[axis])] for way in ("trans", "rot")}
        slides, turns = free["trans"], free["rot"]
        match slides, turns:
            case [], []:
                return Fixed, None, {}
            case [], [axis]:
                return Revolute, _cyclic(axis), {f"rot{AXES[axis]}": 0}
            case [], [first, second]:
                axes = np.eye(3)[[first, second]]
                names = {f"rot{AXES[first]}": 0, f"rot{AXES[second]}": 1}
                return Universal, np.column_stack([*axes, np.cross(*axes)]), names
            case [], _:
                return Spherical, None, {f"rot{axis}": index for index, axis in enumerate(AXES)}
            case [axis], []:
                return Prismatic, _cyclic(axis), {f"trans{AXES[axis]}": 0}
            case [axis], [other] if axis == other:
                return Cylindrical, _cyclic(axis), {f"rot{AXES[axis]}": 0, f"trans{AXES[axis]}": 1}
            case [_, _], [] | [_]:
                (across,) = {0, 1, 2} - set(slides)
                second, third = (f"trans{AXES[(across + step) % 3]}" for step in (1, 2))
                if not turns:
                    return Rectangular, _cyclic(across), {second: 0, third: 1}
                if turns == [across]:
                    return Planar, _cyclic(across), {f"rot{AXES[across]}": 0, second: 1, third: 2}
            case [_, _, _], [_, _, _]:
                names = [way + axis for way in ("rot", "trans") for axis in AXES]
                return Free, None, {name: index for index, name in enumerate(names)}
        return None, None, {way + AXES[axis]: 0 for way, axes in free.items() for axis in axes}

    def _ends(self, prim: Any, token: str) -> tuple[float, float]:
        """The ends of a range, [degrees or units of the stage]."""
        names = ("physics:lowerLimit", "physics:upperLimit")
        if token not in ("angular", "linear"):
            names = (f"limit:{token}:physics:low", f"limit:{token}:physics:high")
        ends = np.array([self._number(prim, names[0], -np.inf), self._number(prim, names[1], np.inf)])
        lower, upper = np.where(np.abs(ends) < NO_LIMIT, ends, np.copysign(np.inf, ends)).tolist()
        return lower, upper

    def _locks(self, prim: Any, token: str) -> bool:
        lower, upper = self._ends(prim, token)
        return lower > upper or lower == upper == 0.0

    def _along(self, prim: Any, token: str, along: Any, name: str, where: Where) -> None:
        """Stops and a drive along a coordinate."""
        draft, turns = self.draft, token.startswith(("rot", "angular"))
        unit = np.pi / 180.0 if turns else self.length
        lower, upper = self._ends(prim, token)
        part = name if token in ("angular", "linear") else f"{name}.{token}"
        has_law = isinstance(along, str) or not self._is_ball(along[0]) or not turns
        whole_ball = not has_law and lower <= -180.0 and upper >= 180.0
        if not whole_ball and (np.isfinite(lower) or np.isfinite(upper)):
            if not has_law or lower >= upper:
                draft.leave_out(where, "limit", f"its range {token} from {lower:g} to {upper:g}")
            else:
                ends = (float(end * unit) if np.isfinite(end) else None for end in (lower, upper))
                draft.limit(along, part, where, *ends)
        drive = lambda what, default: self._number(prim, f"drive:{token}:physics:{what}", default)
        stiffness, damping, most = drive("stiffness", 0.0), drive("damping", 0.0), drive("maxForce", np.inf)
        if not (stiffness or damping) or draft.ignores("actuator", where, "the drive"):
            return
        if not has_law or self._get(prim, f"drive:{token}:physics:type", "force") != "force":
            draft.leave_out(where, "actuator", f"its drive {token} on a ball, or that gives an acceleration")
            return
        newton = self.mass * self.length * (self.length if turns else 1.0)
        target, speed = drive("targetPosition", 0.0) * unit, drive("targetVelocity", 0.0) * unit
        stiffness, damping = stiffness * newton / unit, damping * newton / unit
        servo = {"control": target, "gain": stiffness, "bias": np.array([damping * speed, -stiffness, -damping])}
        if not stiffness:
            servo = {"control": speed, "gain": damping, "bias": np.array([0.0, 0.0, -damping])}
        if most < NO_LIMIT:
            servo["force_range"] = np.array([-most, most]) * newton
        draft.force(AffineActuator, f"{part}.drive", where, transmission={along: 1.0}, **servo)

    def _is_ball(self, name: str) -> bool:
        return any(joint.name == name and joint.kind.has_quaternion for joint in self.draft.joints)

    def _drawn(self) -> None:
        """A start where the file draws the bodies, as far as joints are not at zero there."""
        positions = {}
        for joint in self.draft.joints:
            ends = (joint.arguments["parent"], joint.arguments["child"])
            first, second = (self.draft.poses[end.body] @ pose(end.offset, end.rotation) for end in ends)
            seen = relative(second, first)
            if joint.kind.speed_units:
                positions[joint.name] = np.asarray(joint.kind.measure(seen[:3, :3], seen[:3, 3]), dtype=float)
                zero = [1.0, 0.0, 0.0, 0.0] if joint.kind.has_quaternion else []
                zero = np.array(zero + [0.0] * (positions[joint.name].size - len(zero)))
                if np.abs(positions[joint.name] - zero).max() < DRAWN:
                    positions[joint.name] = zero
                elif "drawn" not in self.draft.starts:
                    self.draft.starts["drawn"] = Start(positions, {})


def _cyclic(axis: int) -> Float[np.ndarray, "3 3"]:
    """Axes that begin with one of x, y and z, as columns."""
    return np.eye(3)[:, [axis, (axis + 1) % 3, (axis + 2) % 3]]


def _round(kind: str, radius: float, height: float, along: int) -> tuple[float, Float[np.ndarray, "3"]]:
    """Volume and principal moments at density one of a ball, a cylinder, or a capsule with caps beyond its height."""
    ball, cylinder = 4.0 / 3.0 * np.pi * radius**3, np.pi * radius**2 * height
    if kind == "Sphere":
        return float(ball), np.full(3, 0.4 * ball * radius**2)
    axial, across = cylinder * radius**2 / 2.0, cylinder * (radius**2 / 4.0 + height**2 / 12.0)
    if kind == "Capsule":
        axial += 0.4 * ball * radius**2
        across += ball * (0.4 * radius**2 + height**2 / 4.0 + 0.375 * height * radius)
        cylinder += ball
    moments = np.full(3, across)
    moments[along] = axial
    return float(cylinder), moments
