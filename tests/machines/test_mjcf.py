"""Machines from MJCF: what MuJoCo compiles, as linkax computes it."""

import sys
from pathlib import Path

import mujoco
import numpy as np
import pytest
from beside_mujoco import check_loops, matrix_of_speeds, positions, state_of, tree_dynamics

import linkax as lx

MACHINES = Path(__file__).parents[1] / "data" / "machines"
# A tree with all kinds of joints, several on one body, springs, dampers, rotors, a tendon and actuators; no loops.
TREE = """<mujoco model="tree">
  <compiler angle="degree"/>
  <option gravity="0.3 -0.2 -9.81"><flag contact="disable"/></option>
  <default>
    <joint damping="0.3"/>
    <default class="stiff"><joint stiffness="3" springref="20" armature="0.02"/></default>
  </default>
  <worldbody>
    <body name="base" pos="0 0.1 1" euler="10 30 -20">
      <freejoint name="float"/>
      <geom type="box" size="0.2 0.1 0.05" density="700" pos="0.02 0 0.01" euler="0 20 0"/>
      <body name="arm" pos="0.3 0 0" euler="0 0 40" gravcomp="0.4">
        <joint name="yaw" class="stiff" axis="0 0 1" pos="-0.1 0 0" ref="15"/>
        <joint name="lift" type="slide" axis="1 0 1" stiffness="50" springref="0.1"/>
        <geom type="capsule" size="0.03" fromto="0 0 0 0.4 0 0" mass="0.8"/>
        <body name="hand" pos="0.4 0 0">
          <joint name="wrist" type="ball" pos="0.05 0 0"/>
          <inertial pos="0.1 0.02 0" mass="0.5" fullinertia="0.004 0.005 0.006 0.0005 0.0002 -0.0001"/>
          <site name="tip" pos="0.2 0 0"/>
        </body>
      </body>
      <body name="tail" pos="-0.3 0 0">
        <joint name="swing" class="stiff" axis="0 1 0.2"/>
        <geom type="cylinder" size="0.05 0.2" pos="-0.1 0 0" euler="0 70 0"/>
      </body>
    </body>
  </worldbody>
  <tendon><fixed name="both" stiffness="4" damping="0.5" springlength="0.3">
    <joint joint="yaw" coef="1.5"/><joint joint="swing" coef="-0.5"/></fixed></tendon>
  <actuator>
    <position name="servo" joint="yaw" kp="5" kv="0.3" gear="2"/>
    <motor name="motor" joint="swing" gear="3"/>
    <general name="general" tendon="both" biastype="affine" gaintype="affine" gainprm="2 0.3 0.1"
      biasprm="0.1 -3 -0.4"/>
  </actuator>
</mujoco>"""
CONTROLS = {"servo": 0.4, "motor": -0.2, "general": 0.7}


def compiled(text):
    """MuJoCo's model of a text, without the meshes that are not there."""
    spec = mujoco.MjSpec.from_string(text)
    missing = [mesh for mesh in spec.meshes if not (Path(spec.meshdir) / mesh.file).is_file()]
    for geom in [geom for geom in spec.geoms if geom.meshname in [mesh.name for mesh in missing]]:
        spec.delete(geom)
    for mesh in missing:
        spec.delete(mesh)
    return spec.compile()


def with_states(text, path, count, seed):
    """MuJoCo's model of a text, random states of it, and a file that has them as keyframes."""
    model = compiled(text)
    rng = np.random.default_rng(seed)
    words = lambda numbers: " ".join(map(repr, numbers.tolist()))
    states = []
    for _ in range(count):
        qpos = np.array(model.qpos0)
        mujoco.mj_integratePos(model, qpos, rng.normal(size=model.nv), 1.0)
        states.append((qpos, rng.normal(size=model.nv)))
    keys = "".join(f'<key qpos="{words(qpos)}" qvel="{words(qvel)}"/>' for qpos, qvel in states)
    path.write_text(text.replace("</mujoco>", f"<keyframe>{keys}</keyframe></mujoco>"))
    return model, states


def of_package(name, *disabled):
    """The text of a machine of a package, with what MuJoCo's solver computes disabled."""
    text = (MACHINES / f"{name}.xml").read_text()
    flags = "".join(f' {what}="disable"' for what in ("contact", "limit", "frictionloss", "equality", *disabled))
    text = text.replace('meshdir="meshes"', f'meshdir="{MACHINES / "meshes"}"')
    return text.replace("<worldbody>", f"<option><flag{flags}/></option><worldbody>", 1)


