"""A program for test_compiler, in which linkax is imported when it is too late for flags of XLA; prints JSON."""

import json
import os
import warnings

import jax.numpy as jnp

jnp.zeros(1).block_until_ready()

from compiled_as_users_do import motion  # noqa: E402

from linkax.straight_line.transform import computes_kernels  # noqa: E402
from linkax.xla.flags import LOOPS, makes_kernels_of_loops  # noqa: E402


def warnings_of(flags):
    """What is told of slow runs, where the environment has these flags by now."""
    os.environ["XLA_FLAGS"] = flags
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        made = makes_kernels_of_loops.__wrapped__()
    return {"made": made, "told": [str(warning.message) for warning in told]}


if __name__ == "__main__":
    given = {"nothing": "", "linkax's": LOOPS, "other options": "--xla_backend_extra_options=something"}
    asked_for = "--xla_backend_extra_options=xla_cpu_small_while_loop_byte_threshold=1024"
    told = {name: warnings_of(flags) for name, flags in (given | {"slow loops": asked_for}).items()}
    print(json.dumps({"motion": motion(), "straight": computes_kernels(), "warnings": told}))
