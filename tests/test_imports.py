"""Imports run one way through the layers."""

import ast
from pathlib import Path

import pytest

import linkax

SOURCE = Path(linkax.__file__).parent
LAYERS = ["compiler", "tracing", "spatial", "linalg", "model", "equations", "formulations", "simulation", "analysis"]
LAYERS += ["studies", "scenes", "plotting", "cli"]


def layer(module):
    parts = module.split(".")
    return LAYERS.index(parts[1]) if len(parts) > 1 else None


def imports(path):
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module and node.module.startswith("linkax."):
            yield node.module
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if alias.name.startswith("linkax."))


@pytest.mark.parametrize("path", sorted(SOURCE.rglob("*.py")), ids=lambda path: str(path.relative_to(SOURCE)))
def test_imports_run_one_way(path):
    module = "linkax." + ".".join(path.relative_to(SOURCE).with_suffix("").parts)
    if module == "linkax.__init__":
        return
    for imported in imports(path):
        assert layer(imported) <= layer(module), f"{module} imports {imported}, which is above it"
