"""Small motions about a state: their matrices, eigenvalues and modes."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Complex, Float

from linkax.analysis.eigenpairs import spectrum
from linkax.tables import Rows, Table, batch, count, known, numbers, printed_as
from linkax.xla.arrays import Array

GROWS = 1e-6  # |Re λ| / |λ| up to which a motion neither grows nor decays


def _table(found: "Linearisation") -> Table:
    values = known(found.natural_frequencies)
    shape, rows = (
        found.natural_frequencies.shape,
        [("natural frequencies", numbers(found.natural_frequencies, "rad/s", 1))],
    )
    if values is not None:
        each = [values[..., mode] for mode in range(shape[-1])]
        grows = lambda of: f"grows by {numbers(-of, '1/s')}"
        hertz = lambda of: grows(of) if np.all(of < 0.0) else numbers(of / (2.0 * np.pi), "Hz")
        rows = [(str(mode + 1), numbers(of, "rad/s"), hertz(of)) for mode, of in enumerate(each)]
    title = f"Small motions in {count(shape[-1], 'mode')}" + batch(shape[:-1])
    return Table(title, [Rows(("mode", "natural frequency", ""), rows, "modes")])


class StateSlopes(NamedTuple):
    """Small changes σ of further states: ÿ + D ẏ + K y = B σ, σ̇ = G y + H ẏ + S σ.

    - `force`: B, (d, n_s). `by_coordinates`: G, (n_s, d). `by_speeds`: H, (n_s, d). `by_states`: S, (n_s, n_s) [1/s].
    """

    force: Float[Array, "d n_s"]
    by_coordinates: Float[Array, "n_s d"]
    by_speeds: Float[Array, "n_s d"]
    by_states: Float[Array, "n_s n_s"]


@printed_as(_table)
class Linearisation(NamedTuple):
    """Small motions about a state, v = T ẏ on the tangent space: ÿ + D ẏ + K y = 0.

    With d degrees of freedom:

    - `natural_frequencies`: undamped, (d,) [rad/s], in rising order. A negative entry −r is no frequency: that mode
      grows as exp(r t), r in [1/s].
    - `modes`: speeds of the tree's joints in each mode, (n_v, d), scaled to vᵀ M v = 1. NaN where gyroscopic terms
      leave no modes in which all joints move in phase; see `eigenvectors` then.
    - `basis`: T, (n_v, d), with Tᵀ M T = 1. `stiffness`: K, (d, d) [1/s²]. `damping`: D, (d, d) [1/s].
    - `states`: what further states σ add: their `force` B, (d, n_s), and their rates G y + H ẏ + S σ, `by_coordinates`,
      `by_speeds` and `by_states`; None without any. They are the internal states of force elements, in the order of
      `State.internal`, and after them displacements that slips bar, one for each row of slips. All of the above holds
      them constant; `eigenvalues` does not, so that |λ| has the natural frequency of a hydraulic cylinder.

    Slips, such as those of a skate or of a wheel that rolls, leave fewer speeds than displacements. There are d of
    speeds, and y are displacements along them; those across change as the motion goes on: a skate that has turned goes
    aside. They, and other coordinates that nothing depends on, have eigenvalues of zero, as has a row of slips that
    others imply.

    About a steady motion, y are changes of the joints' coordinates that move with it, and frequencies are those seen
    from the rotating bodies: a rotor that whirls at ω seen from the ground whirls at ω − Ω here. Of a mechanism that
    turns as one, with bodies that spin about axes of their own, such as a disc that rolls in a circle, y turn and do
    not spin: of a rotor on a `Free` joint and springs frequencies are those seen from the ground. Centrifugal forces,
    and what they stiffen, are in K, gyroscopic terms in D, as its skew part. `natural_frequencies` leave out the
    symmetric part of D, and the skew part of K, which dampers have that do not rotate with the bodies.

    Differentiable, but for frequencies and eigenvalues that equal another one up to rounding, and their modes and
    eigenvectors, whose derivatives are NaN. Take one by its index: forwards, JAX's maximum spreads the NaN of others.
    """

    natural_frequencies: Float[Array, " d"]
    modes: Float[Array, "n_v d"]
    basis: Float[Array, "n_v d"]
    stiffness: Float[Array, "d d"]
    damping: Float[Array, "d d"]
    states: StateSlopes | None = None

    @property
    def eigenvalues(self) -> Complex[Array, "*batch n"]:
        """λ of the motions exp(λ t), with damping, gyroscopic terms and further states, (2 d + n_s,) [1/s].

        A motion grows where Re λ > 0.
        """
        return _of_members(self.stiffness, self.damping, self.states)[0]

    @property
    def eigenvectors(self) -> Complex[Array, "*batch n_v n"]:
        """Speeds of the tree's joints in the motion of each of `eigenvalues`, (n_v, 2 d + n_s), scaled arbitrarily."""
        count = self.stiffness.shape[-1]
        return self.basis @ _of_members(self.stiffness, self.damping, self.states)[1][..., count : 2 * count, :]


def state_matrix(
    stiffness: Float[Array, "*batch d d"], damping: Float[Array, "*batch d d"], states: StateSlopes | None = None
) -> Float[Array, "*batch n n"]:
    """A in d/dt (y, ẏ, σ) = A (y, ẏ, σ)."""
    nothing = jnp.zeros_like(stiffness)
    rows = [[nothing, nothing + jnp.eye(nothing.shape[-1])], [-stiffness, -damping]]
    if states is not None:
        rows[0].append(jnp.zeros_like(states.force))
        rows[1].append(states.force)
        rows.append([states.by_coordinates, states.by_speeds, states.by_states])
    return jnp.block(rows)


@jax.jit
def _of_members(stiffness, damping, states):
    """Eigenvalues and eigenvectors of the state matrix of each member of a batch."""
    return jnp.vectorize(spectrum, signature="(n,n)->(n),(n,n)")(state_matrix(stiffness, damping, states))


def gyroscopic_frequencies(matrix: Float[Array, "n n"]) -> Float[Array, " n//2"]:
    """Natural frequencies, as in `Linearisation`, of a state matrix whose eigenvalues are pairs of opposite sign."""
    values, _ = spectrum(matrix)
    size = jnp.sqrt(values.real**2 + values.imag**2)
    return jnp.sort(jnp.where(jnp.abs(values.real) <= GROWS * size, jnp.abs(values.imag), -jnp.abs(values.real)))[::2]
