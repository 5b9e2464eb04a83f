"""Machines from SDF: Cassie with its closed loops, and what the format says of frames, axes and gears."""

from pathlib import Path

import numpy as np
import pytest
from beside_mujoco import check_loops

import linkax as lx

MACHINES = Path(__file__).parents[1] / "data" / "machines"
# Loops, degrees of freedom and redundant rows: a floating pelvis has 6, a leg 6 with its springs; the fourth file's
# pelvis slides. Of the loops of a leg the planar one from crank to foot has a redundant row.
CASSIE = {"cassie_v2": (4, 18, 2), "cassie_wo_gearbox_spring": (4, 13, 2)}


def cassie(name, **settings):
    with pytest.warns(lx.LeftOutWarning, match=rf"{name}.sdf:\d+: "):
        return lx.load(MACHINES / f"{name}.sdf", **({"ignore": ["contact", "limit"]} | settings))


@pytest.mark.slow
@pytest.mark.parametrize("name", CASSIE)
def test_cassie_closes_its_loops(name):
    check_loops(cassie(name).mechanism(), CASSIE[name])


@pytest.mark.slow
def test_a_leg_of_cassie_closes_its_loops():
    both = cassie("cassie_v2").mechanism()
    left = lambda parts: [part for part in parts if not part.name.startswith("right")]
    check_loops(lx.Mechanism(left(both.bodies), left(both.joints)), (2, 12, 1))


def test_whole_angles_make_planar_loops_of_those_that_are_meant_so():
    """A leg's loop from crank to foot turns about one direction, on the right but for the digits of its angles."""
    rounded, whole = (cassie("cassie_v2", whole_angles=given).mechanism().topology for given in (False, True))
    assert (rounded.num_immobile_rows, whole.num_immobile_rows) == (1, 2)


@pytest.mark.parametrize("name", ["cassie", "cassie_reduced", "cassie_simple"])
def test_other_cassies_load(name):
    machine = cassie(name, ignore=["contact", "limit", "inertia", "joint"])
    assert machine.mechanism().topology.num_cuts >= 4


def test_springs_dampers_and_masses_are_parameters():
    machine = cassie("cassie_v2")
    params = machine.params
    assert params["bodies"]["pelvis"]["mass"] == 10.33
    assert params["forces"]["left-knee-shin-joint.spring"] == {"stiffness": 1500.0, "free": 0.0}
    assert params["forces"]["left-tarsus-spring-joint.spring"]["stiffness"] == 1250.0
    assert np.shape(params["joints"]["left-knee-op"]["parent"]) == (3,)


FOUR_BAR = """<sdf version="{version}"><model name="four_bar">
  <link name="crank"><pose>0 0 0 0 0 0</pose>{inertial}</link>
  <link name="coupler"><pose>0 0 1 0 0 0</pose>{inertial}</link>
  <link name="rocker"><pose>2 0 0 0 0 0</pose>{inertial}</link>
  <joint name="crank_bearing" type="revolute"><parent>world</parent><child>crank</child>{axis}</joint>
  <joint name="crank_pin" type="revolute"><parent>crank</parent><child>coupler</child>{axis}</joint>
  <joint name="rocker_pin" type="revolute">
    <pose>0 0 1 0 0 0</pose><parent>coupler</parent><child>rocker</child>{axis}
  </joint>
  <joint name="rocker_bearing" type="revolute"><parent>world</parent><child>rocker</child>{axis}</joint>
  {more}
</model></sdf>"""
INERTIAL = "<inertial><mass>1</mass><inertia><ixx>0.1</ixx><iyy>0.1</iyy><izz>0.1</izz></inertia></inertial>"
ALONG_Y = "<axis><xyz>0 1 0</xyz></axis>"


def extra_link(name, axis, kind="revolute"):
    """A link on the crank, with its bearing."""
    joint = f'<joint name="{name}_bearing" type="{kind}"><parent>crank</parent><child>{name}</child>{axis}</joint>'
    return f'<link name="{name}">{INERTIAL}</link>{joint}'


def load(path, text, **settings):
    path.write_text(text)
    return lx.load(path, **settings)


def four_bar(tmp_path, version="1.7", inertial=INERTIAL, axis=ALONG_Y, more="", **settings):
    text = FOUR_BAR.format(version=version, inertial=inertial, axis=axis, more=more)
    return load(tmp_path / "four_bar.sdf", text, **settings)


def test_a_link_with_two_parents_closes_a_loop(tmp_path):
    mechanism = four_bar(tmp_path).mechanism()
    topology = mechanism.topology
    assert (topology.num_bodies, topology.num_cuts, topology.num_immobile_rows) == (3, 1, 3)


