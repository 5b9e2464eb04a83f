"""All assemblies of a mechanism that many starts lead to."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from linkax.equations.configuration import configure
from linkax.equations.coordinates import retract
from linkax.equations.gaps import gaps
from linkax.linalg.saddle_inverse import invert
from linkax.model.forces.internal_states import initial_values
from linkax.model.mechanism import Mechanism
from linkax.model.numbers import Number, whole_number
from linkax.simulation.start.assembly import AssemblyWarning, assemble, demand_of
from linkax.simulation.start.branch_speeds import smallest_speeds
from linkax.simulation.start.closing import CLOSED
from linkax.simulation.start.joint_values import JointValues
from linkax.simulation.start.nearest_solution import rank_tolerance, strains_of
from linkax.simulation.start.places import Places
from linkax.simulation.start.rough_start import anywhere, beside, given_in_tree, unwound
from linkax.simulation.start.state import State
from linkax.simulation.start.validation import WorldPlaces, check_mechanism, checked_time, coordinates_by_joint
from linkax.xla.arrays import Array
from linkax.xla.tracing import all_concrete
from linkax.xla.users_line import warn
from scalarjit import scalarised, with_known_entries

SAME = 1e-6  # of the mechanism's length, or radians
NOTHING = JointValues((), ())


def assemblies(
    mechanism: Mechanism, positions: WorldPlaces | None = None, *, tries: int = 100, seed: int = 0, t: Number = 0.0
) -> list[State]:
    """Find the assemblies of a mechanism with coordinates of some joints held, from many starts at once.

    ```python
    crank, coupler, rocker = lx.rod("crank", 0.4, 1.0), lx.rod("coupler", 1.0, 1.0), lx.rod("rocker", 0.8, 1.0)
    joints = [
        lx.Revolute("A", lx.GROUND, crank.at("base"), axis="z"),
        lx.Revolute("B", crank.at("tip"), coupler.at("base"), axis="z"),
        lx.Revolute("C", coupler.at("tip"), rocker.at("tip"), axis="z"),
        lx.Revolute("D", lx.GROUND.at([1.0, 0.0, 0.0]), rocker.at("base"), axis="z"),
    ]
    four_bar = lx.Mechanism([crank, coupler, rocker], joints)
    up, down = lx.assemblies(four_bar, {"A": 1.0})
    ```

    **Arguments:**

    - `positions`, `t`: as for `linkax.assemble`. Hold as many as the mechanism has degrees of freedom.
    - `tries`: number of starts. The first is where `assemble` begins, the others are at random; more of them find
      assemblies that few starts lead to.
    - `seed`: of these starts.

    **Returns:** a state at rest, or as drives move it, for each assembly, in the order in which they were found. Two
    are the same where all bodies are in the same places, whatever turns and signs of quaternions, but for the spin of a
    body between two balls. Strains of beams are zero.

    **Raises:** as `assemble` does, where no start leads to closed loops, and `ValueError` where numbers are traced.
    Warns (`AssemblyWarning`) where the mechanism can move with the positions held, in a continuum of assemblies; of all
    such states the last one returned is an example.
    """
    check_mechanism(mechanism)
    t, tries, seed = checked_time(t, "t"), whole_number(tries, "tries"), whole_number(seed, "seed", least=0)
    places = Places(mechanism)
    measured_positions = places.positions(positions, "position")
    measured = places.measured()
    held = coordinates_by_joint(measured, measured_positions, "position")
    if not all_concrete((mechanism, held, t)):
        raise ValueError("assemblies of numbers that JAX traces; their count must be known, so call it outside of jit")
    numbers = anywhere(tries, mechanism.topology.num_speeds, seed)
    found = jax.tree.map(np.asarray, _assemblies(with_known_entries(measured), held, numbers, t))
    isolated = found.met & (found.freedoms <= 0)
    distinct = [index for index in np.flatnonzero(isolated).tolist() if found.is_new(index)]
    if np.any(moving := found.met & ~isolated):
        distinct.append(int(np.argmax(moving)))
        warn(
            f"{np.sum(moving)} of {tries} tries end where the mechanism can move with the positions held, in "
            f"{found.freedoms[distinct[-1]]} ways, which are no separate assemblies; the last state is one of these; "
            "hold more positions to tell them apart",
            AssemblyWarning,
        )
    if not distinct:
        return [assemble(mechanism, positions, t=t)]  # which tries harder, or tells why not
    internal = initial_values(mechanism.forces, found.q.dtype)
    of = lambda index: (jnp.asarray(found.q[index]), jnp.asarray(found.v[index]))
    return [State(*of(index), mechanism.topology, internal) for index in distinct]


class _Found(NamedTuple):
    """What each start leads to: coordinates, speeds, whether these are an assembly, degrees of freedom that are left,
    and places of all bodies, in radians and lengths of the mechanism."""

    q: Float[Array, "tries n_q"]
    v: Float[Array, "tries n_v"]
    met: Bool[Array, " tries"]
    freedoms: Int[Array, " tries"]
    places: Float[Array, "tries k"]

    def is_new(self, index: int) -> bool:
        """Whether none before is the same."""
        earlier = self.places[:index][self.met[:index]]
        return not np.any(np.max(np.abs(earlier - self.places[index]), axis=1, initial=0.0) <= SAME)


@scalarised
def _assemblies(flat, positions, numbers, t):
    demand, begin = demand_of(flat, positions, NOTHING, t)
    system, topology = demand.system, demand.system.topology
    moves = jnp.asarray(~np.isin(np.arange(topology.num_speeds), strains_of(system)))
    turning = np.setdiff1d(np.arange(topology.num_bodies), [*topology.spinning])

    def one(aside):
        q, size = demand.meet(retract(topology, begin, aside), begin, moves, jnp.zeros(()))
        q = unwound(demand, q, begin)
        configuration = configure(system, t, q)
        missed, closed = demand.held.apart(configuration).flat(), gaps(configuration).in_scales(system).widest()
        near = jnp.max(jnp.abs(missed), initial=0.0) <= CLOSED * jnp.maximum(system.length, 1.0)
        slopes = jnp.where(moves, demand.linearised(q)[1], 0.0)
        rank = invert(None, slopes, system.scales, rank_tolerance(system.dtype)).rank
        parent = np.array(topology.parent)
        ends = configuration.position[parent] + configuration.parent_arm
        turned = configuration.rotation[turning]
        place = jnp.concatenate([turned.ravel(), ends.ravel() / system.length])
        met = near & (closed <= CLOSED) & (size < jnp.inf)
        freedoms = jnp.sum(moves) - jnp.sum(rank) - len(topology.spinning)
        return _Found(q, smallest_speeds(configuration, NOTHING).v, met, freedoms, place)

    return jax.vmap(scalarised(one))(beside(demand, given_in_tree(topology, positions), numbers))