TREES = {
    "of all joints": (TREE, CONTROLS),
    "2F-85": (of_package("robotiq_2f85_v2"), {"fingers_actuator": 40.0}),
    "xArm": (of_package("xarm7_gripper"), {"fingers_actuator": 60.0}),
    "constraints": (of_package("constraints", "actuation"), {}),
}


@pytest.mark.filterwarnings("ignore::linkax.LeftOutWarning")
@pytest.mark.parametrize("name", TREES)
def test_a_tree_moves_as_in_mujoco(name, tmp_path):
    """Places, mass matrix and acceleration at random states, to 1e-10 of the largest entry."""
    text, controls = TREES[name]
    model, states = with_states(text, tmp_path / "tree.xml", 20, seed=0)
    machine = lx.load(tmp_path / "tree.xml", folders=[MACHINES], ignore=["contact", "tendon"])
    mechanism = machine.mechanism({"forces": {name: {"control": value} for name, value in controls.items()}})
    data, full = mujoco.MjData(model), np.zeros((model.nv, model.nv))
    of_file = {model.body(index).name: index for index in range(model.nbody)}
    bodies = [of_file[name] for name in mechanism.topology.bodies if name in of_file]
    named = [index for index, name in enumerate(mechanism.topology.bodies) if name in of_file]
    for (qpos, qvel), start in zip(states, list(machine.starts.values())[-20:], strict=True):
        data.qpos, data.qvel, data.ctrl = qpos, qvel, list(controls.values()) or 0.0
        mujoco.mj_forward(model, data)
        state = state_of(mechanism, start)
        mass, force, centers = tree_dynamics(mechanism, state)
        acceleration = np.linalg.solve(mass, force)
        into = matrix_of_speeds(model, mechanism, start.positions, data.qpos)
        mujoco.mj_fullM(model, data, full)
        assert np.abs(into @ data.qvel - state.v).max() < 1e-13
        assert np.abs(centers[np.array(named)] - data.xipos[bodies]).max() < 1e-12
        assert np.abs(into.T @ mass @ into - full).max() < 1e-10 * np.abs(full).max()
        assert np.abs(into @ data.qacc - acceleration).max() < 1e-10 * np.abs(acceleration).max()


def test_two_connects_between_the_same_bodies_are_a_hinge(tmp_path):
    path = tmp_path / "four_bar.xml"
    joint = '<joint name="{name}" axis="0 1 0"/>'
    bar = f'<body name="{{name}}" pos="{{pos}}">{joint}<geom size="0.1" pos="{{at}}"/>{{inside}}</body>'
    coupler = bar.format(name="coupler", pos="0 0 1", at="1 0 0", inside="")
    crank = bar.format(name="crank", pos="0 0 0", at="0 0 1", inside=coupler)
    rocker = bar.format(name="rocker", pos="2 0 0", at="0 0 1", inside="")
    connects = "".join(f'<connect body1="coupler" body2="rocker" anchor="2 {y} 0"/>' for y in (-0.1, 0.1))
    path.write_text(
        f'<mujoco><option><flag contact="disable"/></option><worldbody>{crank}{rocker}</worldbody>'
        f"<equality>{connects}</equality></mujoco>"
    )
    machine = lx.load(path)
    topology = machine.mechanism().topology
    assert [kind.__name__ for kind in topology.joint_types[topology.num_bodies :]] == ["Revolute"]
    assert (topology.num_rows, topology.num_immobile_rows) == (2, 3)
    state = lx.assemble(machine.mechanism(), {"crank": 0.4})
    assert np.allclose(state.q, [0.4, 0.4, -0.4], atol=1e-12) or np.allclose(
        sorted(abs(state.q)), [0.4] * 3, atol=1e-12
    )


