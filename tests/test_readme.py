"""What the README shows runs, and is true."""

import re
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

import linkax as lx

ROOT = Path(__file__).parents[1]
README, FORCES = ((ROOT / name).read_text() for name in ("README.md", "notebooks/reference/forces.md"))
blocks_of = lambda text: re.findall(r"```python\n(.*?)```", text, re.DOTALL)


@pytest.fixture(scope="module")
def forces():
    """What the page on forces leaves."""
    names = {"__name__": "forces"}
    for block in blocks_of(FORCES):
        exec(block, names)
    return names


def test_a_force_of_ones_own(forces):
    here = lx.Solution.of_state(forces["dragged"], lx.State(jnp.zeros(1), jnp.array([3.0])))
    # J θ'' of a rod of length and mass one about its end, under drag at its tip.
    np.testing.assert_allclose(here.acceleration("arm", at="tip")[0, 1], -0.1 * 3.0**2 * 3.0, rtol=1e-12)


def test_a_force_with_a_switch(forces):
    for angle in (0.1, -0.1):
        here = lx.Solution.of_state(forces["buffered"], lx.State(jnp.array([angle]), jnp.zeros(1)))
        push = 1e3 * max(-np.sin(angle), 0.0)
        exact = (push - 9.81 / 2.0) * 3.0 * np.cos(angle) ** 2
        np.testing.assert_allclose(here.acceleration("arm", at="tip")[0, 1], exact, rtol=1e-12)


def test_every_block_runs(tmp_path, monkeypatch):
    """One after the other, as someone would who types them in; of 100 members in a batch fewer."""
    monkeypatch.chdir(tmp_path)
    opened = []
    monkeypatch.setattr("webbrowser.open", opened.append)
    names = {"__name__": "readme"}
    for count, block in enumerate(blocks_of(README), start=1):
        exec(compile(block.replace("2.0, 100)", "2.0, 10)"), f"README, block {count}", "exec"), names)
    assert opened[0].startswith("file:")
    assert "showMechanism" in (tmp_path / "four_bar.html").read_text()
    assert (tmp_path / "coupler.png").stat().st_size > 1e4
    assert names["solution"].worst_violation().position < 1e-13


def test_someone_reads_it_to_the_end():
    assert len(README.splitlines()) <= 150


def test_its_links_lead_somewhere():
    for link in re.findall(r"\]\((?!https?:|#)([^)]+)\)", README):
        assert (ROOT / link.split("#")[0]).exists(), link
