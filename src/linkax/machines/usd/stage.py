"""The stage that is read, in SI units: values of its prims, checked, and their names, lines and poses.

Units of the stage become kg, m and rad; scale goes into lengths. Attributes are read at the earliest time.
"""

import re
from collections import Counter
from typing import Any

import numpy as np
from jaxtyping import Float

from linkax.machines.draft import Draft, Pose, body_name
from linkax.machines.poses import exact, from_quaternion, pose
from linkax.machines.xml import MachineFileError, Where
from linkax.model.names import meant

AXES = "XYZ"
OTHERS = ("physx", "newton", "mjc")  # beginnings of attributes of simulators, which USD Physics does not have


class Stage:
    """A stage that is read into a draft.

    - `usd_stage`: what USD has opened. `usd`, `geometry`, `physics`, `gf`: its modules.
    - `prims`: all prims, those of instances, too. `names`: what each becomes by its path, unique.
    - `length` [m], `mass` [kg]: units of the stage.

    What is asked of a prim raises `MachineFileError` with its line, where the file has another thing there.
    """

    def __init__(self, pxr: Any, usd_stage: Any, draft: Draft, lines: dict[str, int]) -> None:
        self.geometry, self.physics, self.gf = pxr["UsdGeom"], pxr["UsdPhysics"], pxr["Gf"]
        self.usd, self.usd_stage, self.draft, self.lines = pxr["Usd"], usd_stage, draft, lines
        self.time = self.usd.TimeCode.EarliestTime()
        self.placed = self.geometry.XformCache(self.time)
        self.length = self.geometry.GetStageMetersPerUnit(usd_stage)
        self.mass = self.physics.GetStageKilogramsPerUnit(usd_stage)
        if not (0.0 < self.length < np.inf and 0.0 < self.mass < np.inf):
            raise MachineFileError(f"{draft.path.name}: metersPerUnit and kilogramsPerUnit must be positive numbers")
        self.prims = list(usd_stage.Traverse(self.usd.TraverseInstanceProxies()))
        names = Counter(prim.GetName() for prim in self.prims if self.moves(prim) or self.is_joint(prim))
        dotted = lambda prim: str(prim.GetPath())[1:].replace("/", ".")
        unique = lambda prim: prim.GetName() if names[prim.GetName()] == 1 else dotted(prim)
        self.names = {
            prim.GetPath(): body_name(unique(prim)) if self.moves(prim) else unique(prim) for prim in self.prims
        }

    def where(self, prim: Any) -> Where:
        """The place of a prim in the file."""
        path = str(prim.GetPath())
        return Where(self.draft.path, self.lines.get(path, 0), prim.GetTypeName() or "def", path)

    def get(self, prim: Any, name: str, default: Any) -> Any:
        """The value of an attribute."""
        attribute = prim.GetAttribute(name)
        found = attribute.Get(self.time) if attribute else None
        return default if found is None else found

    def number(self, prim: Any, name: str, default: float) -> float:
        """The number in an attribute, which may be infinite."""
        return float(self._numbers(prim, name, default, ()))

    def vector(self, prim: Any, name: str, default: Any = (0.0, 0.0, 0.0)) -> Float[np.ndarray, "3"]:
        """Three numbers in an attribute, which may be infinite."""
        return self._numbers(prim, name, default, (3,))

    def _numbers(self, prim: Any, name: str, default: Any, shape: tuple[int, ...]) -> Any:
        given = self.get(prim, name, default)
        try:
            found = np.array(given, dtype=float)
        except (TypeError, ValueError):
            found = np.array(np.nan)
        if found.shape != shape or np.any(np.isnan(found)):
            raise self.where(prim).error(f"{name} is {str(given)[:60]}; give {'3 numbers' if shape else 'a number'}")
        return found

    def axis(self, prim: Any, name: str, default: str) -> int:
        """The index of one of X, Y and Z."""
        axis = self.get(prim, name, default)
        if axis not in tuple(AXES):
            raise self.where(prim).error(f"{name} is {axis!r}; give one of X, Y, Z")
        return AXES.index(axis)

    def rotation(self, prim: Any, name: str) -> Float[np.ndarray, "3 3"]:
        """The rotation of a quaternion; (0, 0, 0, 0) is the default of the schema for none."""
        found = self.get(prim, name, self.gf.Quatf(1.0))
        is_quaternion = isinstance(found, self.gf.Quatf | self.gf.Quatd | self.gf.Quath)
        numbers = np.array([found.GetReal(), *found.GetImaginary()] if is_quaternion else [np.nan])
        if not np.all(np.isfinite(numbers)):
            raise self.where(prim).error(f"{name} is {found}; it must be four finite numbers")
        return from_quaternion(numbers) if np.any(numbers) else np.eye(3)

    def moves(self, prim: Any) -> bool:
        """Whether a prim is a body that forces move."""
        return (
            prim.HasAPI(self.physics.RigidBodyAPI)
            and bool(self.get(prim, "physics:rigidBodyEnabled", True))
            and not self.get(prim, "physics:kinematicEnabled", False)
        )

    def is_joint(self, prim: Any) -> bool:
        """Whether a prim is a joint of any type."""
        return prim.IsA(self.physics.Joint)

    def frame(self, prim: Any) -> tuple[Pose, Float[np.ndarray, "3 3"]]:
        """The pose of a prim in the world [m], and its scale, which maps its lengths to lengths in its frame."""
        matrix = np.array(self.placed.GetLocalToWorldTransform(prim)).T
        linear = matrix[:3, :3]
        if not np.all(np.isfinite(matrix)) or not np.linalg.det(linear) > 0.0:
            raise self.where(prim).error("its transform mirrors, is flat, or has a number that is not finite")
        left, _, right = np.linalg.svd(linear)
        rotation = exact(left @ right)
        return pose(matrix[:3, 3] * self.length, rotation), exact(rotation.T @ linear)

    def note_extensions(self, prim: Any, where: Where) -> None:
        """Note what other simulators add to USD Physics, and attributes that it does not know."""
        for schema in prim.GetPrimTypeInfo().GetAppliedAPISchemas():
            if "Mimic" in schema or "Tendon" in schema:
                self.draft.leave_out(where, "coupling", f"{schema}, which is not in USD Physics; take linkax.Coupling")
        named = [
            attribute.GetName()
            for attribute in prim.GetAuthoredAttributes()
            if attribute.GetName().startswith(OTHERS) and attribute.GetName() != "physxRigidBody:disableGravity"
        ]
        known = set(prim.GetPrimDefinition().GetPropertyNames())
        given = [attribute.GetName() for attribute in prim.GetAuthoredPropertiesInNamespace("physics")]
        for name in given:
            if name not in known:
                reason = f"{name} is not in USD Physics{meant(name, known - set(given))}"
                self.draft.leave_out(where, "extension", reason, False)
        if named:
            reason = f"{', '.join(named[:3])}{', ...' * (len(named) > 3)}, which USD Physics does not have"
            self.draft.leave_out(where, "extension", reason, False)


def prim_lines(data: bytes) -> dict[str, int]:
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
