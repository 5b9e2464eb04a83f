"""Write a motion as an animation in USD, for programs that show it: Blender, usdview, Omniverse.

What the schemas mean: https://openusd.org/release/api/usd_geom_page_front.html. All solids are meshes with a material,
since Blender gives no colour to the spheres and cylinders of USD.
"""

import itertools
import os
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from jaxtyping import Float

from linkax.files import written_whole
from linkax.model.joints.bending import OnBeam
from linkax.model.joints.joint import AbstractJoint
from linkax.model.numbers import Number, positive, require_type
from linkax.model.shapes import Shape
from linkax.optional import needed
from linkax.scenery.camera import upwards
from linkax.scenery.colours import body_colour
from linkax.scenery.scenery import Scenery, Span, is_slide, moving_frame, scenery_of, spans
from linkax.simulation.read.kinematics import Kinematics
from linkax.view.contents import parts_of, quaternions, span_colour, symbol_of
from linkax.view.meshes import Mesh
from linkax.view.solids import shapes_of
from linkax.view.triangles import hull, mesh_of, normals_of, rod

SUFFIXES = (".usda", ".usdc", ".usd")
MODULES = ("Gf", "Sdf", "Tf", "Usd", "UsdGeom", "UsdShade")
CODES_PER_SECOND = 24.0  # which programs take that do not ask the file
ROOT = "mechanism"
ROUGHNESS = 0.6
SYMBOL = 0.025  # size of a symbol, relative to all that is drawn
PALE = "#f4f4f4"  # of joints that do not slide
# Solids of joints: shape, its size in symbols, and the axis of the joint, from 0, that is the shape's third one.
JOINTS = {
    "hinge": (("cylinder", (0.75, 2.4), 0),), "sleeve": (("cylinder", (1.1, 3.0), 0),),
    "cross": (("cylinder", (0.4, 2.6), 0), ("cylinder", (0.4, 2.6), 1)), "ball": (("sphere", (0.9,), 0),),
    "box": (("box", (2.0, 2.0, 3.2), 0),), "weld": (("box", (1.2, 1.2, 1.2), 0),),
    "plate": (("box", (3.0, 3.0, 0.3), 0),),
}  # fmt: skip
WIDTHS = {"rope": 0.3, "rod": 0.6, "spring": 0.5, "damper": 0.7, "beam": 1.0}  # in symbols


def to_usd(solution: Kinematics, path: str | os.PathLike[str], *, speed: Number = 1.0) -> None:
    """Write a motion as an animation in USD, which Blender, usdview and Omniverse play.

    ```python
    lx.to_usd(solution, "motion.usdc")
    lx.to_usd(solution.at(jnp.linspace(0.0, 0.2, 500)), "slow.usda", speed=0.1)
    ```

    Each body is an Xform with its name, at `solution.poses()` at the saved times, in double precision; players
    interpolate between these. Below it are its shapes, or what `Solution.view` draws of bodies without any, with the
    symbols of their joints. Springs, dampers, ropes, massless rods and beams are curves. The file has the motion alone,
    and no physics that `linkax.load` could read.

    Lengths are in metres, in the ground's axes. USD knows y or z as upwards: it is the one nearer to the direction
    against gravity, z where there is none. Time codes are 24 a second. A name that USD does not allow is changed to one
    that it does, and is the prim's display name.

    **Arguments:**

    - `solution`: a `linkax.Solution`, or another motion.
    - `path`: with the suffix `.usdc` (small), `.usda` (text) or `.usd`. The file is written whole, or not at all, by
      usd-core: `pip install "linkax[files]"`.
    - `speed`: seconds of the motion in one of the animation; 0.1 is slow motion.

    **Raises:** `ValueError` for another suffix, a folder that cannot be written to, a `speed` that is not positive, the
    solution of a batch, and without usd-core. A warning tells which meshes cannot be read.
    """
    path = Path(path)
    if path.suffix not in SUFFIXES:
        raise ValueError(f"{str(path)!r} has suffix {path.suffix!r}; known: {', '.join(SUFFIXES)}")
    require_type(solution, Kinematics, "solution", "give a linkax.Solution")
    rate = CODES_PER_SECOND / float(positive(speed, "speed"))
    need = f"{path.name} is USD, which usd-core writes"
    pxr = SimpleNamespace(**{name: needed(f"pxr.{name}", need, "files", ValueError) for name in MODULES})
    stage = _Writer(pxr, scenery_of(solution, {}), rate).stage
    try:
        with written_whole(path) as unfinished:
            unfinished.touch()  # USD would make the folder
            stage.GetRootLayer().Export(str(unfinished))
    except (OSError, pxr.Tf.ErrorException) as error:
        reason = getattr(error, "strerror", None) or " ".join(str(error).split())[:300]
        raise ValueError(f"cannot write {str(path)!r}: {reason}; give another path") from error