def test_an_axis_is_in_the_frame_that_the_file_says(tmp_path):
    turned = "<pose>{place} 0 0 1.5707963267948966</pose>"
    text = FOUR_BAR.format(version="1.7", inertial=INERTIAL, axis="<axis><xyz>0 1 0</xyz></axis>", more="")
    text = text.replace("<pose>0 0 0 0 0 0</pose>", turned.format(place="0 0 0"), 1)
    own = load(tmp_path / "own.sdf", text).joints[0]
    assert own.arguments["axis"].tolist() == [0.0, 1.0, 0.0]
    assert np.allclose(own.arguments["parent"].rotation @ own.arguments["axis"], [-1.0, 0.0, 0.0])
    model = load(tmp_path / "model.sdf", text.replace("<xyz>", '<xyz expressed_in="__model__">', 1)).joints[0]
    assert np.allclose(model.arguments["parent"].rotation @ model.arguments["axis"], [0.0, 1.0, 0.0])


@pytest.mark.parametrize(
    ("version", "flag", "in_model"),
    [
        ("1.4", "", True), ("1.5", "", False), ("1.9.0", "", False), ("1.10", "", False), ("1.12", "", False),
        ("1.6", "True", True), ("1.6", "1", True), ("1.6", "FALSE", False),
    ],
)  # fmt: skip
def test_an_axis_is_in_the_frame_of_its_version(tmp_path, version, flag, in_model):
    """Before 1.5 an axis is in the model's frame, and later in the joint's; 1.10 is later than 1.5."""
    flag = f"<use_parent_model_frame>{flag}</use_parent_model_frame>" if flag else ""
    text = FOUR_BAR.format(version=version, inertial=INERTIAL, axis=f"<axis><xyz>0 1 0</xyz>{flag}</axis>", more="")
    text = text.replace("<pose>0 0 0 0 0 0</pose>", "<pose>0 0 0 0 0 1.5707963267948966</pose>", 1)
    joint = load(tmp_path / "turned.sdf", text).joints[0].arguments
    expected = [0.0, 1.0, 0.0] if in_model else [-1.0, 0.0, 0.0]
    assert np.allclose(joint["parent"].rotation @ joint["axis"], expected)


def test_a_joint_is_placed_in_its_child_even_where_that_is_a_frame(tmp_path):
    """The pose of a joint is in the frame that <child> names, and the joint attaches to the link of that frame."""
    more = f"""<link name="tip"><pose>0 0 3 0 0 0</pose>{INERTIAL}</link>
    <frame name="end" attached_to="tip"><pose>0.5 0 0 0 0 0</pose></frame>
    <joint name="weld" type="fixed"><pose>0 0.25 0 0 0 0</pose><parent>crank</parent><child>end</child></joint>"""
    weld = next(joint for joint in four_bar(tmp_path, more=more).joints if joint.name == "weld").arguments
    assert weld["child"].body == "tip"
    assert np.allclose(weld["child"].offset, [0.5, 0.25, 0.0])


def test_the_pose_of_a_model_is_that_of_its_placement_frame(tmp_path):
    text = FOUR_BAR.format(version="1.9", inertial=INERTIAL, axis=ALONG_Y, more="<pose>5 0 0 0 0 0</pose>")
    text = text.replace('name="four_bar"', 'name="four_bar" placement_frame="rocker"')
    bearing = next(joint for joint in load(tmp_path / "placed.sdf", text).joints if joint.name == "rocker_bearing")
    assert np.allclose(bearing.arguments["parent"].offset, [5.0, 0.0, 0.0])


@pytest.mark.parametrize(("version", "place"), [("1.5", "<physics>{}</physics>"), ("1.6", "{}")])
def test_gravity_is_where_the_version_has_it(tmp_path, version, place):
    """Of the world since 1.6, before of its physics."""
    text = FOUR_BAR.format(version=version, inertial=INERTIAL, axis=ALONG_Y, more="")
    given = place.format("<gravity>0 0 -1.6</gravity>")
    text = text.replace("<model", f'<world name="moon">{given}<model').replace("</model>", "</model></world>")
    gravity = load(tmp_path / "moon.sdf", text).forces[0]
    assert gravity.arguments["acceleration"].tolist() == [0.0, 0.0, -1.6]


