"""Machines from URDF, with the ways in which it closes loops."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import linkax as lx

INERTIAL = '<inertial><mass value="1"/><inertia ixx="0.1" iyy="0.1" izz="0.1"/></inertial>'
TREE = """<robot name="four_bar">
  <link name="frame"/><link name="crank">{inertial}</link><link name="coupler">{inertial}</link>
  <link name="rocker">{inertial}</link><link name="coupler_end"/><link name="rocker_end"/>
  <joint name="crank_bearing" type="revolute">
    <parent link="frame"/><child link="crank"/><axis xyz="0 1 0"/>{more}
  </joint>
  <joint name="crank_pin" type="continuous">
    <parent link="crank"/><child link="coupler"/><origin xyz="0 0 1"/><axis xyz="0 1 0"/>
  </joint>
  <joint name="rocker_bearing" type="continuous">
    <parent link="frame"/><child link="rocker"/><origin xyz="2 0 0" rpy="0 0 0"/><axis xyz="0 1 0"/>
  </joint>
  <joint name="end1" type="fixed"><parent link="coupler"/><child link="coupler_end"/><origin xyz="2 0 0"/></joint>
  <joint name="end2" type="fixed"><parent link="rocker"/><child link="rocker_end"/><origin xyz="0 0 1"/></joint>
  {closed}