class _Writer:
    """Builds the stage.

    - `codes`: time codes of the saved times.
    - `symbol`: size of a symbol [m].
    - `materials`: by colour and opacity.
    - `joints`: those whose symbol a body carries, by its name.
    """

    def __init__(self, pxr: Any, scenery: Scenery, rate: float) -> None:
        self.pxr, self.scenery, mechanism = pxr, scenery, scenery.mechanism
        self.stage = pxr.Usd.Stage.CreateInMemory()
        self.codes = (scenery.times * rate).tolist()
        self.symbol = SYMBOL * (float(np.ptp(scenery.space, axis=0).max()) or 1.0)
        self.stage.SetTimeCodesPerSecond(CODES_PER_SECOND)
        self.stage.SetFramesPerSecond(CODES_PER_SECOND)
        self.stage.SetStartTimeCode(self.codes[0])
        self.stage.SetEndTimeCode(self.codes[-1])
        up = upwards(mechanism)
        pxr.UsdGeom.SetStageUpAxis(self.stage, "Y" if up[1] > up[2] else "Z")
        pxr.UsdGeom.SetStageMetersPerUnit(self.stage, 1.0)
        self.root = self._define("Xform", self.stage.GetPseudoRoot(), ROOT)
        self.stage.SetDefaultPrim(self.root.GetPrim())
        self.looks, self.materials = self._define("Scope", self.root, "materials"), dict[Any, Any]()
        self.shapes, self.meshes = shapes_of(mechanism)
        self.joints = defaultdict[str, list[AbstractJoint]](list)
        for joint in mechanism.joints:
            if not isinstance(joint, OnBeam):
                self.joints[moving_frame(joint).body].append(joint)
        for index, name in enumerate(mechanism.topology.bodies):
            self._body(name, body_colour(index))
        for index, span in enumerate(spans(mechanism)):
            self._span(span, _rgb(span_colour(span, index)))

    def _define(self, schema: str, parent: Any, name: str) -> Any:
        """A new prim, with a name that USD allows."""
        path = self._free(parent, name)
        made = getattr(self.pxr.UsdGeom, schema).Define(self.stage, path)
        if path.name != name:
            made.GetPrim().SetDisplayName(name)
        return made

    def _free(self, parent: Any, name: str) -> Any:
        """A path that is free, with a name as near to another as USD allows."""
        stem = self.pxr.Tf.MakeValidIdentifier(name)
        names = itertools.chain([stem], (f"{stem}_{number}" for number in itertools.count(2)))
        paths = map(parent.GetPath().AppendChild, names)
        return next(path for path in paths if not self.stage.GetPrimAtPath(path))

    def _body(self, name: str, colour: str) -> None:
        """The moving frame of a body, and what it is drawn as."""
        made, gf, (origins, axes) = self._define("Xform", self.root, name), self.pxr.Gf, self.scenery.poses[name]
        place = made.AddTranslateOp(self.pxr.UsdGeom.XformOp.PrecisionDouble)
        turn = made.AddOrientOp(self.pxr.UsdGeom.XformOp.PrecisionDouble)
        moving = zip(self.codes, origins.tolist(), quaternions(axes).tolist(), strict=True)
        for code, origin, (x, y, z, w) in moving:
            place.Set(gf.Vec3d(*origin), code)
            turn.Set(gf.Quatd(w, x, y, z), code)
        for shape in self.shapes.get(name, ()):
            *own, opacity = shape.colour or (*_rgb(colour), 1.0)
            self._mesh(made, shape.kind, mesh_of(shape, self.meshes), np.array(own), opacity)
        if self.shapes.get(name):
            return
        for part in parts_of(self.scenery, name):
            for mesh, opacity in _meshes_of(part, self.symbol):
                self._mesh(made, part["kind"], mesh, _rgb(colour), opacity)
        for joint in self.joints[name]:
            self._symbol(made, joint, _rgb(colour if is_slide(joint) else PALE))

    def _symbol(self, on: Any, joint: AbstractJoint, colour: Float[np.ndarray, "3"]) -> None:
        kind, at, axes = symbol_of(joint)
        for form, size, axis in JOINTS[kind] if kind else ():
            shape = Shape(form, np.multiply(size, self.symbol), at.offset, np.roll(axes, -1 - axis, axis=1))
            self._mesh(on, joint.name, mesh_of(shape), colour, 1.0)

    def _mesh(self, on: Any, name: str, mesh: Mesh, colour: Float[np.ndarray, "3"], opacity: float) -> None:
        made = self._define("Mesh", on, name)
        made.CreatePointsAttr(mesh.points)
        made.CreateFaceVertexCountsAttr([3] * len(mesh.triangles))
        made.CreateFaceVertexIndicesAttr(mesh.triangles.reshape(-1).tolist())
        made.CreateNormalsAttr(normals_of(mesh))
        made.SetNormalsInterpolation("uniform")  # plane triangles, which Blender would make round
        made.CreateSubdivisionSchemeAttr("none")
        made.CreateDoubleSidedAttr(True)
        self._paint(made, colour, opacity)

    def _span(self, span: Span, colour: Float[np.ndarray, "3"]) -> None:
        """A curve through points of bodies."""
        made = self._define("BasisCurves", self.root, span.label.partition(":")[0])
        made.CreateTypeAttr("linear")
        made.CreateCurveVertexCountsAttr([len(span.points)])
        made.CreateWidthsAttr([WIDTHS[span.kind] * self.symbol])
        made.SetWidthsInterpolation("constant")
        points = made.CreatePointsAttr()
        along = np.stack([self.scenery.placed(point) for point in span.points], axis=1)
        for code, places in zip(self.codes, along, strict=True):
            points.Set(places, code)
        self._paint(made, colour, 1.0)

    def _paint(self, made: Any, colour: Float[np.ndarray, "3"], opacity: float) -> None:
        """Give a material, with a colour as screens have it (sRGB), which USD wants in linear light."""
        linear = np.where(colour <= 0.04045, colour / 12.92, ((colour + 0.055) / 1.055) ** 2.4)
        look = (*linear.tolist(), float(opacity))
        if look not in self.materials:
            self.materials[look] = self._material(self.pxr.Gf.Vec3f(*look[:3]), look[3])
        self.pxr.UsdShade.MaterialBindingAPI.Apply(made.GetPrim()).Bind(self.materials[look])

    def _material(self, colour: Any, opacity: float) -> Any:
        shade, types = self.pxr.UsdShade, self.pxr.Sdf.ValueTypeNames
        material = shade.Material.Define(self.stage, self._free(self.looks, "material"))
        surface = shade.Shader.Define(self.stage, material.GetPath().AppendChild("surface"))
        surface.CreateIdAttr("UsdPreviewSurface")
        surface.CreateInput("diffuseColor", types.Color3f).Set(colour)
        surface.CreateInput("opacity", types.Float).Set(opacity)
        surface.CreateInput("roughness", types.Float).Set(ROUGHNESS)
        material.CreateSurfaceOutput().ConnectToSource(surface.ConnectableAPI(), "surface")
        return material