def test_springs_dampers_and_ends_along_each_axis(tmp_path):
    """τ = −stiffness (q − reference) − damping q̇, about <axis> and then <axis2>, where the axis of a ball has none."""
    along = """<{0}><xyz>{1}</xyz><limit><lower>-inf</lower><upper>{2}</upper></limit><dynamics><damping>{3}</damping>
      <spring_stiffness>{4}</spring_stiffness><spring_reference>0.2</spring_reference></dynamics></{0}>"""
    axes = along.format("axis", "1 0 0", 0.5, 1, 3) + along.format("axis2", "0 1 0", 1e16, 2, 4)
    machine = four_bar(tmp_path, more=extra_link("cross", axes, "universal") + extra_link("ball", ALONG_Y, "ball"))
    joint = next(part.arguments for part in machine.joints if part.name == "cross_bearing")
    assert [joint["axis"].tolist(), joint["second_axis"].tolist()] == [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]
    forces = {part.name: part.arguments for part in machine.forces}
    for index, name in enumerate(("cross_bearing", "cross_bearing.2")):
        spring, damper = forces[f"{name}.spring"], forces[f"{name}.damper"]
        assert spring["joint"] == damper["joint"] == ("cross_bearing", index)
        assert (spring["stiffness"], spring["free"], damper["damping"]) == (3.0 + index, 0.2, 1.0 + index)
    assert forces["cross_bearing.limit"]["upper"] == 0.5
    assert "lower" not in forces["cross_bearing.limit"]
    assert "cross_bearing.2.limit" not in forces
    assert [item.kind for item in machine.left_out] == ["axis"]


def test_a_mimic_follows_the_axis_that_it_names(tmp_path):
    """follower = multiplier (leader − reference) + offset."""
    axes = "<axis><xyz>1 0 0</xyz></axis><axis2><xyz>0 1 0</xyz></axis2>"
    mimic = '<mimic joint="{}" axis="axis2"><multiplier>2</multiplier><reference>0.1</reference></mimic>'
    follows = f"<axis><xyz>0 1 0</xyz>{mimic}</axis>"
    more = extra_link("cross", axes, "universal") + extra_link("wheel", follows.format("cross_bearing"))
    (coupling,) = four_bar(tmp_path, more=more).constraints
    assert coupling.arguments["coefficients"] == {"wheel_bearing": 1.0, ("cross_bearing", 1): -2.0}
    assert coupling.arguments["offset"] == pytest.approx(-0.2)
    with pytest.raises(lx.MachineFileError, match="no coordinate about axis, or axis2 of 'crank_bearing'"):
        four_bar(tmp_path, more=extra_link("wheel", follows.format("crank_bearing")))


LEADERS = [pytest.param(name, marks=pytest.mark.slow) for name in ("crank_bearing", "crank_pin", "rocker_bearing")]


@pytest.mark.parametrize("leader", ["rocker_pin", *LEADERS])
def test_a_mimic_follows_any_joint_of_a_loop(leader, tmp_path):
    """That of the joint where the loop would be cut, too."""
    mimic = f'<mimic joint="{leader}"><multiplier>2</multiplier><offset>0.3</offset><reference>0.1</reference></mimic>'
    follows = extra_link("wheel", f"<axis><xyz>0 1 0</xyz>{mimic}</axis>")
    mechanism = four_bar(tmp_path, more=follows).mechanism()
    start = lx.assemble(mechanism, speeds={"crank_bearing": 3.0})
    run = lx.simulate(mechanism, start, t1=0.3)
    assert np.ptp(run.joint(leader)) > 0.1
    np.testing.assert_allclose(run.joint("wheel_bearing"), 2.0 * (run.joint(leader) - 0.1) + 0.3, atol=1e-9)


def test_poses_are_relative_to_frames(tmp_path):
    more = """<frame name="top" attached_to="crank"><pose>0 0 1 0 0 0</pose></frame>
    <link name="tip"><pose relative_to="top" degrees="true">0.5 0 0 0 0 90</pose></link>
    <joint name="weld" type="fixed"><parent>top</parent><child>tip</child></joint>"""
    machine = four_bar(tmp_path, more=more)
    weld = next(joint for joint in machine.joints if joint.name == "weld")
    assert (weld.arguments["parent"].body, weld.arguments["child"].body) == ("crank", "tip")
    assert np.allclose(weld.arguments["parent"].offset, [0.5, 0.0, 1.0])
    assert np.allclose(weld.arguments["parent"].rotation[:, 0], [0.0, 1.0, 0.0])


