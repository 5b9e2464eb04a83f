"""Every notebook runs from its first cell to its last, and keeps its outputs."""

import ast
import json
import re
from pathlib import Path

import matplotlib
import pytest
from matplotlib.figure import Figure

import linkax as lx

FOLDER = Path(__file__).parents[1] / "notebooks"
NOTEBOOKS = sorted([*FOLDER.glob("*.ipynb"), *FOLDER.glob("gallery/*.ipynb")])


QUICK = ("method",)  # which `.ci/run` always runs, with the settings that users have; the others compile for minutes
mark = lambda path: pytest.mark.users_settings if path.stem in QUICK else pytest.mark.slow
MARKED = [pytest.param(path, marks=mark(path), id=path.stem) for path in NOTEBOOKS]


def value_of(source, name, names):
    """Run a cell, and return the value that a notebook shows of it."""
    parsed = ast.parse(source, name)
    last = ast.Expression(parsed.body.pop().value) if isinstance(parsed.body[-1], ast.Expr) else None
    exec(compile(parsed, name, "exec"), names)
    return None if last is None else eval(compile(last, name, "eval"), names)


@pytest.mark.parametrize("path", MARKED)
def test_a_notebook_runs(path, monkeypatch, capsys):
    matplotlib.use("agg")
    shown = []
    monkeypatch.setattr("matplotlib.pyplot.show", lambda: shown.append(matplotlib.pyplot.gcf()))
    monkeypatch.setattr(lx, "cache_programs", lambda: None)  # of the whole process
    cells = [cell for cell in json.loads(path.read_text())["cells"] if cell["cell_type"] == "code"]
    names = {"__name__": "__main__"}
    for count, cell in enumerate(cells, start=1):
        value = value_of("".join(cell["source"]), f"{path.name}, code cell {count}", names)
        kept = [kind for output in cell["outputs"] for kind in output.get("data", {})]
        figures = len(shown) + isinstance(value, Figure)
        assert kept.count("image/png") == figures, f"code cell {count}: outputs kept"
        page = getattr(value, "_repr_html_", lambda: None)()
        assert ("text/html" in kept) == (page is not None), f"code cell {count}: outputs kept"
        told = capsys.readouterr().out
        differences = [float(number) for number in re.findall(r"differs by (\S+)", told)]
        assert all(difference <= 1e-12 for difference in differences), f"code cell {count}: {told}"
        printed = "".join("".join(output["text"]) for output in cell["outputs"] if output["output_type"] == "stream")
        assert len(told.splitlines()) == len(printed.splitlines()), f"code cell {count}: outputs kept"
        shown.clear()
    matplotlib.pyplot.close("all")