ONE_NAME = """<mujoco><option><flag contact="disable"/></option><worldbody>
    <body name="arm"><joint name="arm" axis="0 1 0" stiffness="2" damping="1"/><geom name="arm" size="0.1" pos="1 0 0"/>
      <site name="arm"/></body>
    <body name="arm.spring"><joint name="arm.spring" axis="0 1 0"/><geom size="0.1" pos="1 0 0"/></body>
    <body name="hand"><geom size="0.1"/></body></worldbody>
  <tendon><fixed name="arm" stiffness="3"><joint joint="arm" coef="0.5"/></fixed></tendon>
  <equality><joint name="arm" joint1="arm" joint2="arm.spring"/></equality>
  <actuator><motor name="arm" joint="arm" gear="2"/><motor name="hand.fixed" joint="arm"/>
    <motor name="gravity" joint="arm"/></actuator>
  <sensor><jointpos name="arm" joint="arm"/></sensor><keyframe><key name="arm" qpos="0.2 0.2"/></keyframe></mujoco>"""


def test_names_are_unique_for_each_kind_in_the_file_and_for_all_in_a_mechanism(tmp_path):
    """Bodies and joints keep theirs, others get their kind added, and what renamed them is told with its line."""
    (tmp_path / "arm.xml").write_text(ONE_NAME)
    machine = lx.load(tmp_path / "arm.xml")
    assert [part.name for part in machine.bodies] == ["arm", "arm.spring", "hand"]
    assert [part.name for part in machine.joints] == ["arm", "arm.spring", "hand.fixed"]
    assert [part.name for part in machine.constraints] == ["arm.equality"]
    springs = {"arm.spring.joint": 2.0, "arm.spring.tendon": 3.0}
    motors = {"arm.actuator", "hand.fixed.actuator", "gravity.actuator"}
    assert {part.name for part in machine.forces} == {"gravity", "arm.damper", *springs, *motors}
    assert machine.params["forces"]["arm.spring.joint"]["stiffness"] == 2.0
    renamed = [item for item in machine.left_out if item.kind == "name"]
    assert len(renamed) == 6
    assert "it is 'arm.actuator' here, since another has the name 'arm'" in repr(machine)
    mechanism = machine.mechanism({"forces": {"arm.actuator": {"control": 0.5}}})
    assert set(mechanism.topology.joints) == {"arm", "arm.spring", "hand.fixed"}


DRIVEN = """<mujoco><worldbody><body name="arm"><joint name="pin" axis="0 1 0" {joint}/>
    <geom size="0.1" contype="0" conaffinity="0"/></body></worldbody>
  <tendon><fixed name="belt" {tendon}><joint joint="pin" coef="0.5"/></fixed></tendon>
  <actuator>{actuators}</actuator></mujoco>"""


def driven(path, joint="", tendon="", actuators=""):
    path.write_text(DRIVEN.format(joint=joint, tendon=tendon, actuators=actuators))
    return lx.load(path)


def motor(name, on):
    return f'<general name="{name}" gear="-2" forcerange="-1 2" {on}/>'


@pytest.mark.parametrize(("on", "target"), [("joint", "pin"), ("tendon", "belt")])
def test_an_actuator_keeps_the_range_of_what_it_acts_on(tmp_path, on, target):
    """F is from −1 N m to 2 N m, and −2 F from −3 N m to 5 N m."""
    given = {on: 'actuatorfrcrange="-3 5"', "actuators": motor("motor", f'{on}="{target}"')}
    machine = driven(tmp_path / "driven.xml", **given)
    assert machine.params["forces"]["motor"]["force_range"].tolist() == [-1.0, 1.5]


def test_a_control_of_zero_is_clamped_as_in_mujoco(tmp_path):
    machine = driven(
        tmp_path / "driven.xml", actuators='<motor name="motor" joint="pin" ctrlrange="1 2" ctrllimited="true"/>'
    )
    assert machine.params["forces"]["motor"]["control"] == 1.0
    assert [item.reason for item in machine.left_out] == ["controls you give are not clamped to 1 to 2"]


def test_what_the_file_disables_is_not_there(tmp_path):
    """All that MuJoCo computes as constraints: ranges, dry friction, equalities; actuators by groups."""
    joint = 'range="-1 1" limited="true" frictionloss="2" damping="3"'
    motors = '<motor name="off" joint="pin" group="2"/><motor name="on" joint="pin" group="1"/>'
    machine = driven(tmp_path / "driven.xml", joint=joint, actuators=motors)
    names = {"gravity", "pin.damper", "pin.limit", "pin.friction", "off", "on"}
    assert {part.name for part in machine.forces} == names
    option = '<option actuatorgroupdisable="2"><flag constraint="disable"/></option>'
    held = '<equality><joint joint1="pin"/></equality>'
    text = (tmp_path / "driven.xml").read_text().replace("<mujoco>", f"<mujoco>{option}{held}")
    (tmp_path / "disabled.xml").write_text(text)
    machine = lx.load(tmp_path / "disabled.xml")
    assert {part.name for part in machine.forces} == names - {"pin.limit", "pin.friction", "off"}
    assert machine.constraints == ()