@pytest.mark.parametrize(
    ("model", "attached", "link"),
    [("", "", "crank"), ("", ' attached_to="__model__"', "crank"), (' canonical_link="rocker"', "", "rocker")],
)
def test_a_frame_on_the_model_is_on_its_canonical_link(tmp_path, model, attached, link):
    """The first link of the file, whatever its name, or the one that the model names."""
    more = f"""<frame name="top"{attached}><pose>0 0 1 0 0 0</pose></frame><link name="tip">{INERTIAL}</link>
    <joint name="weld" type="fixed"><parent>top</parent><child>tip</child></joint>"""
    text = FOUR_BAR.format(version="1.7", inertial=INERTIAL, axis=ALONG_Y, more=more)
    machine = load(tmp_path / "on_model.sdf", text.replace('name="four_bar"', f'name="four_bar"{model}'))
    weld = next(joint for joint in machine.joints if joint.name == "weld")
    assert weld.arguments["parent"].body == link


def test_a_mimic_and_a_gearbox_are_couplings(tmp_path):
    follows = """<axis><xyz>0 1 0</xyz><mimic joint="crank_bearing">
      <multiplier>2</multiplier><offset>0.3</offset><reference>0.1</reference>
    </mimic></axis>"""
    rotor, wheel = extra_link("rotor", follows), extra_link("wheel", ALONG_Y)
    box = """<joint name="box" type="gearbox"><parent>rotor</parent><child>wheel</child>
      <gearbox_ratio>0.25</gearbox_ratio><gearbox_reference_body>crank</gearbox_reference_body>
      <axis><xyz>0 1 0</xyz></axis><axis2><xyz>0 -1 0</xyz></axis2>
    </joint>"""
    machine = four_bar(tmp_path, more=rotor + wheel + box)
    found = {part.name: part.arguments for part in machine.constraints}
    assert found["rotor_bearing.mimic"]["coefficients"] == {"rotor_bearing": 1.0, "crank_bearing": -2.0}
    assert found["rotor_bearing.mimic"]["offset"] == pytest.approx(0.1)
    # θ₂ = −ratio θ₁, with θ₂, of the child, about −y
    assert found["box"]["coefficients"] == {"rotor_bearing": 0.25, "wheel_bearing": -1.0}


# Gears of the motors, and armatures [kg m²], in MuJoCo's model of Cassie (`agility_cassie` of its Menagerie).
MOTORS = {
    "roll": (25, 0.038125),
    "yaw": (25, 0.038125),
    "pitch": (16, 0.09344),
    "knee": (16, 0.09344),
    "foot": (50, 0.01225),
}


def test_rotors_of_cassie_turn_as_its_gears_say():
    """A rotor turns `gear` times for one turn of the leg, so that its inertia there is gear² times as large."""
    machine = cassie("cassie", ignore=["contact", "limit", "inertia", "joint"])
    bodies, joints = ({part.name: part.arguments for part in of} for of in (machine.bodies, machine.joints))
    gearboxes = {part.name: part.arguments["coefficients"] for part in machine.constraints}
    for name, (gear, armature) in MOTORS.items():
        terms = gearboxes[f"left-{name}-joint"]
        rotor, leg = f"left-{name}-ip", f"left-{name}-op"
        assert terms[leg] / terms[rotor] == pytest.approx(gear)
        end = joints[rotor]["child"]
        axis = end.rotation @ joints[rotor]["axis"]
        reflected = axis @ bodies[end.body]["inertia"] @ axis * gear**2
        assert armature / 3.0 < reflected < 3.0 * armature


def test_stops_push_and_friction_holds(tmp_path):
    limit = "<limit><lower>-0.5</lower><upper>1e16</upper></limit>"
    axis = f"<axis><xyz>0 1 0</xyz>{limit}<dynamics><friction>0.2</friction></dynamics></axis>"
    forces = {part.name: part for part in four_bar(tmp_path, axis=axis).forces}
    stop = forces["crank_bearing.limit"]
    assert stop.kind is lx.JointLimit
    assert set(stop.params) == {"lower", "law"}
    assert forces["crank_bearing.friction"].params["torque"] == 0.2


@pytest.mark.parametrize(
    ("pitch", "advance"),
    [
        ("<screw_thread_pitch>0.01</screw_thread_pitch>", 0.01 / (2.0 * np.pi)),
        ("<thread_pitch>500</thread_pitch>", -1.0 / 500.0),
        ("<thread_pitch>500</thread_pitch><screw_thread_pitch>0.01</screw_thread_pitch>", 0.01 / (2.0 * np.pi)),
    ],
)
def test_a_screw_advances(tmp_path, pitch, advance):
    """By `screw_thread_pitch` for a turn, right-handed, or 1 m for `thread_pitch` rad, left-handed [m/rad]."""
    link = extra_link("nut", f"{ALONG_Y}{pitch}", "screw")
    thread = next(joint for joint in four_bar(tmp_path, more=link).joints if joint.name == "nut_bearing")
    assert thread.arguments["pitch"] == pytest.approx(advance)


