"""The pages of the site describe every public name, with an example; what they show runs."""

import re
from itertools import chain
from pathlib import Path

import matplotlib
import pytest

import linkax as lx

SOURCE = Path(__file__).parents[1] / "notebooks"
PAGES = sorted((*SOURCE.glob("*.md"), *SOURCE.glob("reference/*.md")))
TEXTS = {path.relative_to(SOURCE).with_suffix("").as_posix(): path.read_text() for path in PAGES}
BLOCKS = {page: re.findall(r"```python\n(.*?)```", text, re.DOTALL) for page, text in TEXTS.items()}
LISTS = {page: " ".join(re.findall(r"```\{api\}\n(.*?)```", text, re.DOTALL)) for page, text in TEXTS.items()}
BY_HAND = {page: re.findall(r"\.\. py:data:: linkax\.(\w+)", text) for page, text in TEXTS.items()}
DESCRIBED = {page: [*LISTS[page].split(), *BY_HAND[page]] for page in TEXTS}

# Minutes of compiling.
SLOW = tuple(
    f"reference/{page}"
    for page in (
        "assembly",
        "solution",
        "derivatives",
        "kinematics",
        "synthesis",
        "laboratory",
        "tolerances",
        "formulations",
        "beams",
        "internal_states",
    )
)
mark = lambda page: [pytest.mark.slow] if page in SLOW else []


def test_every_public_name_is_on_one_page():
    plots = [f"plot.{name}" for name in vars(lx.plot) if callable(getattr(lx.plot, name))]
    assert sorted(chain(*DESCRIBED.values())) == sorted([*lx.__all__, *plots])


def test_every_public_name_is_in_an_example_of_its_page():
    shown = lambda page, name: re.search(rf"\blx\.{re.escape(name)}\b", "".join(BLOCKS[page]))
    assert [name for page, names in DESCRIBED.items() for name in names if not shown(page, name)] == []


@pytest.mark.filterwarnings("default:.*interactive")
@pytest.mark.parametrize("page", [pytest.param(page, marks=mark(page)) for page in BLOCKS if BLOCKS[page]])
def test_the_blocks_of_a_page_run(page, tmp_path, monkeypatch):
    """One after the other, as someone would who types them in."""
    matplotlib.use("agg")
    monkeypatch.chdir(tmp_path)
    names = {"__name__": "__main__"}
    for count, block in enumerate(BLOCKS[page], start=1):
        exec(compile(block, f"{page}, block {count}", "exec"), names)
