"""Machines from USD Physics: units, joints, drives, mass from shapes, and files that are refused."""

import importlib
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from beside_mujoco import check_loops, tree_dynamics

import linkax as lx

MODULES: list[Any] = [
    importlib.import_module(f"pxr.{name}") for name in ("Gf", "Usd", "UsdGeom", "UsdPhysics", "UsdUtils")
]
Gf, Usd, UsdGeom, UsdPhysics, UsdUtils = MODULES
FOUR_BAR = Path(__file__).parents[1] / "data" / "machines" / "boxes_fourbar.usda"
pytestmark = pytest.mark.filterwarnings("ignore::linkax.LeftOutWarning")


def by_hand():
    """The four-bar of the file, from its drawing."""
    half = 0.0560000017285347
    long, short = 0.0008416666532866657, 1.6666666851961054e-05
    flat, upright = np.diag([short, long, long]), np.diag([long, long, short])
    bars = [
        lx.RigidBody(f"body_{count}", mass=1.0, center_of_mass=(0.0, 0.0, 0.0), inertia=inertia)
        for count, inertia in enumerate((flat, upright, flat, upright), 1)
    ]
    top = 0.056000005453825
    ends = (
        ((half, 0.0, 0.0), (0.0, 0.0, -half)), ((0.0, 0.0, top), (half, 0.0, 0.0)),
        ((-half, 0.0, 0.0), (0.0, 0.0, top)), ((0.0, 0.0, -half), (-half, 0.0, 0.0)),
    )  # fmt: skip
    joints: list[Any] = [lx.Free("body_1.free", lx.GROUND.at((0.0, 0.0, 0.004999999888241291)), bars[0])]
    for count, (first, second) in enumerate(ends):
        pair = bars[count].at(first), bars[(count + 1) % 4].at(second)
        joints.append(lx.Revolute(f"joint_{count + 1}", *pair, axis="y"))
    return lx.Mechanism(bars, joints, [lx.Gravity((0.0, 0.0, -float(np.float32(9.8067))))])


@pytest.mark.slow
def test_a_floating_four_bar_is_what_it_is_by_hand():
    machine = lx.load(FOUR_BAR, ignore=["contact", "limit"])
    assert {body.where.line for body in machine.bodies} == {21, 55, 89, 123}
    read, made = machine.mechanism(), by_hand()
    speeds = {"body_1.free": [0.1, 0.3, -0.2, 0.2, 0.5, 0.4], "joint_1": 1.3}
    state = lx.assemble(read, {"joint_1": 0.3}, speeds)
    check_loops(read, (1, 7, 3), state)
    assert read.topology.coordinates == made.topology.coordinates
    for first, second in zip(*(tree_dynamics(each, state) for each in (read, made)), strict=True):
        assert np.abs(np.asarray(first) - np.asarray(second)).max() < 1e-12


def stage_with(path, kinds):
    """A stage in centimetres and grams, y up: for each kind a body on the ground, 50 along x from the last one."""
    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageMetersPerUnit(stage, 0.01)
    UsdPhysics.SetStageKilogramsPerUnit(stage, 0.001)
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    UsdPhysics.Scene.Define(stage, "/scene")
    joints = {}
    for count, (name, kind) in enumerate(kinds.items()):
        body = UsdGeom.Xform.Define(stage, f"/machine/{name}/body")
        body.AddTranslateOp().Set((50.0 * count, 3.0, 0.0))
        body.AddScaleOp().Set((2.0, 2.0, 2.0))
        UsdPhysics.RigidBodyAPI.Apply(body.GetPrim())
        mass = UsdPhysics.MassAPI.Apply(body.GetPrim())
        mass.GetMassAttr().Set(500.0)
        mass.GetCenterOfMassAttr().Set((1.0, 0.0, 0.0))
        mass.GetDiagonalInertiaAttr().Set((1e4, 2e4, 2e4))
        joints[name] = kind.Define(stage, f"/machine/{name}/joint_{name}")
        joints[name].GetBody1Rel().SetTargets([body.GetPath()])
        joints[name].GetLocalPos0Attr().Set((50.0 * count, 3.0, 0.0))
    return stage, joints


