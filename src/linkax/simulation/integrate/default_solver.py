"""The solver of a run where none is asked for."""

import diffrax
import jax.numpy as jnp

from linkax.model.mechanism import Mechanism
from linkax.model.numbers import Number
from linkax.simulation.integrate.rosenbrock import Rodas5P
from linkax.simulation.start.state import State
from linkax.xla.tracing import all_concrete

CRITICAL = 2.0  # frequency times damping: waves that do not turn any more
LOOSE = 1e-5  # tolerance
LONG = 2**15  # radians of the fastest wave: an explicit step takes 2 to 3, and a run 2**16 steps by default


def default_solver(
    mechanism: Mechanism, rtol: Number | None, duration: Number, state: State | None = None
) -> diffrax.AbstractSolver:
    """Choose `Dopri8`, or for some mechanisms with beams an implicit solver, whose steps fast waves do not choose.

    An implicit solver has to follow undamped waves that the motion excites as an explicit one does, with lower
    order and at several times the cost of a step. It is better where they are damped faster than they turn, where the
    tolerance is loose, and in runs so long that they keep an explicit one from their end. It is `Rodas5P`, or
    `Kvaerno5` where numbers of the mechanism or the state are traced: derivatives of `Rodas5P` take minutes to compile.

    **Arguments:** `rtol`: tolerance of a step, None for fixed steps; `duration` [s]. Where these or numbers of beams
    are traced by JAX, beams get the implicit solver.
    """
    if not mechanism.beams:
        return diffrax.Dopri8()
    implicit = Rodas5P() if all_concrete((mechanism, state)) else diffrax.Kvaerno5()
    frequencies = jnp.stack([beam.fastest_frequency for beam in mechanism.beams])
    dampings = jnp.stack([jnp.asarray(beam.damping) for beam in mechanism.beams])
    if rtol is None or not all_concrete((rtol, duration, frequencies, dampings)):
        return implicit
    damped, long = jnp.any(frequencies * dampings > CRITICAL), jnp.max(frequencies) * duration > LONG
    return implicit if rtol >= LOOSE or damped or long else diffrax.Dopri8()
