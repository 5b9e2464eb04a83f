"""Trees from SDF and URDF, beside MuJoCo's with the numbers of the same file."""

from pathlib import Path
from xml.etree import ElementTree

import mujoco
import numpy as np
import pytest
from beside_mujoco import matrix_of_speeds, positions, random_state, tree_dynamics
from scipy.spatial.transform import Rotation

import linkax as lx

MACHINES = Path(__file__).parents[1] / "data" / "machines"
# Joints that are left out: the first file has balls at their parents, which have no coordinates of MuJoCo's. Without
# them its rods hang on hinges, whose poses in their links are not zero.
WITHOUT = {"cassie_v2": ["*-pitch-rod-joint"], "cassie_wo_gearbox_spring": [], "turned": []}
STATES = 20
TYPES = {
    "revolute": mujoco.mjtJoint.mjJNT_HINGE,
    "prismatic": mujoco.mjtJoint.mjJNT_SLIDE,
    "ball": mujoco.mjtJoint.mjJNT_BALL,
}


def numbers(element, path, default):
    return np.array(element.findtext(path, default).split(), float)


def pose(element):
    """The origin and the axes, as columns, of an element of SDF."""
    found = numbers(element, "pose", "0 0 0 0 0 0")
    return found[:3], Rotation.from_euler("xyz", found[3:]).as_matrix()


def inertial(link):
    """Mass, its centre and its inertia about that, in the frame of a link of SDF."""
    given = link.find("inertial")
    at, axes = pose(given)
    xx, yy, zz, xy, xz, yz = (
        float(given.findtext(f"inertia/i{name}")) for name in ("xx", "yy", "zz", "xy", "xz", "yz")
    )
    inertia = axes @ np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]) @ axes.T
    return float(given.findtext("mass")), at, inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]


def read(path):
    """Links and joints of SDF by name, and the poses of links in the model's frame."""
    model = ElementTree.parse(path).getroot().find("model")
    links, joints = ({each.get("name"): each for each in model.findall(tag)} for tag in ("link", "joint"))
    ground = {"ground": (np.zeros(3), np.eye(3)), "world": (np.zeros(3), np.eye(3))}
    return links, joints, ground | {name: pose(link) for name, link in links.items()}


def pivot(joint, poses):
    """The place of a joint, and its axis, in the model's frame; the file has them in the child's."""
    at, axes = poses[joint.findtext("child")]
    own_at, own_axes = pose(joint)
    direction = numbers(joint, "axis/xyz", "")
    in_model = joint.findtext("axis/use_parent_model_frame") == "1"
    return at + axes @ own_at, direction if in_model else axes @ own_axes @ direction


def of_sdf(path, topology):
    """MuJoCo's model of the tree alone."""
    links, joints, poses = read(path)
    spec = mujoco.MjSpec()
    spec.option.gravity, spec.compiler.degree = [0.0, 0.0, -9.8], False
    bodies = {"ground": spec.worldbody}
    for name, joint, carrier in zip(topology.bodies, topology.joints, topology.predecessor, strict=False):
        carrier = topology.bodies[carrier] if carrier >= 0 else "ground"
        (at, axes), (from_at, from_axes) = poses[name], poses[carrier]
        bodies[name] = body = bodies[carrier].add_body(name=name, pos=from_axes.T @ (at - from_at))
        body.quat = Rotation.from_matrix(from_axes.T @ axes).as_quat(scalar_first=True)
        body.mass, body.ipos, body.fullinertia = inertial(links[name])
        body.explicitinertial = True
        if joint not in joints:
            body.add_joint(name=joint, type=mujoco.mjtJoint.mjJNT_FREE)
            continue
        given = joints[joint]
        place, direction = pivot(given, poses)
        forward = 1.0 if given.findtext("child") == name else -1.0
        made = body.add_joint(name=joint, type=TYPES[given.get("type")])
        made.pos, made.axis = axes.T @ (place - at), forward * axes.T @ direction
        dynamics = given.find("axis/dynamics")
        if dynamics is not None and given.get("type") != "ball":
            made.damping[0], made.stiffness[0], made.springref = (
                float(dynamics.findtext(word, "0")) for word in ("damping", "spring_stiffness", "spring_reference")
            )
    return spec.compile()