</robot>"""
CLOSED = {
    "loop": """<loop name="rocker_pin" type="revolute"><predecessor link="coupler"><origin xyz="2 0 0"/></predecessor>
      <successor link="rocker"><origin xyz="0 0 1"/></successor><axis xyz="0 1 0"/></loop>""",
    "constraint": """<constraint name="rocker_pin" type="revolute"><parent link="coupler"/><parent_origin xyz="2 0 0"/>
      <parent_axis xyz="0 1 0"/><child link="rocker"/><child_origin xyz="0 0 1"/></constraint>""",
    "two parents": """<joint name="rocker_pin" type="continuous"><parent link="coupler"/><child link="rocker_end"/>
      <origin xyz="2 0 0"/><axis xyz="0 1 0"/></joint>""",
}


def load(tmp_path, closed="", more="", **settings):
    path = tmp_path / "four_bar.urdf"
    path.write_text(TREE.format(inertial=INERTIAL, closed=closed, more=more))
    return lx.load(path, **settings)


def drawn_apart(machine, name):
    """How far the two ends of a joint are apart as drawn, from the offsets alone: nothing is turned."""
    ends = next(joint for joint in machine.joints if joint.name == name).arguments
    at = {"coupler": [0.0, 0.0, 1.0], "rocker": [2.0, 0.0, 0.0]}
    at |= {end: [2.0, 0.0, 1.0] for end in ("coupler_end", "rocker_end")}
    return np.abs(ends["parent"].offset + at[ends["parent"].body] - ends["child"].offset - at[ends["child"].body]).max()


@pytest.mark.parametrize("way", CLOSED)
def test_every_way_of_closing_a_loop_closes_it(tmp_path, way):
    machine = load(tmp_path, CLOSED[way])
    topology = machine.mechanism().topology
    assert topology.joints[topology.num_bodies :] == ("rocker_pin",)
    assert topology.num_immobile_rows == 3  # a planar loop
    assert drawn_apart(machine, "rocker_pin") == 0.0


def test_yaml_closes_loops(tmp_path):
    (tmp_path / "closed.yaml").write_text("closed_loop: [[coupler_end, rocker_end]]\ntype: [3d]\n")
    machine = load(tmp_path, closures=tmp_path / "closed.yaml")
    joint = machine.joints[-1]
    assert (joint.kind, joint.arguments["parent"].body, joint.arguments["cut"]) == (lx.Spherical, "coupler_end", True)
    (tmp_path / "closed.yaml").write_text("closed_loop: [[coupler_end, nobody]]\n")
    with pytest.raises(lx.MachineFileError, match=r"closed.yaml:1: .*'nobody'.*four_bar.urdf"):
        load(tmp_path, closures=tmp_path / "closed.yaml")


@pytest.mark.parametrize(
    ("word", "kind", "axes"),
    [("SPHERICAL", lx.Spherical, ""), ("FIXED", lx.Fixed, ""), ("UJOINT_ZY", lx.Universal, "zy")],
)
def test_yaml_makes_joints_of_types_that_urdf_has_not(tmp_path, word, kind, axes):
    """A universal joint turns about the first axis of its frame, then the second; what acted along it goes."""
    path = tmp_path / "types.yaml"
    path.write_text(f"joint_name: [crank_bearing]\njoint_type: [{word}]\nname_mot: [crank_pin]\n")
    machine = load(tmp_path, more='<dynamics damping="1"/><limit lower="1" upper="2"/>', closures=path)
    (joint,) = (part for part in machine.joints if part.name == "crank_bearing")
    assert joint.kind is kind
    found = [joint.arguments[name] for name in ("axis", "second_axis") if name in joint.arguments]
    assert np.array_equal(np.reshape(found, (-1, 3)), np.eye(3)[["xyz".index(axis) for axis in axes]])
    assert [part.name for part in machine.forces] == ["gravity"]
    told = {item.reason for item in machine.left_out if item.kind in ("joint", "name_mot")}
    assert {reason.split(" ")[0] for reason in told} == {"'crank_bearing.damper'", "'crank_bearing.limit'", "which"}
    assert machine.mechanism().topology.joints


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("joint_name: [crank_bearing]", "types.yaml:1: joint_name: it and joint_type must be lists of the same length"),
        ("joint_name: [crank_bearing]\njoint_type: [UJOINT_XX]", "'UJOINT_XX' is not known; known: SPHERICAL"),
        (
            "joint_name: [crank]\njoint_type: [FIXED]",
            r"'crank' is no joint of four_bar.urdf \(did you mean 'crank_pin'",
        ),
        ("closed_loops: []", r"closed_loops: it is not known \(did you mean 'closed_loop'"),
        ("closed_loop: [[crank, rocker]]\ntype: [7d]", "type '7d' of .* is not known; known: 3d, 6d"),
        ("3", "types.yaml:1: closed_loop: the file has no closed_loop; give"),
    ],
)
def test_what_a_yaml_file_may_not_say_is_named(tmp_path, text, message):
    (tmp_path / "types.yaml").write_text(text)
    with pytest.raises(lx.MachineFileError, match=message):
        load(tmp_path, closures=tmp_path / "types.yaml")


def test_the_four_bar_moves_as_one_written_by_hand(tmp_path):
    """The same accelerations, and derivatives in a number of the file."""
    machine = load(tmp_path, CLOSED["loop"])

    def by_hand(mass):
        bodies = [
            lx.RigidBody(name, mass if name == "coupler" else 1.0, inertia=(0.1, 0.1, 0.1))
            for name in ("crank", "coupler", "rocker")
        ]
        crank, coupler, rocker = bodies
        joints = [
            lx.Revolute("crank_bearing", lx.GROUND, crank, axis="y"),
            lx.Revolute("crank_pin", crank.at([0.0, 0.0, 1.0]), coupler, axis="y"),
            lx.Revolute("rocker_bearing", lx.GROUND.at([2.0, 0.0, 0.0]), rocker, axis="y"),
            lx.Revolute("rocker_pin", coupler.at([2.0, 0.0, 0.0]), rocker.at([0.0, 0.0, 1.0]), axis="y", cut=True),
        ]
        return lx.Mechanism(bodies, joints, [lx.Gravity([0.0, 0.0, -9.81])])

    from_file = lambda mass: machine.mechanism({"bodies": {"coupler": {"mass": mass}}})

    def accelerations(model):
        def at(mass):
            mechanism = model(mass)
            # A parallelogram, of which the coupler only translates.
            of_joint = {"crank_bearing": 1.0, "crank_pin": -1.0, "rocker_bearing": 1.0}
            turned = jnp.array([of_joint[name] for name in mechanism.topology.coordinates if name in of_joint])
            here = lx.Solution.of_state(mechanism, lx.State(0.3 * turned, turned))
            return here.acceleration("coupler")[0]

        return jax.jit(lambda mass: jax.jvp(at, (mass,), (1.0,)))(1.3)

    for found, expected in zip(accelerations(from_file), accelerations(by_hand), strict=True):
        assert np.abs(expected).max() > 0.01
        assert np.allclose(found, expected, rtol=1e-9, atol=1e-12)


def test_a_mimic_and_a_coupling_relate_joints(tmp_path):
    wheel = """<link name="wheel"/><joint name="wheel_bearing" type="continuous">
      <parent link="frame"/><child link="wheel"/><axis xyz="0 1 0"/>
      <mimic joint="crank_bearing" multiplier="-3" offset="0.2"/></joint>
      <coupling name="gear"><predecessor link="crank"/><successor link="wheel"/><ratio value="-3"/></coupling>"""
    found = {part.name: part.arguments for part in load(tmp_path, wheel).constraints}
    assert found["wheel_bearing.mimic"]["coefficients"] == {"wheel_bearing": 1.0, "crank_bearing": 3.0}
    assert found["wheel_bearing.mimic"]["offset"] == 0.2
    assert found["gear"]["coefficients"] == {"crank_bearing": 3.0, "wheel_bearing": 1.0}


def test_a_rotation_is_given_by_angles_or_by_a_quaternion(tmp_path):
    """R_z(yaw) R_y(pitch) R_x(roll), or x, y, z and w of a quaternion."""
    half, quarter = np.sin(np.pi / 4.0), np.pi / 2.0
    given = '<link name="{0}"/><joint name="{0}" type="fixed"><parent link="frame"/><child link="{0}"/>{1}</joint>'
    angles = given.format("angles", f'<origin rpy="{quarter} 0 {quarter}"/>')
    quaternion = given.format("quaternion", f'<origin quat_xyzw="0 0 {half} {half}"/>')
    placed = {part.name: part.arguments["parent"].rotation for part in load(tmp_path, angles + quaternion).joints}
    assert np.allclose(placed["angles"], [[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]], atol=1e-15)
    assert np.allclose(placed["quaternion"], [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]], atol=1e-15)
    with pytest.raises(lx.MachineFileError, match="origin: quat_xyzw is zero, or beside rpy; give one rotation"):
        load(tmp_path, given.format("both", '<origin rpy="0 0 1" quat_xyzw="0 0 0 1"/>'))


def test_a_loop_may_bear_the_name_of_a_joint(tmp_path):
    machine = load(tmp_path, CLOSED["loop"].replace("rocker_pin", "crank_pin"))
    assert [part.name for part in machine.joints if "crank_pin" in part.name] == ["crank_pin", "crank_pin.loop"]
    assert machine.mechanism().topology.num_cuts == 1


def test_stops_and_dampers(tmp_path):
    more = '<limit lower="-1" upper="2" effort="9" velocity="1"/><dynamics damping="0.4" friction="0.1"/>'
    machine = load(tmp_path, more=more)
    forces = machine.params["forces"]
    assert forces["crank_bearing.damper"]["damping"] == 0.4
    assert (forces["crank_bearing.limit"]["lower"], forces["crank_bearing.limit"]["upper"]) == (-1.0, 2.0)
    with pytest.warns(lx.LeftOutWarning, match=r"four_bar.urdf:5: .*range is ignored as asked"):
        without = load(tmp_path, more=more, ignore=["limit"])
    assert "crank_bearing.limit" not in without.params["forces"]


ACTS = {
    "damping": '<dynamics damping="3"/>',
    "friction": '<dynamics friction="2"/>',
    "limit": '<limit lower="-1" upper="1"/>',
    "mimic": '<mimic joint="crank_bearing"/>',
}
ELSEWHERE = """<link name="a">{inertial}</link><joint name="other" type="{kind}"><parent link="frame"/><child link="a"/>
  {acts}</joint>"""


@pytest.mark.parametrize("word", ACTS)
@pytest.mark.parametrize("kind", ["cylindrical", "planar", "floating", "spherical", "loop", "constraint"])
def test_what_acts_along_joints_is_not_dropped_in_silence(tmp_path, word, kind):
    """Of several coordinates, whose numbers would have several units, and where a loop is closed."""
    plain = CLOSED.get(kind, ELSEWHERE.format(inertial=INERTIAL, kind=kind, acts=""))
    end = f"</{kind}>" if kind in CLOSED else "</joint>"
    with pytest.raises(lx.MachineFileError, match=rf'ignore=\["{word}"\]'):
        load(tmp_path, plain.replace(end, ACTS[word] + end))
    idle = '<dynamics damping="0" friction="0"/><limit lower="0" upper="0" effort="1" velocity="1"/>'
    assert all(item.kind == "unread" for item in load(tmp_path, plain.replace(end, idle + end)).left_out)


def test_a_fixed_joint_stays_whatever_acts_along_it(tmp_path):
    fixed = lambda acts: ELSEWHERE.format(inertial=INERTIAL, kind="fixed", acts=acts)
    load(tmp_path, fixed(ACTS["damping"] + ACTS["limit"]))
    with pytest.raises(lx.MachineFileError, match="mimic: 'crank_bearing' is to lead a joint of type 'fixed'"):
        load(tmp_path, fixed(ACTS["mimic"]))


def test_words_to_ignore_are_checked(tmp_path):
    with pytest.raises(
        ValueError, match=r"ignore has 'limits' \(did you mean 'limit'\?\), which nothing in the file is"
    ):
        load(tmp_path, ignore=["limits"])
    with pytest.raises(ValueError, match="ignore is 3; give words"):
        load(tmp_path, ignore=3)


TURNS = """<link name="a"/><joint name="turns" type="revolute"><parent link="frame"/><child link="a"/>{}</joint>"""
WRONG = (
    ('<joint name="a" type="fixed"><parent link="frame"/><child link="nobody"/></joint>', r":15: child: .*'nobody'"),
    (
        '<loop name="a" type="gear"><predecessor link="crank"/><successor link="rocker"/></loop>',
        "a loop of type 'gear'",
    ),
    ('<link name="a"><inertial><mass value="x"/></inertial></link>', r":15: mass: value is 'x'; it must be 1 finite"),
    ('<link name="a"><inertial><mass value="1_5"/></inertial></link>', "value is '1_5'; it must be 1 finite number"),
    ('<link name="a"><inertial><mass value="١"/></inertial></link>', "value is '١'; it must be 1 finite number"),
    ('<link name="a"><inertia ixx="1"/></link>', r":15: inertia: <inertia> is not known \(did you mean 'inertial'"),
    (TURNS.format('<axes xyz="0 1 0"/>'), r"axes: <axes> is not known \(did you mean 'axis'"),
    (TURNS.format('<dynamics dampng="1"/>'), r"dynamics: attribute 'dampng' is not known \(did you mean 'damping'"),
    (TURNS.format('<axis/><axis xyz="0 1 0"/>'), "axis: <axis> is there already; take one out"),
    (TURNS.format('<mimic joint="turns"/>'), "'turns' follows 'turns', and that way itself"),
    (
        TURNS.format('<mimic joint="end1"/>'),
        "mimic: it follows 'end1', of type 'fixed', without one coord",
    ),
    (TURNS.replace("revolute", "universal").format("<axis/>"), "joint 'turns': a universal joint needs two axes"),
    ('<gazebo reference="crank"><turnGravityOff>true</turnGravityOff></gazebo>', "<gazebo> has <turnGravityOff>"),
    ("<gazebo><joint/></gazebo>", r'gazebo: <gazebo> has <joint>[\s\S]*ignore=\["gazebo"\]'),
    (
        '<link name="a"><inertial><mass value="1"/><inertia ixx="1" izz="1"/></inertial></link>',
        "inertia: it has no iyy; give",
    ),
    ("<drake:ball_constraint/>", r'ignore=\["drake:ball_constraint"\]'),
    ('<link name="crank"/>', "twice"),
)


@pytest.mark.parametrize(("closed", "message"), WRONG)
def test_what_the_format_does_not_allow_is_named_with_its_line(tmp_path, closed, message):
    with pytest.raises(lx.MachineFileError, match=message):
        load(tmp_path, closed)


def test_joints_that_follow_each_other_in_a_ring_are_refused(tmp_path):
    ring = TURNS.format('<mimic joint="crank_bearing"/>')
    with pytest.raises(lx.MachineFileError, match="'turns' follows 'crank_bearing', and that way itself"):
        load(tmp_path, ring, more='<mimic joint="turns"/>')


def test_what_no_reader_asks_for_is_told(tmp_path):
    """Elements and attributes that are not known, each with the element that they are in, and no more of them."""
    given = '<limit lower="-1" upper="1" effort="9" velocity="1"/><calibration rising="0"/><calibration rising="1"/>'
    plain = (
        '<gazebo reference="crank"><turnGravityOff>false</turnGravityOff></gazebo><transmission><joint/></transmission>'
    )
    machine = load(tmp_path, TURNS.format(given) + plain, more="<velocity/>")
    assert [str(item) for item in machine.left_out] == [
        *(f"four_bar.urdf:15: {tag}: <{tag}> does not move anything" for tag in ("gazebo", "transmission")),
        "four_bar.urdf:4: joint 'crank_bearing': <velocity> in it: not read",
        "four_bar.urdf:15: limit: effort, velocity in it: not read",
        "four_bar.urdf:15: joint 'turns': <calibration> in it: not read",
    ]


def test_names_of_parameters_are_checked(tmp_path):
    machine = load(tmp_path)
    with pytest.raises(ValueError, match=r"'crnk' \(did you mean 'crank'\?\), which four_bar.urdf has not"):
        machine.mechanism({"bodies": {"crnk": {"mass": 1.0}}})
    with pytest.raises(ValueError, match=r"link 'crank': it has no number 'weight'"):
        machine.mechanism({"bodies": {"crank": {"weight": 1.0}}})
    with pytest.raises(ValueError, match=r"'no\.\*' fits no parameter"):
        machine.freeze("no.*")
    frozen = machine.freeze("bodies.*.inertia", "joints.*")
    assert "joints" not in frozen.params
    assert set(frozen.params["bodies"]["crank"]) == {"mass", "center_of_mass"}
    assert "crank_pin" not in [part.name for part in machine.without("crank_*").joints]