def _rgb(colour: str) -> Float[np.ndarray, "3"]:
    """The numbers, from 0 to 1, in #rrggbb."""
    return np.frombuffer(bytes.fromhex(colour[1:]), np.uint8) / 255.0


def _meshes_of(part: dict[str, Any], symbol: float) -> Iterator[tuple[Mesh, float]]:
    """What a body without shapes is drawn by, as in `viewer.js`: meshes and their opacity."""
    kind, corners = part["kind"], np.array(part.get("corners", part.get("ends", [])))
    if kind == "ball":
        yield mesh_of(Shape("sphere", 1.2 * symbol, part["centre"])), 1.0
    elif kind == "rod":
        yield rod(corners[0], corners[1], 0.5 * symbol), 1.0
    elif kind == "plate":
        for begin, end in zip(corners, np.roll(corners, -1, axis=0), strict=True):
            yield rod(begin, end, 0.4 * symbol), 1.0
        yield Mesh(corners, np.array([(0, index, index + 1) for index in range(1, len(corners) - 1)])), 0.35
    elif kind == "hull":
        yield hull(corners), 0.6
    else:
        half, axes = np.maximum(part["half"], 1e-3 * symbol), np.array(part["axes"]).T
        yield mesh_of(Shape(kind, 2.0 * half if kind == "box" else half, part["centre"], axes)), 0.6
