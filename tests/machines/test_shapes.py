"""What bodies are drawn as: what the readers keep of a file, where meshes are looked for, and what a page has of it."""

import base64
import gzip
import json
import re
from pathlib import Path

import jax
import mujoco
import numpy as np
import pytest
import trimesh
from refusals import refused
from scipy.spatial.transform import Rotation

import linkax as lx
from linkax.view.meshes import Mesh, smaller

INERTIAL = '<inertial><mass value="1"/><inertia ixx="0.1" iyy="0.1" izz="0.1"/></inertial>'
AT = (0.1, 0.2, 0.3), (0.4, -0.5, 0.6)
TURN = Rotation.from_euler("xyz", AT[1]).as_matrix()
GREEN = (0.0, 1.0, 0.0, 0.25)
URDF = """<robot name="drawn"><material name="green"><color rgba="0 1 0 0.25"/></material><link name="base"/>
  <link name="arm">{inertial}
    <visual><origin xyz="0.1 0.2 0.3" rpy="0.4 -0.5 0.6"/><geometry><box size="1 2 3"/></geometry>
      <material name="green"/></visual>
    <visual><geometry><sphere radius="0.5"/></geometry></visual>
    <visual><geometry><cylinder radius="0.5" length="2"/></geometry></visual>
    <visual><geometry><capsule radius="0.5" length="2"/></geometry></visual>
    <visual><geometry><ellipsoid radii="1 2 3"/></geometry></visual>{more}
  </link>
  <joint name="hinge" type="continuous"><parent link="base"/><child link="arm"/><axis xyz="0 1 0"/></joint>
</robot>"""
SDF = """<sdf version="1.7"><model name="drawn"><link name="arm"><pose>5 6 7 0 0 1</pose>
  <visual name="a"><pose>0.1 0.2 0.3 0.4 -0.5 0.6</pose><geometry><box><size>1 2 3</size></box></geometry>
    <material><diffuse>0 1 0 0.5</diffuse><ambient>1 0 0 1</ambient></material><transparency>0.5</transparency></visual>
  <visual name="b"><pose relative_to="__model__">5 6 7 0 0 1</pose>
    <geometry><sphere><radius>0.5</radius></sphere></geometry></visual>
  <visual name="c"><geometry><cylinder><radius>0.5</radius><length>2</length></cylinder></geometry></visual>
  <visual name="d"><geometry><capsule><radius>0.5</radius><length>2</length></capsule></geometry></visual>
  <visual name="e"><geometry><ellipsoid><radii>1 2 3</radii></ellipsoid></geometry></visual>
</link></model></sdf>"""
MJCF = """<mujoco><compiler angle="radian" eulerseq="XYZ"/><asset><material name="green" rgba="0 1 0 0.25"/></asset>
  <worldbody><geom type="plane" size="1 1 1"/><body name="arm"><joint axis="0 1 0"/>
  <geom type="box" size="0.5 1 1.5" pos="0.1 0.2 0.3" euler="0.4 -0.5 0.6" material="green"/>
  <geom type="sphere" size="0.5"/><geom type="cylinder" size="0.5 1"/><geom type="capsule" size="0.5 1"/>
  <geom type="ellipsoid" size="1 2 3"/>
  <geom type="sphere" size="9" group="3"/><geom type="sphere" size="9" rgba="1 1 1 0"/>
</body></worldbody></mujoco>"""
FILES = {"urdf": URDF.format(inertial=INERTIAL, more=""), "sdf": SDF, "xml": MJCF}
AT_REST = lx.State(np.zeros(1), np.zeros(1))
MESH = '<visual><geometry><mesh filename="{address}" scale="{scale}"/></geometry></visual>'


def loaded(path, text, **settings):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    return lx.load(path, **settings)


def with_mesh(path, address, scale="1 1 1", **settings):
    more = MESH.format(address=address, scale=scale)
    return loaded(path, URDF.format(inertial=INERTIAL, more=more), **settings)


def tetrahedron(path, kind="stl"):
    path.parent.mkdir(parents=True, exist_ok=True)
    corners = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 2.0, 0.0], [0.5, 0.25, 3.0]])
    trimesh.Trimesh(corners, [[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]]).export(path, kind)
    return corners