def test_pairs_in_contact_are_not_dropped_in_silence(tmp_path):
    geom = '<geom name="{0}" size="0.1" contype="0" conaffinity="0"/>'
    body = f'<body name="{{0}}"><joint name="{{0}}"/>{geom}</body>'
    pair = '<contact><pair geom1="a" geom2="b"/></contact>'
    bodies = "".join(map(body.format, "ab"))
    (tmp_path / "pair.xml").write_text(f"<mujoco><worldbody>{bodies}</worldbody>{pair}</mujoco>")
    with pytest.raises(lx.MachineFileError, match="contact of 1 <pair>"):
        lx.load(tmp_path / "pair.xml", ignore=[])


LIMITED = {"joint": 'actuatorfrcrange="-3 5"'}
TWO = motor("first", 'joint="pin"') + motor("second", 'joint="pin"')
NEWER = [
    (
        {"actuators": '<pid name="pid" joint="pin" kp="3"/>' + motor("motor", 'joint="pin"')},
        "an actuator that is not affine",
    ),
    ({"actuators": motor("motor", 'joint="pin" damping="3"')}, "its own damping"),
    ({"actuators": motor("motor", 'joint="pin" armature="3"')}, "its own armature"),
    (LIMITED | {"actuators": TWO}, "the range of the force on its joint, on which others act"),
    (LIMITED | {"actuators": motor("motor", 'tendon="belt"')}, "the range of the force on a joint of its tendon"),
    ({"joint": 'stiffness="2" springyield="0.1"'}, "nonlinear terms, jnt_springyield"),
    ({"tendon": 'stiffness="2 1"'}, "nonlinear terms, tendon_stiffnesspoly"),
]


@pytest.mark.parametrize(("given", "message"), NEWER)
def test_what_newer_versions_of_mujoco_have_is_not_dropped_in_silence(tmp_path, given, message):
    with pytest.raises(lx.MachineFileError, match=message):
        driven(tmp_path / "driven.xml", **given)


CARRIED = """<mujoco>{option}<worldbody><body name="arm"><joint name="pin" axis="0 1 0" {pin}/><geom size="0.1" {rest}/>
    <body name="load" gravcomp="{part}"><joint name="hook" axis="0 1 0" {hook}/>
      <geom size="0.1" pos="1 0 0" {rest}/></body></body></worldbody><actuator>{motor}</actuator></mujoco>"""
CARRIES = {"option": "", "pin": 'actuatorgravcomp="true"', "hook": "", "part": "1", "motor": '<motor joint="hook"/>'}
CARRIES["rest"] = 'contype="0" conaffinity="0"'
DISABLED = '<option><flag actuation="disable"/></option>'


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({}, None),
        ({"pin": 'actuatorfrcrange="-1 1"'}, None),
        ({"hook": 'actuatorfrcrange="-1 1"'}, None),
        ({"pin": CARRIES["pin"] + ' actuatorfrcrange="-1 1"', "part": "0"}, None),
        (
            {"pin": CARRIES["pin"] + ' actuatorfrcrange="-1 1"'},
            "joint 'pin': the range of its force limits",
        ),
        ({"motor": ""}, "joint 'pin': MuJoCo leaves out, without an actuator, what carries"),
        ({"option": DISABLED}, "joint 'pin': MuJoCo leaves out, without an actuator, what carries"),
    ],
)
def test_weight_that_actuators_carry_is_carried_or_it_is_told(tmp_path, given, message):
    """MuJoCo's range of a joint limits what carries a weight along it, and without actuators nothing does."""
    path, text = tmp_path / "carried.xml", CARRIED.format(**CARRIES | given)
    path.write_text(text)
    if message is not None:
        with pytest.raises(lx.MachineFileError, match=message):
            lx.load(path)
        return
    model = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    machine = lx.load(path)
    solution = lx.Solution.of_state(machine.mechanism(), lx.assemble(machine.mechanism(), {"pin": 0.0, "hook": 0.0}))
    found = [solution.joint_acceleration(name)[0] for name in ("pin", "hook")]
    np.testing.assert_allclose(found, data.qacc, rtol=1e-9, atol=1e-9)
    assert machine.left_out == ()


