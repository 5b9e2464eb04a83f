"""Motions as USD: what the file says again of places, shapes and colours, and what is refused."""

import dataclasses
import sys

import numpy as np
import pytest
import trimesh
from pxr import Usd, UsdGeom, UsdShade, UsdValidation
from refusals import refused

import linkax as lx

TIMES = np.linspace(0.5, 2.5, 21)
AT = [0.3, -0.2, 0.1]
SHAPES = {
    "box": ((0.1, 0.2, 0.3), 0.1 * 0.2 * 0.3),
    "sphere": ((0.5,), 4.0 / 3.0 * np.pi * 0.5**3),
    "ellipsoid": ((0.1, 0.2, 0.3), 4.0 / 3.0 * np.pi * 0.1 * 0.2 * 0.3),
    "cylinder": ((0.5, 2.0), np.pi * 0.5**2 * 2.0),
    "capsule": ((0.5, 2.0), np.pi * 0.5**2 * (2.0 + 4.0 / 3.0 * 0.5)),
}
EXTENTS = {"sphere": (1, 1, 1), "ellipsoid": (0.2, 0.4, 0.6), "cylinder": (1, 1, 2), "capsule": (1, 1, 3)}


def mechanism(shape=None, gravity=(0.0, -9.81, 0.0)):
    """A wheel that turns many times, and a free box, whose names USD does not allow and are alike to it."""
    wheel = lx.RigidBody("rad-1", 1.0, inertia=[0.1, 0.1, 0.1], frames={"rim": [0.0, 0.5, 0.0]}, shape=shape)
    block = lx.box("rad:1", [0.5, 0.4, 0.3], mass=2.0)
    joints = [lx.Revolute("axle", lx.GROUND, wheel, axis="z"), lx.Free("materials", lx.GROUND, block)]
    spring = lx.Spring(wheel.at("rim"), block.at([0.1, 0.0, 0.0]), stiffness=1.0, free_length=1.0, name="coil")
    return lx.Mechanism([wheel, block], joints, [lx.Gravity(gravity), spring])


def turning(moving):
    """A solution of it, which needs no simulation."""
    at_rest = lx.Solution.of_state(moving, lx.State(np.eye(8)[1], np.zeros(7), moving.topology))
    axis = np.array([2.0, 3.0, 6.0]) / 7.0
    half = 1.5 * TIMES[:, None]
    q = np.concatenate([9.0 * half, np.cos(half), np.sin(half) * axis, np.cos(half + np.arange(3.0))], axis=1)
    return dataclasses.replace(at_rest, ts=TIMES, q=q, v=np.zeros((len(TIMES), 7)))


def opened(solution, path, **options):
    lx.to_usd(solution, path, **options)
    return Usd.Stage.Open(str(path))


def solid(prim):
    mesh = UsdGeom.Mesh(prim)
    assert set(mesh.GetFaceVertexCountsAttr().Get()) == {3}
    points, corners = mesh.GetPointsAttr().Get(), mesh.GetFaceVertexIndicesAttr().Get()
    found = trimesh.Trimesh(np.array(points, float), np.reshape(corners, (-1, 3)), process=False)
    np.testing.assert_allclose(mesh.GetNormalsAttr().Get(), found.face_normals, atol=1e-5)
    return found


@pytest.mark.parametrize(("suffix", "speed"), [("usda", 1.0), ("usdc", 0.25), ("usd", 1.0)])
def test_bodies_are_where_the_solution_says(suffix, speed, tmp_path):
    solution = turning(mechanism())
    stage = opened(solution, tmp_path / f"motion.{suffix}", speed=speed)
    codes = 24.0 * TIMES / speed
    assert stage.GetTimeCodesPerSecond() == stage.GetFramesPerSecond() == 24.0
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode()) == (codes[0], codes[-1])
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1.0
    bodies = {"rad_1": "rad-1", "rad_1_2": "rad:1"}
    for path, name in bodies.items():
        prim = stage.GetDefaultPrim().GetChild(path)
        assert prim.GetDisplayName() == name
        placed = [UsdGeom.Xformable(prim).ComputeLocalToWorldTransform(code) for code in codes]
        origin, axes = solution.poses()[name]
        np.testing.assert_allclose(np.array(placed)[:, 3, :3], origin, atol=1e-14)
        np.testing.assert_allclose(np.array(placed)[:, :3, :3].swapaxes(1, 2), axes, atol=1e-14)
        turns = prim.GetAttribute("xformOp:orient")
        quaternions = [turns.Get(code) for code in turns.GetTimeSamples()]
        found = np.array([[turn.real, *turn.imaginary] for turn in quaternions])
        assert len(found) == len(TIMES)
        assert np.all(np.sum(found[1:] * found[:-1], axis=1) > 0.0)
    coil = UsdGeom.BasisCurves(stage.GetPrimAtPath("/mechanism/coil")).GetPointsAttr()
    ends = np.stack([solution.position("rad-1", "rim"), solution.position("rad:1", [0.1, 0.0, 0.0])], axis=1)
    np.testing.assert_allclose([coil.Get(code) for code in codes], ends, atol=1e-6)
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    assert validators
    assert UsdValidation.ValidationContext(validators).Validate(stage) == []