@pytest.mark.filterwarnings("ignore::linkax.LeftOutWarning")
@pytest.mark.parametrize("kind", FILES)
def test_every_format_says_the_same_shapes(kind, tmp_path):
    machine = loaded(tmp_path / f"drawn.{kind}", FILES[kind])
    found = machine.shapes["arm"]
    sizes = {
        "box": (1.0, 2.0, 3.0),
        "sphere": (0.5,),
        "cylinder": (0.5, 2.0),
        "capsule": (0.5, 2.0),
        "ellipsoid": (1.0, 2.0, 3.0),
    }
    assert {shape.kind: shape.size for shape in found} == sizes
    np.testing.assert_allclose(found[0].pose[:3, 3], AT[0], atol=1e-15)
    np.testing.assert_allclose(found[0].pose[:3, :3], TURN, atol=1e-12)
    np.testing.assert_allclose(found[1].pose, np.eye(4), atol=1e-15)
    assert [shape.colour for shape in found] == [GREEN, None, None, None, None]
    assert not any("shape" in numbers for numbers in machine.params["bodies"].values())
    assert machine.mechanism().body("arm").shape == found


def test_shapes_compile_nothing_again(tmp_path):
    """Two machines of one file, and other numbers, have one structure."""
    first, again = (loaded(tmp_path / "drawn.urdf", FILES["urdf"]) for _ in range(2))
    mechanisms = first.mechanism(), again.mechanism({"bodies": {"arm": {"mass": 3.0}}})
    structures = [jax.tree.structure(mechanism) for mechanism in mechanisms]
    assert structures[0] == structures[1]
    assert hash(structures[0]) == hash(structures[1])


def test_meshes_are_found_below_the_allowed_folders_alone(tmp_path):
    mesh, path = tmp_path / "share" / "robot" / "meshes" / "part.stl", tmp_path / "share" / "robot" / "urdf" / "a.urdf"
    tetrahedron(mesh)
    share, robot = tmp_path / "share", tmp_path / "share" / "robot"
    ways = {
        ("package://robot/meshes/part.stl", share): True,
        ("model://robot/meshes/part.stl", robot): True,
        ("package://robot/meshes/part.stl", mesh.parent): True,
        ("../meshes/part.stl", robot): True,
        (f"file://{mesh}", robot): True,
        ("package://robot/meshes/part.stl", path.parent): False,
        ("../meshes/part.stl", path.parent): False,
        (f"file://{mesh}", path.parent): False,
        ("package://robot/../robot/meshes/other.stl", share): False,
        ("https://example.org/part.stl", share): False,
        ("", share): False,
    }
    for (address, folder), there in ways.items():
        machine = with_mesh(path, address, folders=[folder])
        assert [shape.mesh for shape in machine.shapes["arm"] if shape.kind == "mesh"] == [str(mesh)] * there, address
        noted = [item.kind for item in machine.left_out if item.kind == "visual"]
        assert noted == ["visual"] * (not there), address


def test_what_is_no_shape_changes_no_motion(tmp_path):
    for geometry, told in (
        ("<cone/>", "none of box"),
        ('<box size="1 1"/>', "3 finite numbers"),
        ('<sphere radius="-1"/>', "positive"),
    ):
        text = FILES["urdf"].replace('<sphere radius="0.5"/>', geometry)
        machine = loaded(tmp_path / "drawn.urdf", text)
        assert [told in item.reason for item in machine.left_out] == [True], geometry
        assert len(machine.shapes["arm"]) == 4


@pytest.mark.filterwarnings("ignore::linkax.LeftOutWarning")
@pytest.mark.parametrize("asset", ['scale="0.1 -0.2 0.3"', 'scale="0.2 0.2 0.2" refquat="0.7 0.1 0.3 0"'])
def test_a_mesh_of_mjcf_is_where_mujoco_has_it(asset, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path.parent)
    corners = tetrahedron(tmp_path / "part.stl")
    text = f"""<mujoco><asset><mesh name="part" file="part.stl" refpos="0.3 0 0.1" {asset}/></asset><worldbody>
      <body name="arm"><joint axis="0 1 0"/><geom type="mesh" mesh="part" pos="1 2 3" quat="0.9 0.1 0.2 0.3"/></body>
    </worldbody></mujoco>"""
    (shape,) = loaded(Path(tmp_path.name) / "drawn.xml", text).shapes["arm"]
    assert shape.mesh == str(tmp_path / "part.stl")
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "drawn.xml"))
    turn = Rotation.from_quat(model.geom_quat[0], scalar_first=True)
    expected = turn.apply(model.mesh_vert) + model.geom_pos[0]
    found = corners * shape.size @ shape.pose[:3, :3].T + shape.pose[:3, 3]
    order = lambda points: points[np.lexsort(points.round(4).T)]
    np.testing.assert_allclose(order(found), order(expected), atol=1e-6)  # MuJoCo keeps single precision


