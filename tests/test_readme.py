"""What the README shows of a force of one's own is true."""

import re
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import linkax as lx

README = (Path(__file__).parents[1] / "README.md").read_text()


def test_a_force_of_ones_own():
    block = next(text for text in re.findall(r"```python\n(.*?)```", README, re.DOTALL) if "class Drag" in text)
    names = {"jax": jax, "jnp": jnp, "lx": lx, "__name__": "readme"}
    *_, last = block.strip().splitlines()
    exec(block.replace(last, f"mechanism = {last}"), names)
    state = lx.State(jnp.zeros(1), jnp.array([3.0]))
    here = lx.Solution.of_state(names["mechanism"], state)
    # J θ'' of a rod of length and mass one about its end, under gravity and drag at its tip.
    exact = (-9.81 / 2.0 - 0.1 * 3.0**2) * 3.0
    np.testing.assert_allclose(here.acceleration("arm", at="tip")[0, 1], exact, rtol=1e-12)