STRAIGHT = """<mujoco><worldbody><site name="wall" pos="0 0 2"/><site name="floor"/>
  <body name="arm" pos="1 0 0"><joint axis="0 1 0"/><geom size="0.1" contype="0" conaffinity="0"/>
    <site name="tip" pos="0 0 2"/></body></worldbody>
  <tendon>{tendons}</tendon>{more}</mujoco>"""
TENDON = '<spatial name="{name}" {numbers}><site site="{first}"/><site site="tip"/></spatial>'


def straight(path, more="", **tendons):
    """A machine with straight tendons from the wall to the tip of its arm, 1 m away as drawn, by their numbers."""
    text = "".join(TENDON.format(name=name, numbers=numbers, first="wall") for name, numbers in tendons.items())
    path.write_text(STRAIGHT.format(tendons=text, more=more))
    return lx.load(path)


def test_straight_tendons_are_springs_dampers_and_rods(tmp_path):
    held = '<equality><tendon name="rod" tendon1="{}" polycoef="0.25 1 0 0 0"/></equality>'.format
    numbers = {"soft": 'stiffness="3" damping="2" springlength="0.4"', "drawn": 'stiffness="5"', "bare": ""}
    machine = straight(tmp_path / "straight.xml", held("bare"), **numbers)
    ends = {"first": [0.0, 0.0, 2.0], "second": [0.0, 0.0, 2.0]}
    params = lambda name: {key: np.array(entry).tolist() for key, entry in machine.params["forces"][name].items()}
    assert params("soft.spring") == {**ends, "stiffness": 3.0, "free_length": 0.4}
    assert params("soft.damper") == {**ends, "damping": 2.0}
    assert params("drawn.spring") == {**ends, "stiffness": 5.0, "free_length": 1.0}
    (rod,) = (joint for joint in machine.joints if joint.kind is lx.Distance)
    assert (rod.name, rod.params["length"], rod.arguments["parent"].body) == ("rod", 1.25, "ground")
    assert [part.name for part in machine.forces] == ["gravity", "soft.spring", "soft.damper", "drawn.spring"]


@pytest.mark.parametrize(
    ("numbers", "more", "message"),
    [
        ('stiffness="3" springlength="0.2 0.4"', "", "a spring with a range of lengths without force"),
        ('range="0 2"', "", "range, dry friction or armature"),
        ("", '<equality><tendon tendon1="line" tendon2="other"/></equality>', "a spatial tendon"),
    ],
)
def test_other_spatial_tendons_are_not_dropped_in_silence(tmp_path, numbers, more, message):
    with pytest.raises(lx.MachineFileError, match=message):
        straight(tmp_path / "line.xml", more, line=numbers, other="")


@pytest.mark.filterwarnings("ignore::linkax.LeftOutWarning")
@pytest.mark.slow
@pytest.mark.parametrize(("name", "freedoms"), [("robotiq_2f85_v2", 3), ("xarm7_gripper", 1)])
def test_grippers_close_their_loops(name, freedoms):
    mechanism = lx.load(MACHINES / f"{name}.xml").mechanism()
    check_loops(mechanism, (2, freedoms, 2), lx.assemble(mechanism, {"right_driver_joint": 0.3}))


@pytest.mark.filterwarnings("ignore::linkax.LeftOutWarning")
def test_every_equality_of_mujoco_is_read():
    machine = lx.load(MACHINES / "constraints.xml", ignore=["contact", "tendon", "limit", "actuator"])
    kinds = {part.name: part.kind.__name__ for part in (*machine.joints, *machine.constraints)}
    read = {name: kinds[name] for name in ("c_site", "connect", "w_site", "weld", "joint", "tendon")}
    assert read == {
        "c_site": "Spherical", "connect": "Spherical", "w_site": "Fixed", "weld": "Fixed",
        "joint": "PolynomialCoupling", "tendon": "PolynomialCoupling",
    }  # fmt: skip


