"""The notebook of the method says where each symbol is in the code: the names are there."""

import json
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
CELLS = json.loads((ROOT / "notebooks" / "method.ipynb").read_text())["cells"]
TABLE = next(text for text in ("".join(cell["source"]) for cell in CELLS) if text.startswith("## Where each symbol"))
ROWS = [row.strip("|").split("|") for row in TABLE.splitlines() if row.startswith("|")][2:]


@pytest.mark.parametrize("row", ROWS, ids=[row[0].strip() for row in ROWS])
def test_names_are_in_the_files_named(row):
    _, _, names, files = row
    paths = [path for pattern in re.findall(r"`([^`]+)`", files) for path in (ROOT / "src" / "linkax").glob(pattern)]
    assert paths, files
    sources = "\n".join(path.read_text() for path in paths)
    for name in re.findall(r"`([^`]+)`", names):
        last = name.split(".")[-1]
        defined = rf"(def|class) {last}\b|^\s*([\w, ]+, )?{last}(, [\w, ]+)?( =|:)"
        assert re.search(defined, sources, re.MULTILINE), f"{name} is not defined in {files}"