def test_shapes_come_back_from_mjcf_and_weigh_nothing(tmp_path):
    tetrahedron(tmp_path / "part.stl")
    meshes = [lx.Shape("mesh", scale, *AT[:1], TURN, tmp_path / "part.stl") for scale in ([0.1, -0.2, 0.3], [1, 1, 1])]
    shapes = [
        lx.Shape("box", [1.0, 2.0, 3.0], AT[0], TURN, colour=GREEN), lx.Shape("sphere", 0.5),
        lx.Shape("cylinder", [0.5, 2.0], rotation=TURN), lx.Shape("capsule", [0.5, 2.0]), *meshes, meshes[0],
        lx.Shape("ellipsoid", [1.0, 2.0, 3.0], AT[0]),
    ]  # fmt: skip
    arm, bare = lx.RigidBody("arm", 1.0, inertia=[0.1, 0.2, 0.15], shape=shapes), lx.rod("bare", 1.0, 2.0)
    joints = [lx.Revolute("hinge", lx.GROUND, arm, axis="y"), lx.Revolute("pin", arm, bare.at("base"), axis="y")]
    mechanism = lx.Mechanism([arm, bare], joints)
    text = lx.to_mjcf(mechanism, tmp_path / "drawn.xml")
    model = mujoco.MjModel.from_xml_string(text)
    assert (model.nmesh, model.body_mass.tolist(), model.body_inertia[1].tolist()) == (2, [0, 1, 2], [0.1, 0.2, 0.15])
    found = lx.load(tmp_path / "drawn.xml").shapes
    assert [*found] == ["arm"]
    for shape, again in zip(shapes, found["arm"], strict=True):
        assert (again.kind, again.mesh, again.colour) == (shape.kind, shape.mesh, shape.colour)
        np.testing.assert_allclose(again.size, shape.size, rtol=1e-15)
        np.testing.assert_allclose(again.pose, shape.pose, atol=1e-12)
    assert lx.to_mjcf(mechanism, ignore=["Shape"]).count("geom") == 0


def test_meshes_that_mujoco_does_not_read_are_told_and_left_out(tmp_path):
    tetrahedron(tmp_path / "ascii.stl", "stl_ascii")
    (tmp_path / "part.dae").touch()
    paths = [tmp_path / name for name in ("ascii.stl", "part.dae", "absent.obj")]
    arm = lx.RigidBody("arm", 1.0, inertia=[0.1, 0.1, 0.1], shape=[lx.Shape("mesh", mesh=path) for path in paths])
    mechanism = lx.Mechanism([arm], [lx.Revolute("hinge", lx.GROUND, arm, axis="y")])
    with pytest.warns(UserWarning, match=r"not in the MJCF: '.*ascii.stl' is no binary STL .*; 2 more"):
        text = lx.to_mjcf(mechanism)
    assert mujoco.MjModel.from_xml_string(text).ngeom == 0


def unpacked(view, name):
    (packed,) = re.findall(rf'id="{name}">([^<]*)<', view.html)
    return gzip.decompress(base64.b64decode(packed))


