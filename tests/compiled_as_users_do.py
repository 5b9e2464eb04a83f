"""A program for test_compiler, compiled with the flags that linkax itself sets; prints JSON."""

import json

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from known_answers import start

import linkax as lx
from linkax.xla.flags import makes_kernels_of_loops
from linkax.xla.one_kernel import in_one_kernel
from linkax.xla.products_as_sums import with_products_as_sums


def motion(optimise=True):
    """Speeds of a crank-slider after a while, and the steps to there."""
    found = lx.simulate(*start("crank-slider", "SC4"), t1=0.5, optimise=optimise)
    return {"speeds": np.asarray(found.v[-1]).tolist(), "steps": int(found.stats["num_steps"])}


def kernels():
    """A function of an array and a number that is none, alone, in a batch, and where it makes no sense."""
    square = in_one_kernel(when=lambda *_: True, sound=lambda sound, *_: sound)(
        lambda _, array, count: (array @ array, count)
    )
    of = lambda sound, array: square(sound, array, 3)
    matrices = jnp.arange(32.0).reshape(2, 4, 4)
    alone, count = jax.jit(of)(True, matrices[0])
    batch, _ = jax.jit(jax.vmap(of, in_axes=(None, 0)))(True, matrices)
    none, _ = jax.jit(of)(False, matrices[0])
    loop = jax.jit(lambda array: of(True, array)[0]).lower(matrices[0]).as_text()
    told = {"alone": alone, "count": count, "batch": batch, "none": none}
    return {name: np.asarray(array).tolist() for name, array in told.items()} | {"loops": loop.count("while")}


def products():
    """Of functions of two matrices: found with products as sums, expected, and how many products are left."""
    both = lambda a, b: jnp.einsum("ij,kj->ki", a, b)
    stacked = lambda a: jnp.stack([a, 2.0 * a, a + 1.0])
    batch = lambda a, b: jnp.einsum("ijk,kli->lij", stacked(a), stacked(b))
    functions = {
        "matrices": both,
        "axes": batch,
        "vector": lambda a, b: a @ b[0],
        "numbers": lambda a, b: jnp.tensordot(a, b, 2),
        "nothing": lambda a, b: a[:, :0] @ b[:0],
        "branch": lambda a, b: lax.cond(a[0, 0] > 0.0, both, lambda a, b: a, a, b),
        "loop": lambda a, b: lax.fori_loop(0, 3, lambda _, c: 0.1 * jax.jit(both)(a, c), b),
        "several": lambda a, b: jax.vmap(lambda column: a @ column)(b),
        "derivative": jax.grad(lambda a, b: jnp.sum(jnp.sin(both(a, b)))),
        "large": lambda a, b: jnp.kron(a, jnp.ones((9, 9))) @ jnp.kron(b, jnp.ones((9, 9))),
    }
    generator = np.random.default_rng(1)
    a, b = jnp.asarray(generator.normal(size=(2, 3, 3)))
    told = {}
    for name, function in functions.items():
        summed = with_products_as_sums(function)
        left = str(jax.make_jaxpr(summed)(a, b)).count("dot_general")
        told[name] = np.asarray(summed(a, b)).tolist(), np.asarray(function(a, b)).tolist(), left
    return told


def assembled_inside(angle):
    """The same end of a pendulum's motion, assembled and run in one program, and in programs of their own.

    `of_run`: whether its loops over steps are left as loops.
    """

    def end(angle, optimise=True):
        arm = lx.rod("arm", 1.0, 1.0)
        hinge = lx.Revolute("hinge", lx.GROUND, arm.at("base"), "z")
        mechanism = lx.Mechanism([arm], [hinge], [lx.Gravity([0.0, -9.81, 0.0])])
        start = lx.assemble(mechanism, {"hinge": angle})
        return lx.simulate(mechanism, start, t1=0.5, optimise=optimise).q[-1, 0]

    together = jax.jit(end).lower(angle).compile()
    _, _, entry = together.as_text().partition("\nENTRY")
    loops = [line for line in entry.splitlines() if " while(" in line or "xla_cpu_small_call" in line]
    of_run = [" while(" in line for line in loops if "diffeqsolve" in line]
    return {"ends": [float(end(angle, optimise=False)), float(together(angle))], "of_run": of_run}


if __name__ == "__main__":
    motions = {"motion": motion(), "motion_once": motion(optimise=False)}
    told = {"makes_kernels": makes_kernels_of_loops(), "kernels": kernels(), "products": products()}
    print(json.dumps(told | motions | {"assembled_inside": assembled_inside(0.4)}))
