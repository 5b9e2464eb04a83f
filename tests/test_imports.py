"""Imports run one way through the layers."""

import ast
from pathlib import Path

import pytest
from layers import LAYERS, layer

import linkax

SOURCE = Path(linkax.__file__).parent
CONTRIBUTING = Path(__file__).parents[1] / "CONTRIBUTING.md"
# Methods that hand on to a higher layer, which they import when they are called.
HAND_ON = {
    ("linkax.model.mechanism", "linkax.simulation.read.solution"),
    ("linkax.simulation.read.kinematics", "linkax.view"),
    ("linkax.studies.fits.fit_result", "linkax.plot.fit_report"),
}


def layer_of(module):
    return layer(*module.split(".")[1:])


def imports(path):
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module and node.module.startswith("linkax"):
            yield node.module
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if alias.name.startswith("linkax."))


@pytest.mark.parametrize("path", sorted(SOURCE.rglob("*.py")), ids=lambda path: str(path.relative_to(SOURCE)))
def test_imports_run_one_way(path):
    module = "linkax." + ".".join(path.relative_to(SOURCE).with_suffix("").parts)
    if module in ("linkax.__init__", "linkax.__main__", "linkax.simulation.__init__", "linkax.studies.__init__"):
        return
    for imported in imports(path):
        if (module, imported) in HAND_ON:
            continue
        assert not imported.startswith("linkax_command"), f"{module} imports the command line's reader"
        assert imported == "linkax" or layer_of(imported) <= layer_of(module), (
            f"{module} imports {imported}, which is above it"
        )


def test_contributing_names_the_layers_in_order():
    text = CONTRIBUTING.read_text()
    places = [text.index(f"`{name}`") for name in LAYERS]
    assert places == sorted(places)