@pytest.mark.filterwarnings("ignore::linkax.LeftOutWarning")
@pytest.mark.parametrize("kind", ["stl", "stl_ascii", "obj"])
def test_a_page_has_each_mesh_once(kind, tmp_path):
    corners = tetrahedron(tmp_path / f"part.{kind[:3]}", kind)
    more = "".join(MESH.format(address=f"part.{kind[:3]}", scale=scale) for scale in ("1 1 1", "0.1 0.1 -0.1"))
    view = loaded(tmp_path / "drawn.urdf", URDF.format(inertial=INERTIAL, more=more)).mechanism().view(AT_REST)
    described, wholes = json.loads(unpacked(view, "contents")), np.frombuffer(unpacked(view, "meshes"), "<u4")
    ((mesh,), arm) = described["meshes"], next(body for body in described["bodies"] if body["name"] == "arm")
    part = lambda name: wholes[mesh[name][0] : sum(mesh[name])].reshape(-1, 3)
    points = np.array(mesh["low"]) + part("points") / 65535 * mesh["size"]
    order = lambda points: points[np.lexsort(points.round(4).T)]
    np.testing.assert_allclose(order(points), order(corners), atol=3.0 / 65535)
    assert len(part("corners")) == 4
    matrices = [part["matrix"] for part in arm["parts"] if part["form"] == "mesh"]
    np.testing.assert_array_equal(matrices, [np.eye(4), np.diag([0.1, 0.1, -0.1, 1.0])])
    assert len(arm["parts"]) == 4 + 3 + 2  # a capsule is three
    assert described["high"][2] >= 3.0 >= -3.0 >= described["low"][2]  # the half axis of the ellipsoid


def test_a_mesh_that_cannot_be_read_is_told_once_and_not_drawn(tmp_path):
    (tmp_path / "part.stl").write_text("no mesh")
    hinge = lambda arm: lx.Mechanism([arm], [lx.Revolute("hinge", lx.GROUND, arm, axis="y")])
    broken = [lx.Shape("mesh", mesh=tmp_path / name) for name in ("part.stl", "part.msh", "absent.stl")]
    mechanism = hinge(lx.RigidBody("arm", 1.0, inertia=[0.1, 0.1, 0.1], shape=broken))
    with pytest.warns(UserWarning, match=r"meshes are not drawn, part.stl: .*; 2 more"):
        view = mechanism.view(AT_REST)
    plain = hinge(lx.RigidBody("arm", 1.0, inertia=[0.1, 0.1, 0.1])).view(AT_REST)
    assert unpacked(view, "contents") == unpacked(plain, "contents")


def test_a_large_mesh_is_made_smaller_and_keeps_its_form():
    ball = trimesh.creation.icosphere(subdivisions=5)
    made = smaller(Mesh(ball.vertices, ball.faces), 5000)
    assert 1000 < len(made.triangles) <= 5000
    np.testing.assert_allclose(np.linalg.norm(made.points, axis=1), 1.0, atol=0.01)
    assert np.isclose(trimesh.Trimesh(made.points, made.triangles).volume, ball.volume, rtol=0.02)


def test_shapes_turn_with_a_body_that_is_placed():
    turn = Rotation.from_euler("z", np.pi / 2).as_matrix()
    body = lx.RigidBody("arm", 1.0, shape=[lx.Shape("box", [1.0, 2.0, 3.0], [1.0, 0.0, 0.0])])
    (shape,) = body.placed([4.0, 5.0, 6.0], turn).shape
    np.testing.assert_allclose(shape.position, [0.0, 1.0, 0.0], atol=1e-15)
    np.testing.assert_allclose(shape.rotation, turn, atol=1e-15)
    assert lx.RigidBody("arm", 1.0, shape=[]).shape is None


def test_bad_shapes_are_refused():
    refused(lambda: lx.Shape("cone", 1.0), "kind of a shape is 'cone'", "'ellipsoid'")
    refused(lambda: lx.Shape("sphere", [1.0, 2.0]), "shape 'sphere': size [m]", "(1,)")
    refused(lambda: lx.Shape("box", [1.0, 0.0, 2.0]), "shape 'box': size [m]", "positive")
    refused(lambda: lx.Shape("mesh"), "shape 'mesh': mesh is None", "path")
    refused(lambda: lx.Shape("box", [1.0, 1.0, 1.0], mesh="a.stl"), "mesh is 'a.stl'")
    refused(lambda: lx.Shape("sphere", 1.0, colour=[0.0, 0.0, 2.0, 1.0]), "colour", "from 0 to 1")
    refused(lambda: lx.Shape("sphere", 1.0, rotation=2.0 * np.eye(3)), "rotation", "orthonormal")
    refused(lambda: jax.jit(lambda radius: lx.Shape("sphere", radius).size)(1.0), "size is traced")
    refused(lambda: lx.RigidBody("arm", 1.0, shape=["box"]), "body 'arm': shape", "lx.Shape")
