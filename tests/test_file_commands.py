"""Files of machines at the command line."""

import json

import mujoco
import numpy as np
import pytest

from linkax_command import run

LINK = """<link name="{name}"><inertial><origin xyz="{at}"/><mass value="1"/>
  <inertia ixx="0.1" iyy="0.1" izz="0.1"/></inertial></link>"""
FOUR_BAR = f"""<robot name="four_bar">
  <link name="frame"/>
  {LINK.format(name="crank", at="0 0 0.5")}
  {LINK.format(name="coupler", at="1 0 0")}
  {LINK.format(name="rocker", at="0 0 0.5")}
  <joint name="crank_bearing" type="continuous"><parent link="frame"/><child link="crank"/><axis xyz="0 1 0"/>
    <dynamics damping="0.2"/></joint>
  <joint name="crank_pin" type="continuous"><parent link="crank"/><child link="coupler"/><origin xyz="0 0 1"/>
    <axis xyz="0 1 0"/></joint>
  <joint name="rocker_bearing" type="continuous"><parent link="frame"/><child link="rocker"/><origin xyz="2 0 0"/>
    <axis xyz="0 1 0"/></joint>
  <joint name="rocker_pin" type="floating"><parent link="coupler"/><child link="rocker"/></joint>
  <loop name="pin" type="continuous"><predecessor link="coupler"><origin xyz="2 0 0"/></predecessor>
    <successor link="rocker"><origin xyz="0 0 1"/></successor><axis xyz="0 1 0"/></loop>
  <transmission name="motor"/>
</robot>"""


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "four_bar.urdf"
    path.write_text(FOUR_BAR)
    return str(path)


def test_inspect_tells_loops_freedoms_and_what_is_left_out(file, capsys):
    assert run(["inspect", file, "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert (told["loops"], told["degrees_of_freedom"], told["redundant_rows"]) == (2, 1, 3)
    assert told["position_violation"] < 1e-14
    assert [(item["line"], item["kind"]) for item in told["left_out"]] == [(18, "transmission")]
    assert run(["inspect", file]) == 0
    assert "cut  Revolute 'pin': coupler - rocker" in capsys.readouterr().out


def test_simulate_takes_a_file_of_a_tree(capsys, tmp_path):
    rod, axis = LINK.format(name="rod", at="0 0 0.5"), '<axis xyz="0 1 0"/>'
    hinge = f'<joint name="hinge" type="continuous"><parent link="frame"/><child link="rod"/>{axis}</joint>'
    (tmp_path / "rod.urdf").write_text(f'<robot name="rod"><link name="frame"/>{rod}{hinge}</robot>')
    settings = ["--t1", "0.3", "--preset", "draft", "--no-plots", "--json", "--hold", "hinge=0.2"]
    assert run(["simulate", str(tmp_path / "rod.urdf"), *settings, "--out", str(tmp_path / "out")]) == 0
    told = json.loads(capsys.readouterr().out)
    np.testing.assert_allclose(told["final"]["rod"], [0.5 * np.sin(0.2), 0.0, 0.5 * np.cos(0.2)], atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("held", [True, False])
def test_simulate_takes_a_file(held, file, capsys, tmp_path):
    settings = ["--t1", "0.3", "--preset", "draft", "--no-plots", "--json", "--set", "bodies.crank.mass=2"]
    hold = ["--hold", "crank_bearing=0.2"] if held else []
    assert run(["simulate", file, *settings, *hold, "--out", str(tmp_path / "out")]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["result"] == "successful"
    assert told["parameters"] == {"bodies.crank.mass": 2.0}
    expected = [2.0 + 0.5 * np.sin(0.2), 0.0, 0.5 * np.cos(0.2)]
    assert np.allclose(told["final"]["rocker"], expected, atol=1e-12) == held


def test_convert_writes_what_mujoco_reads(file, capsys, tmp_path):
    target = tmp_path / "four_bar.xml"
    assert run(["convert", file, str(target)]) == 0
    assert "written" in capsys.readouterr().out
    model = mujoco.MjModel.from_xml_path(str(target))
    assert (model.nv, model.nkey) == (3, 1)
    assert run(["convert", file, str(tmp_path / "four_bar.sdf")]) == 2
    assert "MJCF is written to .xml" in capsys.readouterr().err


BAD = (
    (["--hold", "crank=1"], r"has no joint 'crank' to hold"),
    (["--hold", "crank_pin=left"], "write --hold JOINT=VALUE"),
    (["--set", "bodies.crnk.mass=2"], r"'bodies.crnk.mass' (did you mean 'bodies.crank.mass'?)"),
    (["--variant", "home"], "no variant 'home'; known: drawn"),
)


@pytest.mark.parametrize(("options", "message"), BAD)
def test_bad_options_are_one_line(file, capsys, tmp_path, options, message):
    assert run(["simulate", file, "--no-plots", "--out", str(tmp_path / "out"), *options]) == 2
    assert message in capsys.readouterr().err


def test_a_scene_has_no_hold(capsys, tmp_path):
    assert run(["simulate", "pendulum", "--out", str(tmp_path / "out"), "--hold", "hinge"]) == 2
    assert "--hold is for files of machines" in capsys.readouterr().err


@pytest.mark.parametrize("text", ["<robot>", "<sofa/>", "<robot name='empty'/>"])
def test_a_broken_file_is_one_line(capsys, tmp_path, text):
    path = tmp_path / "broken.urdf"
    path.write_text(text)
    assert run(["inspect", str(path)]) == 2
    assert "broken.urdf" in capsys.readouterr().err
