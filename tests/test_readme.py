"""What the README shows runs, and is true."""

import re
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import linkax as lx

README = (Path(__file__).parents[1] / "README.md").read_text()


BLOCKS = re.findall(r"```python\n(.*?)```", README, re.DOTALL)


def names_after(*classes):
    """What the blocks that define classes leave, the mechanism of the first by name."""
    names = {"jax": jax, "jnp": jnp, "lx": lx, "__name__": "readme"}
    for of in classes:
        block = next(text for text in BLOCKS if f"class {of}(" in text)
        exec(block.replace("\nlx.Mechanism(", "\nmechanism = lx.Mechanism("), names)
    return names


def test_a_force_of_ones_own():
    names = names_after("Drag")
    state = lx.State(jnp.zeros(1), jnp.array([3.0]))
    here = lx.Solution.of_state(names["mechanism"], state)
    # J θ'' of a rod of length and mass one about its end, under gravity and drag at its tip.
    exact = (-9.81 / 2.0 - 0.1 * 3.0**2) * 3.0
    np.testing.assert_allclose(here.acceleration("arm", at="tip")[0, 1], exact, rtol=1e-12)


def test_a_force_with_a_switch():
    buffered = names_after("Drag", "Buffer")["buffered"]
    for angle in (0.1, -0.1):
        here = lx.Solution.of_state(buffered, lx.State(jnp.array([angle]), jnp.zeros(1)))
        push = 1e3 * max(-np.sin(angle), 0.0)
        exact = (push - 9.81 / 2.0) * 3.0 * np.cos(angle) ** 2
        np.testing.assert_allclose(here.acceleration("arm", at="tip")[0, 1], exact, rtol=1e-12)


def test_every_block_runs(tmp_path, monkeypatch):
    """One after the other, as someone would who types them in; of 100 and 1000 members in a batch fewer."""
    monkeypatch.chdir(tmp_path)
    names = {"__name__": "readme"}
    for count, block in enumerate(BLOCKS, start=1):
        fewer = re.sub(r"(?<=, )100(0?)(?=\))", r"1\g<1>0", block)
        exec(compile(fewer, f"README, block {count}", "exec"), names)
    assert names["found"].params["rod"] == pytest.approx(1.5, abs=1e-2)
    assert 0 < len(names["swept"].failed) < 30
