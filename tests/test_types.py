"""What a type checker says of programs of users: nothing of right ones, and what is wrong of wrong ones."""

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
BLOCKS = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
RIGHT = """
import jax.numpy as jnp
import numpy as np

import linkax as lx

arm = lx.rod("arm", length=1, mass=np.float64(2.0))
box = lx.box("box", [1.0, 0.2, 0.3], 4.0)
point = lx.point_mass("point", mass=jnp.array(1.0))
joints = [
    lx.Revolute("hinge", lx.GROUND, arm.at("base"), axis="z"),
    lx.Prismatic("slide", arm, box, axis=(1.0, 0.0, 0.0)),
    lx.Spherical("ball", box.at([1.0, 0.0, 0.0]), point),
    lx.Universal("cross", lx.GROUND, box, axis=np.array([1.0, 0.0, 0.0]), second_axis="y", cut=True),
    lx.Cylindrical("sleeve", lx.GROUND, box, axis=jnp.array([1.0, 0.0, 0.0])),
]
forces = [
    lx.Gravity([0, -9.81, 0]),
    lx.Spring(arm.at("tip"), point, stiffness=10, free_length=0.5),
    lx.JointTorque("hinge", lambda t, motion: jnp.sin(t)),
]
mechanism = lx.Mechanism([arm, box, point], joints, forces, [lx.Drive("motor", "hinge", lambda t: 2.0 * t)])
steady = lx.Drive("steady", ("ball", 1), speed=2, start=np.float64(0.3))
state = lx.assemble(mechanism, {"hinge": 0.3}, {("ball", 1): 0.0}, guess={"slide": 1})
rough = {"hinge": 0.3, "box": lx.Pose([1.0, 0.0, 0.0]), "arm.tip": [1.0, 0.1, 0.0]}
state = lx.assemble(mechanism, {"box": lx.Pose([1.0, 0, 0])}, {"arm": lx.Velocity(angular=[0, 0, 1])}, guess=rough)
bar = lx.rod_between("bar", [0.0, 0.0, 1.0], np.zeros(3), mass=1, thickness=0.1)
plate = lx.RigidBody("plate", 1.0, inertia=0.2).placed([0.0, 1.0, 0.0]).at_world([0.0, 1.5, 0.0])
state = lx.assemblies(mechanism, {"hinge": 0.3}, tries=10)[0]
formulation = lx.TangentSpace(metric="identity")
solution = lx.simulate(mechanism, state, t1=2, accuracy=lx.Accuracy(1e-6), formulation=formulation)
print(solution.position("arm", at="tip")[-1], solution.reaction("hinge").force, lx.mobility(mechanism, state).rank)
"""
WRONG = {
    'lx.rod("arm", length="1.0", mass=1.0)': "length",
    "lx.Mechanism(arm, hinge)": "bodies",
    'lx.simulate(mechanism, state, t1="2")': "t1",
    'lx.Revolute("hinge", lx.GROUND)': "child",
    'lx.Gravity("down")': "",
}
BEGIN = """
import linkax as lx

arm = lx.rod("arm", length=1.0, mass=1.0)
hinge = lx.Revolute("hinge", lx.GROUND, arm.at("base"), axis="z")
mechanism = lx.Mechanism([arm], [hinge])
state = lx.assemble(mechanism)
"""


def errors_of(programs, folder):
    """Errors by the program that they are in, with their lines."""
    for name, text in programs.items():
        (folder / f"{name}.py").write_text(text)
    source = str(ROOT / "src")
    (folder / "pyrightconfig.json").write_text(json.dumps({"typeCheckingMode": "basic", "extraPaths": [source]}))
    command = [sys.executable, "-m", "pyright", "--outputjson", "--pythonpath", sys.executable, "-p", folder]
    done = subprocess.run(command, capture_output=True, text=True)
    errors = {name: [] for name in programs}
    for found in json.loads(done.stdout)["generalDiagnostics"]:
        if found["severity"] == "error":
            errors[Path(found["file"]).stem].append((found["range"]["start"]["line"], found["message"]))
    return errors


@pytest.fixture(scope="module")
def told(tmp_path_factory):
    programs = {"right": RIGHT, "readme": "\n".join(BLOCKS), "wrong": BEGIN + "\n".join(WRONG)}
    return errors_of(programs, tmp_path_factory.mktemp("programs"))


def _code(path):
    cells = json.loads(path.read_text())["cells"]
    return "\n".join("".join(cell["source"]) for cell in cells if cell["cell_type"] == "code")


@pytest.mark.slow
def test_right_programs_are_let_pass(told):
    assert {name: errors for name, errors in told.items() if errors and name != "wrong"} == {}


@pytest.mark.slow
def test_notebooks_are_let_pass(tmp_path):
    books = ROOT / "notebooks"
    notebooks = {path.stem: _code(path) for path in (*books.glob("*.ipynb"), *books.glob("gallery/*.ipynb"))}
    assert {name: errors for name, errors in errors_of(notebooks, tmp_path).items() if errors} == {}


@pytest.mark.slow
@pytest.mark.parametrize("line", range(len(WRONG)), ids=list(WRONG))
def test_wrong_programs_are_told(told, line):
    messages = [message for at, message in told["wrong"] if at == BEGIN.count("\n") + line]
    assert messages
    assert list(WRONG.values())[line] in messages[0]
