"""Every notebook runs from its first cell to its last, and keeps its outputs."""

import json
import re
from pathlib import Path

import matplotlib
import pytest

NOTEBOOKS = sorted((Path(__file__).parents[1] / "notebooks").glob("*.ipynb"))


QUICK = ("crank_slider", "method")  # the others are minutes of compiling
mark = lambda path: [] if path.stem in QUICK else [pytest.mark.slow]
MARKED = [pytest.param(path, marks=mark(path), id=path.stem) for path in NOTEBOOKS]


@pytest.mark.parametrize("path", MARKED)
def test_a_notebook_runs(path, monkeypatch, capsys):
    matplotlib.use("agg")
    shown = []
    monkeypatch.setattr("matplotlib.pyplot.show", lambda: shown.append(matplotlib.pyplot.gcf()))
    cells = [cell for cell in json.loads(path.read_text())["cells"] if cell["cell_type"] == "code"]
    names = {"__name__": "__main__"}
    for count, cell in enumerate(cells, start=1):
        exec(compile("".join(cell["source"]), f"{path.name}, code cell {count}", "exec"), names)
        kept = [kind for output in cell["outputs"] for kind in output.get("data", {})]
        assert kept.count("image/png") == len(shown), f"code cell {count}: outputs kept"
        told = capsys.readouterr().out
        differences = [float(number) for number in re.findall(r"differs by (\S+)", told)]
        assert all(difference <= 1e-12 for difference in differences), f"code cell {count}: {told}"
        printed = "".join("".join(output["text"]) for output in cell["outputs"] if output["output_type"] == "stream")
        assert len(told.splitlines()) == len(printed.splitlines()), f"code cell {count}: outputs kept"
        shown.clear()
    matplotlib.pyplot.close("all")
