"""The pages of the site describe every public name, with an example; what they show runs."""

import re
from itertools import chain

import jax.numpy as jnp
import matplotlib
import numpy as np
import pytest
from pages import ROOT, blocks, page

import linkax as lx

SOURCE = ROOT / "notebooks"
PAGES = sorted((*SOURCE.glob("*.md"), *SOURCE.glob("reference/*.md")))
TEXTS = {path.relative_to(SOURCE).with_suffix("").as_posix(): path.read_text() for path in PAGES}
PATHS = {page: f"notebooks/{page}.md" for page in TEXTS}
BLOCKS = {page: blocks(path) for page, path in PATHS.items()}
LISTS = {page: " ".join(re.findall(r"```\{api\}\n(.*?)```", text, re.DOTALL)) for page, text in TEXTS.items()}
BY_HAND = {page: re.findall(r"\.\. py:data:: linkax\.(\w+)", text) for page, text in TEXTS.items()}
DESCRIBED = {page: [*LISTS[page].split(), *BY_HAND[page]] for page in TEXTS}

# Minutes of compiling.
SLOW = (
    "assembly", "solution", "derivatives", "kinematics", "synthesis", "laboratory", "tolerances", "formulations",
    "beams", "internal_states", "files", "constraints", "joints",
)  # fmt: skip
mark = lambda name: pytest.mark.slow if name.removeprefix("reference/") in SLOW else pytest.mark.users_settings


def test_every_public_name_is_on_one_page():
    plots = [f"plot.{name}" for name in vars(lx.plot) if callable(getattr(lx.plot, name))]
    assert sorted(chain(*DESCRIBED.values())) == sorted([*lx.__all__, *plots])


def test_every_public_name_is_in_an_example_of_its_page():
    shown = lambda page, name: re.search(rf"\blx\.{re.escape(name)}\b", "".join(BLOCKS[page]))
    assert [name for page, names in DESCRIBED.items() for name in names if not shown(page, name)] == []


@pytest.mark.filterwarnings("default:.*interactive")
@pytest.mark.parametrize(
    ("name", "count"),
    [pytest.param(name, count, marks=mark(name)) for name in BLOCKS for count in range(1, len(BLOCKS[name]) + 1)],
)
def test_a_block_of_a_page_runs(name, count):
    matplotlib.use("agg")
    page(PATHS[name]).run(count)


def of_forces(name):
    """A mechanism of the page on forces."""
    forces = page(PATHS["reference/forces"])
    forces.run(len(blocks(forces.path)))
    return forces.names[name]


@pytest.mark.users_settings
def test_a_force_of_ones_own():
    here = lx.Solution.of_state(of_forces("dragged"), lx.State(jnp.zeros(1), jnp.array([3.0])))
    # J θ'' of a rod of length and mass one about its end, under drag at its tip.
    np.testing.assert_allclose(here.acceleration("arm", at="tip")[0, 1], -0.1 * 3.0**2 * 3.0, rtol=1e-12)


@pytest.mark.users_settings
def test_a_force_with_a_switch():
    for angle in (0.1, -0.1):
        here = lx.Solution.of_state(of_forces("buffered"), lx.State(jnp.array([angle]), jnp.zeros(1)))
        push = 1e3 * max(-np.sin(angle), 0.0)
        exact = (push - 9.81 / 2.0) * 3.0 * np.cos(angle) ** 2
        np.testing.assert_allclose(here.acceleration("arm", at="tip")[0, 1], exact, rtol=1e-12)