def worst_difference(mechanism, model):
    """How far places, mass matrix and generalised force are from MuJoCo's, relative to the largest, at random states.

    The force is that of gravity, springs, dampers and inertia at zero acceleration.
    """
    topology, rng = mechanism.topology, np.random.default_rng(0)
    names = [model.joint(index).name for index in range(model.njnt)]
    shared = [name for name in topology.bodies if mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, name) >= 0]
    data, full, found = mujoco.MjData(model), np.zeros((model.nv, model.nv)), []
    for _ in range(STATES):
        state = random_state(mechanism, rng)
        mass, force, centers = map(np.array, tree_dynamics(mechanism, state))
        data.qpos = positions(model, mechanism, names, state.q)
        into = matrix_of_speeds(model, mechanism, names, data.qpos)
        data.qvel = np.linalg.solve(into, state.v)
        mujoco.mj_forward(model, data)
        mujoco.mj_fullM(model, data, full)
        for own, theirs in (
            (centers[[topology.bodies.index(name) for name in shared]], [data.body(name).xipos for name in shared]),
            (into.T @ mass @ into, full),
            (into.T @ force, data.qfrc_passive - data.qfrc_bias),
        ):
            found.append(np.abs(own - np.array(theirs)).max() / np.abs(theirs).max())
    return np.max(found)


INERTIA = "".join(
    f"<{name}>{number}</{name}>"
    for name, number in {"ixx": 0.02, "iyy": 0.03, "izz": 0.04, "ixy": 0.002, "ixz": -0.003, "iyz": 0.004}.items()
)
SDF_LINK = f"""<link name="{{0}}"><pose>{{1}}</pose><inertial><pose>0.1 -0.02 0.05 0.3 -0.5 0.8</pose><mass>1.3</mass>
  <inertia>{INERTIA}</inertia></inertial></link>"""
SDF_JOINT = """<joint name="{0}" type="{1}"><pose>0.2 0.1 -0.3 -0.4 0.7 1.1</pose><parent>{2}</parent><child>{3}</child>
  <axis><xyz>0.6 0 0.8</xyz><dynamics><damping>0.4</damping><spring_stiffness>3</spring_stiffness>
  <spring_reference>0.2</spring_reference></dynamics></axis></joint>"""
# Inertias and joints turned in their links, which those of Cassie are not.
TURNED = f"""<sdf version="1.6"><model name="tree">
  {SDF_LINK.format("base", "0.3 0.2 1 0.5 -0.2 0.4")}
  {SDF_LINK.format("arm", "0.7 0 1.2 -1 0.6 2")}
  {SDF_LINK.format("hand", "1 0.5 1.1 0.3 0.9 -0.7")}
  {SDF_JOINT.format("shoulder", "revolute", "base", "arm")}
  {SDF_JOINT.format("reach", "prismatic", "arm", "hand")}
</model></sdf>"""


@pytest.mark.filterwarnings("ignore::linkax.LeftOutWarning")
@pytest.mark.parametrize("name", WITHOUT)
def test_a_tree_of_sdf_is_that_of_mujoco(name, tmp_path):
    path = tmp_path / "turned.sdf" if name == "turned" else MACHINES / f"{name}.sdf"
    if name == "turned":
        path.write_text(TURNED)
    machine = lx.load(path, ignore=["contact", "limit"])
    mechanism = (machine.without(*WITHOUT[name]) if WITHOUT[name] else machine).mechanism()
    model = of_sdf(path, mechanism.topology)
    assert model.nv == mechanism.topology.num_speeds
    assert worst_difference(mechanism, model) < 1e-10


@pytest.mark.filterwarnings("ignore::linkax.LeftOutWarning")
@pytest.mark.parametrize("path", sorted(MACHINES.glob("*.sdf")), ids=lambda path: path.stem)
def test_both_ends_of_each_joint_are_where_the_file_places_it(path):
    """Of joints that close loops, too."""
    machine = lx.load(path, ignore=["contact", "limit", "inertia"])
    _, joints, poses = read(path)
    for part in machine.joints:
        if part.name in joints:
            place, direction = pivot(joints[part.name], poses)
            for end in (part.arguments["parent"], part.arguments["child"]):
                at, axes = poses[end.body]
                assert np.abs(at + axes @ end.offset - place).max() < 1e-14
                if "axis" in part.arguments:
                    assert np.abs(axes @ end.rotation @ part.arguments["axis"] - direction).max() < 1e-14


LINK = """<link name="{0}"><inertial><origin xyz="0.1 -0.02 0.05" rpy="0.3 -0.5 0.8"/><mass value="1.3"/>
  <inertia ixx="0.02" iyy="0.03" izz="0.04" ixy="0.002" ixz="-0.003" iyz="0.004"/></inertial></link>"""
JOINT = """<joint name="{0}" type="{1}"><parent link="{2}"/><child link="{3}"/>
  <origin xyz="0.2 0.1 -0.3" rpy="-0.4 0.7 1.1"/><axis xyz="{4}"/>{5}</joint>"""
