"""A sweep of pendulums in a process of its own: `sweep_job.py STORE|- RESULT [PROCESS COUNT PORT | mpi CHUNK]`.

Pendulums of lengths that differ; one length is no number, and one motion takes more steps than are allowed.
"""

import sys

import diffrax
import jax
import jax.numpy as jnp
import numpy as np

MEMBERS, CHUNK = 120, 2


def swing(params):
    import linkax as lx

    arm = lx.rod("arm", length=params["length"], mass=1.0)
    hinge = lx.Revolute("hinge", lx.GROUND, arm.at("base"), axis="z")
    mechanism = lx.Mechanism([arm], [hinge], [lx.Gravity([0.0, -9.81, 0.0])])
    found = lx.simulate(
        mechanism,
        lx.State(jnp.zeros(1), jnp.zeros(1)),
        t1=params["t1"],
        accuracy=lx.Accuracy(rtol=1e-10),
        saveat=diffrax.SaveAt(t1=True),
        max_steps=1000,
    )
    return {"angle": found.joint("hinge")[-1], "result": found.result}


def batch(t1=1.0):
    """Members 3 and 7 fail."""
    lengths, times = jnp.linspace(0.5, 2.0, MEMBERS), jnp.full(MEMBERS, t1)
    return {"length": lengths.at[3].set(jnp.nan), "t1": times.at[7].set(1e4)}


def main():
    store, result, *job = sys.argv[1:]
    options = {"chunk": CHUNK, "store": None if store == "-" else store, "progress": True}
    if job[:1] == ["mpi"]:
        from mpi4py.futures import MPIPoolExecutor

        options |= {"chunk": int(job[1]), "executor": MPIPoolExecutor()}
    elif job:
        process, count, port = map(int, job)
        jax.distributed.initialize(f"localhost:{port}", count, process)
    import linkax as lx

    found = lx.sweep(swing, batch(), **options)
    np.savez(result, angle=found.output["angle"], reasons=found.reasons)


if __name__ == "__main__":
    main()