def free_along(joint, *free):
    """Lock the axes of a joint but for some."""
    for token in ("transX", "transY", "transZ", "rotX", "rotY", "rotZ"):
        if token not in free:
            limit = UsdPhysics.LimitAPI.Apply(joint.GetPrim(), token)
            limit.GetLowAttr().Set(1.0)
            limit.GetHighAttr().Set(-1.0)


OF_AXES = {
    "fixed": ((), "Fixed"), "hinge": (("rotZ",), "Revolute"), "slide": (("transY",), "Prismatic"),
    "sleeve": (("transZ", "rotZ"), "Cylindrical"), "cardan": (("rotX", "rotZ"), "Universal"),
    "ball": (("rotX", "rotY", "rotZ"), "Spherical"), "table": (("transX", "transY", "rotZ"), "Planar"),
    "cross": (("transX", "transZ"), "Rectangular"),
    "free": (("transX", "transY", "transZ", "rotX", "rotY", "rotZ"), "Free"),
}  # fmt: skip


def test_joints_are_known_by_the_axes_they_lock(tmp_path):
    stage, joints = stage_with(tmp_path / "axes.usdc", dict.fromkeys(OF_AXES, UsdPhysics.Joint))
    for name, (free, _) in OF_AXES.items():
        free_along(joints[name], *free)
    stage.Save()
    machine = lx.load(tmp_path / "axes.usdc")
    assert {part.name: part.kind.__name__ for part in machine.joints} == {
        f"joint_{name}": kind for name, (_, kind) in OF_AXES.items()
    }
    rotation = {part.name: part.arguments["parent"].rotation for part in machine.joints}
    assert np.array_equal(rotation["joint_hinge"][:, 0], [0.0, 0.0, 1.0])
    assert np.array_equal(rotation["joint_slide"][:, 0], [0.0, 1.0, 0.0])
    assert np.array_equal(rotation["joint_table"], [[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
    assert np.array_equal(rotation["joint_cardan"][:, :2], [[1.0, 0.0], [0.0, 0.0], [0.0, 1.0]])
    free_along(joints["free"], "transX", "transY", "transZ")
    stage.Save()
    with pytest.raises(lx.MachineFileError, match=r"joint_free.*transX, transY, transZ[\s\S]*ignore=\[\"joint\"\]"):
        lx.load(tmp_path / "axes.usdc")


def test_units_limits_and_drives(tmp_path):
    kinds = {"hinge": UsdPhysics.RevoluteJoint, "slide": UsdPhysics.PrismaticJoint, "off": UsdPhysics.FixedJoint}
    stage, joints = stage_with(tmp_path / "units.usda", kinds)
    joints["off"].GetJointEnabledAttr().Set(False)
    for name, token in (("hinge", "angular"), ("slide", "linear")):
        joints[name].GetAxisAttr().Set("Z")
        joints[name].GetLowerLimitAttr().Set(-30.0)
        joints[name].GetUpperLimitAttr().Set(90.0)
        drive = UsdPhysics.DriveAPI.Apply(joints[name].GetPrim(), token)
        drive.GetStiffnessAttr().Set(2.0)
        drive.GetDampingAttr().Set(0.5)
        drive.GetTargetPositionAttr().Set(45.0)
        drive.GetTargetVelocityAttr().Set(10.0)
    drive.GetMaxForceAttr().Set(300.0)
    stage.Save()
    machine = lx.load(tmp_path / "units.usda")
    forces = {part.name: part.arguments for part in machine.forces}
    bodies = {part.name: part.arguments for part in machine.bodies}
    assert np.allclose(forces["gravity"]["acceleration"], [0.0, -9.81, 0.0])
    assert list(bodies) == [f"machine.{name}.body" for name in kinds]
    first = bodies["machine.hinge.body"]
    assert np.isclose(first["mass"], 0.5)
    assert np.allclose(first["center_of_mass"], [0.02, 0.0, 0.0])
    assert np.allclose(first["inertia"], np.diag([1e-3, 2e-3, 2e-3]))
    degree, torque, force = np.pi / 180.0, 1e-7, 1e-5
    hinge, slide = forces["joint_hinge.drive"], forces["joint_slide.drive"]
    assert np.allclose([forces["joint_hinge.limit"][end] for end in ("lower", "upper")], [-np.pi / 6.0, np.pi / 2.0])
    assert np.allclose([forces["joint_slide.limit"][end] for end in ("lower", "upper")], [-0.3, 0.9])
    assert np.allclose([hinge["control"], hinge["gain"]], [45.0 * degree, 2.0 * torque / degree], rtol=1e-12)
    damping = 0.5 * torque / degree
    assert np.allclose(hinge["bias"], [5.0 * torque, -2.0 * torque / degree, -damping], rtol=1e-12)
    assert "force_range" not in hinge
    assert np.allclose(slide["bias"], [5.0 * force, -2e-3, -5e-4], rtol=1e-12)
    assert np.allclose([slide["gain"], *slide["force_range"]], [2e-3, -300.0 * force, 300.0 * force])
    assert [item.kind for item in machine.left_out] == ["joint"]  # that is off
    assert [part.name for part in machine.joints if part.kind is lx.Free] == ["machine.off.body.free"]


SHAPES = {
    UsdGeom.Cube: ({"size": 2.0}, 8.0, [2.0 / 3.0] * 3),
    UsdGeom.Sphere: ({"radius": 1.0}, 4.0 / 3.0 * np.pi, [0.4] * 3),
    UsdGeom.Cylinder: ({"radius": 1.0, "height": 3.0, "axis": "X"}, 3.0 * np.pi, [0.5, 1.0, 1.0]),
    # A capsule: a cylinder between two half balls, whose centres are 3/8 of their radius beyond its ends.
    UsdGeom.Capsule: ({"radius": 1.0, "height": 0.0, "axis": "Y"}, 4.0 / 3.0 * np.pi, [0.4] * 3),
}


def test_mass_and_inertia_come_from_simple_shapes(tmp_path):
    stage = Usd.Stage.CreateNew(str(tmp_path / "shapes.usda"))
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    for kind, (sizes, _, _) in SHAPES.items():
        path = f"/{kind.__name__}"
        body = UsdGeom.Xform.Define(stage, path).GetPrim()
        UsdPhysics.RigidBodyAPI.Apply(body)
        shape = kind.Define(stage, f"{path}/shape")
        shape.AddTranslateOp().Set((0.5, 0.0, 0.0))
        for name, value in sizes.items():
            shape.GetPrim().GetAttribute(name).Set(value)
        UsdPhysics.CollisionAPI.Apply(shape.GetPrim())
        UsdPhysics.MassAPI.Apply(body).GetDensityAttr().Set(10.0)
    stage.Save()
    for body in lx.load(tmp_path / "shapes.usda").bodies:
        _, volume, moments = SHAPES[getattr(UsdGeom, body.name)]
        assert np.isclose(body.arguments["mass"], 10.0 * volume, rtol=1e-6)
        assert np.allclose(body.arguments["center_of_mass"], [0.5, 0.0, 0.0], atol=1e-6)
        inertia = np.diag(np.array(moments) * 10.0 * volume)
        assert np.allclose(body.arguments["inertia"], inertia, rtol=1e-6, atol=1e-5)
    UsdGeom.Cone.Define(stage, "/Cube/cone")
    UsdPhysics.CollisionAPI.Apply(stage.GetPrimAtPath("/Cube/cone"))
    stage.Save()
    with pytest.raises(lx.MachineFileError, match=r'Cube/cone[\s\S]*ignore=\["inertia"\]'):
        lx.load(tmp_path / "shapes.usda")


def test_a_machine_drawn_away_from_zero_has_a_start(tmp_path):
    stage, joints = stage_with(tmp_path / "turned.usda", {"hinge": UsdPhysics.RevoluteJoint})
    joints["hinge"].GetAxisAttr().Set("Z")
    joints["hinge"].GetLocalRot0Attr().Set(Gf.Quatf(np.cos(0.2), 0.0, 0.0, np.sin(0.2)))
    stage.Save()
    positions = lx.load(tmp_path / "turned.usda").starts["drawn"].positions
    assert np.allclose(positions["joint_hinge"], -0.4, atol=1e-6)


TEXT = FOUR_BAR.read_text()
LAYER = '#usda 1.0\n(subLayers = [@{}@])\ndef Xform "a" ({}) {{}}\n'
WRONG = {
    "cut off": (TEXT[:5000], "USD does not read it: .*broken.usda"),
    "no body": (TEXT.replace("</boxes_fourbar/RigidBodies/body_2>", "</nothing>"), "joint_1.*not in the file"),
    "a scope": (TEXT.replace("</boxes_fourbar/RigidBodies/body_2>", "</boxes_fourbar/Joints>"), "no body and has no"),
    "one body": (
        TEXT.replace("body1 = </boxes_fourbar/RigidBodies/body_2>", "body1 = </boxes_fourbar/RigidBodies/body_1>"),
        "both ends are on 'body_1'",
    ),
    "number": (TEXT.replace("physics:mass = 1.0", "physics:mass = nan", 1), "broken.usda:21: .*mass is nan"),
    "type": (TEXT.replace("float physics:mass = 1.0", 'string physics:mass = "x"', 1), "broken.usda"),
    "outside": (LAYER.format("../../etc/passwd", ""), "lies outside of the file's folder"),
    "net": (LAYER.format("https://example.org/a.usda", ""), "is not there"),
    "reference": (LAYER.format("broken.usda", "references = @/etc/a.usda@"), "lies outside of the file's folder"),
    "clips": (LAYER.format("broken.usda", "clips = {}"), "has value clips"),
    "deep": ("#usda 1.0\n" + 'def "a" {\n' * 100_000, "inside each other"),
    "hidden": ("#usda 1.0\n" + 'def "a" { string b = "}" # }\n' * 100_000, "inside each other"),
    "empty": ("", "USD does not read it"),
}


@pytest.mark.parametrize("name", WRONG)
def test_a_broken_file_is_refused_by_name(tmp_path, name, capfd):
    text, message = WRONG[name]
    path = tmp_path / "broken.usda"
    path.write_text(text)
    with pytest.raises(lx.MachineFileError, match=message):
        lx.load(path)
    assert capfd.readouterr().err == ""


def test_an_attribute_that_usd_does_not_know_is_told(tmp_path):
    path = tmp_path / "misspelt.usda"
    path.write_text(TEXT.replace("float physics:mass = 1.0", "float physics:mas = 1.0", 1))
    told = [str(item) for item in lx.load(path).left_out if item.kind == "extension" and "mas " in item.reason]
    assert len(told) == 1
    assert ":21: " in told[0]
    assert told[0].endswith("physics:mas is not in USD Physics (did you mean 'physics:mass'?)")


def test_packages_and_references_are_read_in_the_folder_alone(tmp_path):
    (tmp_path / "inside.usda").write_text(TEXT)
    assert UsdUtils.CreateNewUsdzPackage(str(tmp_path / "inside.usda"), str(tmp_path / "machine.usdz"))
    assert len(lx.load(tmp_path / "machine.usdz").bodies) == 4
    (tmp_path / "layer.usda").write_text("#usda 1.0\n(subLayers = [@inside.usda@])\n")
    assert len(lx.load(tmp_path / "layer.usda").bodies) == 4
    (tmp_path / "machine.usdz").write_bytes((tmp_path / "machine.usdz").read_bytes()[:3000])
    with pytest.raises(lx.MachineFileError, match="no package"):
        lx.load(tmp_path / "machine.usdz")
    with open(tmp_path / "huge.usdc", "wb") as file:
        file.truncate(2**30)
    with pytest.raises(lx.MachineFileError, match=r"huge.usdc has 1073741824 bytes"):
        lx.load(tmp_path / "huge.usdc")


def test_without_usd_core_the_error_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "pxr.Gf", None)
    with pytest.raises(lx.MachineFileError, match=r"pip install 'linkax\[files\]'"):
        lx.load(FOUR_BAR)