@pytest.mark.filterwarnings("ignore::linkax.LeftOutWarning")
def test_equalities_hold_in_mujoco_where_loops_are_closed():
    """Of connects, welds at any pose, between bodies and sites, and of polynomials of joints."""
    machine = lx.load(MACHINES / "constraints.xml", ignore=["contact", "tendon", "limit", "actuator"])
    mechanism = machine.mechanism()
    state = lx.assemble(mechanism)
    model = compiled((MACHINES / "constraints.xml").read_text())
    data = mujoco.MjData(model)
    data.qpos = positions(model, mechanism, dict(machine.starts)["key"].positions, state.q)
    mujoco.mj_forward(model, data)
    held = data.efc_type[: data.nefc] == mujoco.mjtConstraint.mjCNSTR_EQUALITY.value

    assert held.sum() == 3 + 3 + 6 + 6 + 1 + 1
    assert np.abs(data.efc_pos[: data.nefc][held]).max() < 1e-9


def test_a_polynomial_is_of_coordinates_from_where_the_machine_is_drawn(tmp_path):
    """y − y₀ = a₀ + a₁ (x − x₀) + … + a₄ (x − x₀)⁴, with x₀ and y₀ the `ref` of both joints."""
    joint = '<body name="{0}"><joint name="{0}" axis="0 1 0" ref="{1}"/><geom size="0.1" pos="1 0 0"/></body>'
    bodies = joint.format("y", 30) + joint.format("x", -20)
    text = f"""<mujoco><option><flag contact="disable"/></option><worldbody>{bodies}</worldbody>
      <equality><joint joint1="y" joint2="x" polycoef="0.1 0.5 0.2 -0.3 0.05"/></equality></mujoco>"""
    (tmp_path / "cam.xml").write_text(text)
    mechanism = lx.load(tmp_path / "cam.xml").mechanism()
    state, model = lx.assemble(mechanism, {"x": 0.7}), compiled(text)
    data = mujoco.MjData(model)
    data.qpos = positions(model, mechanism, ["y", "x"], state.q)
    mujoco.mj_forward(model, data)
    assert np.abs(data.efc_pos[: data.nefc]).max() < 1e-12
    here = lx.Solution.of_state(mechanism, state)
    assert here.joint("x")[0] == pytest.approx(0.7)
    assert here.joint("y")[0] == pytest.approx(np.polynomial.polynomial.polyval(0.7, [0.1, 0.5, 0.2, -0.3, 0.05]))


def test_without_mujoco_the_error_says_what_to_install(tmp_path, monkeypatch):
    (tmp_path / "tree.xml").write_text(TREE)
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(lx.MachineFileError, match=r"pip install 'linkax\[files\]'"):
        lx.load(tmp_path / "tree.xml")


WRONG = (
    ("<mujoco><worldbody><body/></mujoco>", r"broken.xml:1: no XML"),
    ('<mujoco><worldbody><body><joint type="belt"/></body></worldbody></mujoco>', "MuJoCo does not read it.*line 1"),
    ("<mujoco><worldbody><body><joint/></body></worldbody></mujoco>", "MuJoCo does not read it"),
    ('<mujoco><include file="../../etc/passwd"/></mujoco>', "include: .* lies outside of the file's folder"),
    ('<mujoco><include file="broken.xml"/></mujoco>', "files include each other"),
    ('<mujoco><asset><mesh file="/etc/hosts"/></asset></mujoco>', "mesh: .* lies outside of the file's folder"),
)


def test_a_name_or_a_file_name_that_mujoco_does_not_read(tmp_path):
    head = '<?xml version="1.0" encoding="iso-8859-1"?>'
    text = f'{head}<mujoco><worldbody><body name="a"><geom name="ä" size="1"/></body></worldbody></mujoco>'
    (tmp_path / "latin.xml").write_bytes(text.encode("latin-1"))
    with pytest.raises(lx.MachineFileError, match=r"latin.xml: a name in it is not in UTF-8; save it so"):
        lx.load(tmp_path / "latin.xml")
    (tmp_path / "upper.XML").write_text(TREE)
    with pytest.raises(lx.MachineFileError, match=r"upper.XML: .*end in .xml; rename it"):
        lx.load(tmp_path / "upper.XML")


@pytest.mark.parametrize(("text", "message"), WRONG)
def test_a_broken_file_is_named_with_its_line(tmp_path, text, message):
    path = tmp_path / "broken.xml"
    path.write_text(text)
    with pytest.raises(lx.MachineFileError, match=message):
        lx.load(path)