def test_shapes_have_their_sizes_places_and_colours(tmp_path):
    trimesh.creation.box([1.0, 2.0, 4.0]).export(tmp_path / "part.stl")
    green, turn = [0.0, 1.0, 0.5, 0.25], [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]
    shapes = [lx.Shape(kind, size, AT) for kind, (size, _) in SHAPES.items()]
    shapes += [lx.Shape("mesh", [0.1, -0.1, 0.1], AT, turn, tmp_path / "part.stl", colour=green)]
    stage = opened(turning(mechanism(shapes)), tmp_path / "motion.usdc")
    wheel = stage.GetPrimAtPath("/mechanism/rad_1")
    assert [prim.GetName() for prim in wheel.GetChildren()] == [*SHAPES, "mesh"]
    volumes = {kind: volume for kind, (_, volume) in SHAPES.items()} | {"mesh": 8e-3}
    for kind, volume in volumes.items():
        found = solid(wheel.GetChild(kind))
        assert found.is_watertight
        assert (0.95 if kind in EXTENTS else 1.0 - 1e-6) * volume < found.volume < volume * (1.0 + 1e-6)
        extents = EXTENTS.get(kind, (0.1, 0.2, 0.3) if kind == "box" else (0.2, 0.1, 0.4))
        np.testing.assert_allclose(found.extents, extents, rtol=1e-6)
        np.testing.assert_allclose(found.bounds.mean(axis=0), AT, atol=1e-6)
    material, _ = UsdShade.MaterialBindingAPI(wheel.GetChild("mesh")).ComputeBoundMaterial()
    surface = material.ComputeSurfaceSource()[0]
    half = ((0.5 + 0.055) / 1.055) ** 2.4  # in linear light: IEC 61966-2-1
    np.testing.assert_allclose(surface.GetInput("diffuseColor").Get(), [0.0, 1.0, half], rtol=1e-6)
    assert surface.GetInput("opacity").Get() == 0.25


def test_bodies_without_shapes_are_drawn_as_in_the_view(tmp_path):
    stage = opened(turning(mechanism()), tmp_path / "motion.usda")
    block = solid(stage.GetPrimAtPath("/mechanism/rad_1_2/box"))
    np.testing.assert_allclose(sorted(block.extents), [0.3, 0.4, 0.5], rtol=1e-6)
    rod = solid(stage.GetPrimAtPath("/mechanism/rad_1/rod"))  # from the axle to the rim
    np.testing.assert_allclose(rod.bounds.mean(axis=0), [0.0, 0.25, 0.0], atol=1e-6)
    thickness = rod.extents[0]
    np.testing.assert_allclose(rod.extents, [thickness, 0.5 + thickness, thickness], rtol=1e-6)
    axle = solid(stage.GetPrimAtPath("/mechanism/rad_1/axle"))
    assert axle.extents[2] > 1.5 * axle.extents[0] == pytest.approx(1.5 * axle.extents[1])  # a pin along z


def test_plates_and_hulls_have_their_corners(tmp_path):
    corners = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.2, 0.2, 1.0]]
    bodies = [
        lx.RigidBody(
            name, 1.0, inertia=[0.1, 0.1, 0.1], frames={str(index): place for index, place in enumerate(places)}
        )
        for name, places in (("plate", corners[:3]), ("hull", corners))
    ]
    joints = [lx.Revolute(f"{body.name}_axle", lx.GROUND, body, axis="z") for body in bodies]
    moving = lx.Mechanism(bodies, joints)
    solution = lx.Solution.of_state(moving, lx.State(np.zeros(2), np.zeros(2), moving.topology))
    stage = opened(solution, tmp_path / "standing.usda")
    assert stage.GetStartTimeCode() == stage.GetEndTimeCode() == 0.0
    hull = solid(stage.GetPrimAtPath("/mechanism/hull/hull"))
    assert hull.volume == pytest.approx(1.0 / 6.0)
    faces = [
        prim for prim in stage.GetPrimAtPath("/mechanism/plate").GetChildren() if prim.GetName().startswith("plate")
    ]
    assert [solid(prim).area for prim in faces if len(UsdGeom.Mesh(prim).GetPointsAttr().Get()) == 3] == [0.5]


@pytest.mark.parametrize(
    ("gravity", "up"),
    [([0, -9.81, 0], "Y"), ([0, -1, -9.81], "Z"), ([0, 0, 0], "Z"), ([0, 3, 0], "Z"), ([1, 0, 0], "Z")],
)
def test_upwards_is_against_gravity(gravity, up, tmp_path):
    assert UsdGeom.GetStageUpAxis(opened(turning(mechanism(gravity=gravity)), tmp_path / "motion.usda")) == up


def test_what_cannot_be_written_leaves_no_file(tmp_path, monkeypatch):
    solution = turning(mechanism())
    write = lambda name="motion.usdc", of=solution, **options: lx.to_usd(of, tmp_path / name, **options)
    refused(lambda: write("motion.usdz"), "motion.usdz", "known: .usda, .usdc, .usd")
    refused(lambda: write(of="motion"), "solution is 'motion'; give a linkax.Solution")
    refused(lambda: write(speed=0.0), "speed is 0.0", "positive")
    batch = dataclasses.replace(solution, ts=np.stack([TIMES] * 2))
    refused(lambda: write(of=batch), "a batch of shape (2,); draw one of its members")
    refused(lambda: write("missing/motion.usda"), "cannot write", "missing/motion.usda", "give another path")
    monkeypatch.setitem(sys.modules, "pxr.UsdGeom", None)
    with pytest.raises(ValueError, match=r"motion.usdc is USD, which usd-core writes; pip install 'linkax\[files\]'"):
        write()
    assert not list(tmp_path.iterdir())


def test_a_mesh_that_cannot_be_read_is_told_and_not_drawn(tmp_path):
    moving = mechanism([lx.Shape("mesh", mesh=tmp_path / "missing.stl")])
    with pytest.warns(UserWarning, match=r"meshes are not drawn, missing\.stl"):
        stage = opened(turning(moving), tmp_path / "motion.usda")
    assert [prim.GetName() for prim in stage.GetPrimAtPath("/mechanism/rad_1").GetChildren()] == ["rod", "axle"]