def test_a_base_that_nothing_holds_is_free_or_fixed(tmp_path):
    link = f'<link name="body"><pose>0 0 2 0 0 0</pose>{INERTIAL}</link>'
    text = f'<sdf version="1.7"><model name="one">{link}</model></sdf>'
    free, fixed = (load(tmp_path / "one.sdf", text, base=base).joints[0] for base in (None, "fixed"))
    assert (free.kind, fixed.kind) == (lx.Free, lx.Fixed)
    assert free.arguments["parent"].offset.tolist() == [0.0, 0.0, 2.0]


JOINT = '<joint name="{name}" type="{kind}"><parent>{parent}</parent><child>crank</child></joint>'
IN_A_CIRCLE = """<frame name="a"><pose relative_to="b"/></frame><frame name="b"><pose relative_to="a"/></frame>
<link name="x"><pose relative_to="a"/></link>"""
WRONG = (
    (JOINT.format(name="j", kind="fixed", parent="nobody"), r"four_bar.sdf:11: parent: .*no link"),
    (JOINT.format(name="crank_pin", kind="fixed", parent="world"), "twice"),
    (JOINT.format(name="j", kind="belt", parent="world"), "type 'belt'"),
    (IN_A_CIRCLE, "circle"),
    ('<link name="x"><pose>0 0 zero 0 0 0</pose></link>', r":11: pose: .*'0 0 zero 0 0 0'; it must be 6 finite"),
    ("<link/>", "it has no name"),
    (JOINT.format(name="j", kind="fixed", parent="top") + '<frame name="top" attached_to="top"/>', "to itself; attach"),
    ('<link name="x"><inertial><mass>-1</mass></inertial></link>', r"link 'x'.*mass"),
    ("<include><uri>model://other</uri></include>", r'ignore=\["include"\]'),
    ('<link name="x"><pose rotation_format="quat_xyzw">0 0 0 0 0 0 0</pose></link>', "pose: its quaternion is 0 0 0 0"),
    ('<link name="x"><pose rotation_format="euler">0 0 0 0 0 0</pose></link>', "'euler'; known: euler_rpy, quat_xyzw"),
    ('<link name="x"><pose degrees="yes">0 0 0 0 0 0</pose></link>', "pose: 'yes' is neither true nor false"),
    (
        '<link name="x"><inertial><pose relative_to="crank"/></inertial></link>',
        "relative to 'crank'; give it in the link",
    ),
    (
        '<link name="x"><velocity_decay><linear>0,1</linear></velocity_decay></link>',
        "linear: its text is '0,1'; it must",
    ),
    (
        '<link name="x"><kinematic>true</kinematic></link>',
        r'the link is moved, and not by[\s\S]*ignore=\["kinematic"\]',
    ),
    (
        extra_link("x", "<axis><mimic joint='x_bearing'/></axis>"),
        "'x_bearing' follows 'x_bearing', and that way itself",
    ),
    (extra_link("x", f"{ALONG_Y}<thread_pitch>0</thread_pitch>", "screw"), "thread_pitch is 0; give radians for one"),
    (extra_link("x", ALONG_Y, "screw"), "it has no <screw_thread_pitch>"),
    (extra_link("x", "<axis><xyz>0 1 0</xyz><dynamic/></axis>"), r"<dynamic> is not known \(did you mean 'dynamics'"),
    ('<link name="x"><inertial><mass>1</mass><mass>2</mass></inertial></link>', "mass: <mass> is there already"),
)


@pytest.mark.parametrize(("more", "message"), WRONG)
def test_what_the_format_does_not_allow_is_named_with_its_line(tmp_path, more, message):
    with pytest.raises(lx.MachineFileError, match=message):
        four_bar(tmp_path, more=more)


def test_a_version_is_numbers(tmp_path):
    with pytest.raises(lx.MachineFileError, match="sdf: version is 'new'; give one such as"):
        four_bar(tmp_path, version="new")


def test_what_no_reader_asks_for_is_told(tmp_path):
    more = extra_link("x", "<axis><xyz>0 1 0</xyz><initial_position>1</initial_position></axis><sensor/><physics/>")
    machine = four_bar(tmp_path, more=f"{more}<plugin/>")
    assert [str(item).partition(": ")[2] for item in machine.left_out] == [
        "axis: where the joint is at the start; give it to linkax.assemble",
        "joint 'x_bearing': <sensor>, <physics> in it: not read",
        "model 'four_bar': <plugin> in it: not read",
    ]