DAMPED = '<dynamics damping="0.4"/>'
URDF = f"""<robot name="tree"><mujoco><compiler fusestatic="false"/></mujoco><link name="world"/>
  {"".join(map(LINK.format, ("base", "arm", "hand", "tool", "tail")))}
  {JOINT.format("float", "floating", "world", "base", "1 0 0", "")}
  {JOINT.format("shoulder", "continuous", "base", "arm", "0.6 0 0.8", DAMPED)}
  {JOINT.format("reach", "prismatic", "arm", "hand", "0 0.6 0.8", DAMPED + '<limit lower="0" upper="1"/>')}
  {JOINT.format("mount", "fixed", "hand", "tool", "1 0 0", "")}
  {JOINT.format("swing", "revolute", "base", "tail", "0 1 0", '<limit lower="-1" upper="1"/>')}
</robot>"""


@pytest.mark.filterwarnings("ignore::linkax.LeftOutWarning")
def test_a_tree_of_urdf_is_that_of_mujoco(tmp_path):
    (tmp_path / "tree.urdf").write_text(URDF)
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "tree.urdf"))
    mechanism = lx.load(tmp_path / "tree.urdf", ignore=["limit"]).mechanism()
    assert model.nv == mechanism.topology.num_speeds == 9
    assert worst_difference(mechanism, model) < 1e-10


BODY = """def Xform "{0}" (prepend apiSchemas = ["PhysicsRigidBodyAPI", "PhysicsMassAPI"])
  {{
    float physics:mass = 1
    float3 physics:diagonalInertia = (1, 1, 1)
    point3f physics:centerOfMass = (0, 0, 0)
  }}
"""
PIN = """def PhysicsRevoluteJoint "pin"
  {
    rel physics:body0 = </ground>
    rel physics:body1 = </arm>
  }
"""
GEOM = '<geom size="1" contype="0" conaffinity="0"/>'
GROUNDS = {
    "urdf": f"""<robot name="r">{LINK.format("ground")}{LINK.format("arm")}
      <joint name="pin" type="continuous"><parent link="ground"/><child link="arm"/></joint></robot>""",
    "sdf": f"""<sdf version="1.9"><model name="m">{SDF_LINK.format("ground", "")}{SDF_LINK.format("arm", "")}
      {SDF_JOINT.format("pin", "revolute", "ground", "arm")}</model></sdf>""",
    "xml": f"""<mujoco><worldbody><body name="ground"><freejoint/>{GEOM}
      <body name="arm"><joint name="pin"/>{GEOM}</body></body></worldbody></mujoco>""",
    "usda": f"#usda 1.0\n{BODY.format('ground')}{BODY.format('arm')}{PIN}",
}


@pytest.mark.parametrize("suffix", GROUNDS)
def test_a_body_of_a_file_may_be_named_ground(tmp_path, suffix):
    """It is another one than what stands still, and called so."""
    path = tmp_path / f"ground.{suffix}"
    path.write_text(GROUNDS[suffix])
    machine = lx.load(path, base="free")
    assert [part.name for part in machine.bodies] == ["ground.body", "arm"]
    pin = next(part.arguments for part in machine.joints if part.name == "pin")
    assert (pin["parent"].body, pin["child"].body) == ("ground.body", "arm")
    assert [item.kind for item in machine.left_out] == ["name"]
    assert machine.mechanism().topology.joints


@pytest.mark.parametrize(
    ("moments", "possible"),
    [((-1.0, 2.0, 3.0), (0.0, 2.0, 2.0)), ((1.0, 2.0, 4.0), (1.0, 2.0, 3.0)), ((-1e-16, 1.0, 1.0), (-1e-16, 1.0, 1.0))],
)
def test_an_inertia_that_no_body_has_is_the_nearest_where_that_is_asked_for(tmp_path, moments, possible):
    """Principal moments are not negative, and none exceeds the sum of the others, but for rounding."""
    given = " ".join(f'{name}="{moment}"' for name, moment in zip(("ixx", "iyy", "izz"), moments, strict=True))
    inertial = f'<inertial><mass value="1"/><inertia {given}/></inertial>'
    (tmp_path / "one.urdf").write_text(f'<robot name="r"><link name="one">{inertial}</link></robot>')
    if moments != possible:
        with pytest.raises(lx.MachineFileError, match=r'principal moments .* negative, or[\s\S]*ignore=\["inertia"\]'):
            lx.load(tmp_path / "one.urdf")
        with pytest.warns(lx.LeftOutWarning, match="taken as"):
            machine = lx.load(tmp_path / "one.urdf", ignore=["inertia"])
    else:
        machine = lx.load(tmp_path / "one.urdf")
    assert np.allclose(machine.bodies[0].arguments["inertia"], np.diag(possible), atol=1e-15)
