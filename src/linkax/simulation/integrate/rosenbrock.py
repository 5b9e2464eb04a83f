"""Rodas5P: an implicit solver without iterations, which diffrax does not have."""

from typing import Any, ClassVar, NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.scipy.linalg import lu_factor, lu_solve
from jaxtyping import Bool, Float

from linkax.xla.arrays import Array


class RosenbrockTableau(NamedTuple):
    """Coefficients of (1/(γh) − J) uᵢ = f(t + cᵢ h, y + Σ aᵢⱼ uⱼ) + Σ Cᵢⱼ uⱼ / h + dᵢ h ∂f/∂t.

    - `b`, `b_error`: the step leads to y + Σ bⱼ uⱼ; its error is Σ b_errorⱼ uⱼ. `coupling`: C.
    - `dense`: rows of H; within the step the solution is y₀ (1 − θ) + θ (y₁ + (1 − θ) (H₁u + θ (H₂u + θ H₃u))).
    """

    gamma: float
    a: Float[np.ndarray, "s s"]
    coupling: Float[np.ndarray, "s s"]
    c: Float[np.ndarray, " s"]
    d: Float[np.ndarray, " s"]
    b: Float[np.ndarray, " s"]
    b_error: Float[np.ndarray, " s"]
    dense: Float[np.ndarray, "3 s"]


def _lower(*rows):
    return np.array([[*row, *(8 - len(row)) * [0.0]] for row in rows])


_SIXTH = [-7.502846399306121, 2.561846144803919, -11.627539656261098, -0.18268767659942256, 0.030198172008377946]

RODAS5P = RosenbrockTableau(
    gamma=0.21193756319429014,
    a=_lower(
        [],
        [3.0],
        [2.849394379747939, 0.45842242204463923],
        [-6.954028509809101, 2.489845061869568, -10.358996098473584],
        [2.8029986275628964, 0.5072464736228206, -0.3988312541770524, -0.04721187230404641],
        _SIXTH,
        [*_SIXTH, 1.0],
        [*_SIXTH, 1.0, 1.0],
    ),
    coupling=_lower(
        [],
        [-14.155112264123755],
        [-17.97296035885952, -2.859693295451294],
        [147.12150275711716, -1.41221402718213, 71.68940251302358],
        [165.43517024871676, -0.4592823456491126, 42.90938336958603, -5.961986721573306],
        [24.854864614690072, -3.0009227002832186, 47.4931110020768, 5.5814197821558125, -0.6610691825249471],
        [
            *[30.91273214028599, -3.1208243349937974, 77.79954646070892],
            *[34.28646028294783, -19.097331116725623, -28.087943162872662],
        ],
        [
            *[37.80277123390563, -3.2571969029072276, 112.26918849496327],
            *[66.9347231244047, -40.06618937091002, -54.66780262877968, -9.48861652309627],
        ],
    ),
    c=np.array([0.0, 0.6358126895828704, 0.4095798393397535, 0.9769306725060716, 0.4288403609558664, 1.0, 1.0, 1.0]),
    d=np.array(
        [
            *[0.21193756319429014, -0.42387512638858027, -0.3384627126235924],
            *[1.8046452872882734, 2.325825639765069, 0.0, 0.0, 0.0],
        ]
    ),
    b=np.array([*_SIXTH, 1.0, 1.0, 1.0]),
    b_error=np.array([*7 * [0.0], 1.0]),
    dense=np.array(
        [
            [
                *[25.948786856663858, -2.5579724845846235, 10.433815404888879, -2.3679251022685204],
                *[0.524948541321073, 1.1241088310450404, 0.4272876194431874, -0.17202221070155493],
            ],
            [
                *[-9.91568850695171, -0.9689944594115154, 3.0438037242978453, -24.495224566215796],
                *[20.176138334709044, 15.98066361424651, -6.789040303419874, -6.710236069923372],
            ],
            [
                *[11.419903575922262, 2.8879645146136994, 72.92137995996029, 80.12511834622643],
                *[-52.072871366152654, -59.78993625266729, -0.15582684282751913, 4.883087185713722],
            ],
        ]
    ),
)


class RosenbrockInterpolation(diffrax.AbstractLocalInterpolation):
    """The solution within a step, of order four.

    - `k`: rates at the stages times the step, (s, n). `u`: see `RosenbrockTableau`.
    """

    t0: Float[Array, ""]
    t1: Float[Array, ""]
    y0: Float[Array, " n"]
    y1: Float[Array, " n"]
    k: Float[Array, "s n"]
    u: Float[Array, "s n"]

    def evaluate(self, t0: Any, t1: Any = None, left: bool = True) -> Float[Array, " n"]:
        if t1 is not None:
            return self.evaluate(t1) - self.evaluate(t0)
        theta = (t0 - self.t0) / jnp.where(self.t1 > self.t0, self.t1 - self.t0, 1.0)
        first, second, third = jnp.asarray(RODAS5P.dense, self.u.dtype) @ self.u
        inside = self.y1 + (1.0 - theta) * (first + theta * (second + theta * third))
        return self.y0 * (1.0 - theta) + theta * inside


class Rodas5P(diffrax.AbstractAdaptiveSolver):
    """A Rosenbrock method of order five for stiff problems: eight linear systems, of one matrix, are one step.

    It keeps its order where fast waves are not resolved, and damps them (L-stable). Steinebach, Construction of
    Rosenbrock–Wanner method Rodas5P and numerical benchmarks within the Julia Differential Equations package, BIT
    Numerical Mathematics 63, 2023.
    """

    term_structure: ClassVar = diffrax.AbstractTerm
    interpolation_cls: ClassVar = RosenbrockInterpolation
    tableau: ClassVar = RODAS5P

    def order(self, terms: Any) -> int:
        return 5

    def init(self, terms: Any, t0: Any, t1: Any, y0: Float[Array, " n"], args: Any) -> None:
        return None

    def func(self, terms: Any, t0: Float[Array, ""], y0: Float[Array, " n"], args: Any) -> Float[Array, " n"]:
        return terms.vf(t0, y0, args)

    def step(
        self,
        terms: Any,
        t0: Float[Array, ""],
        t1: Float[Array, ""],
        y0: Float[Array, " n"],
        args: Any,
        solver_state: None,
        made_jump: Bool[Array, ""] | bool,
    ) -> tuple[Float[Array, " n"], Float[Array, " n"], dict[str, Any], None, diffrax.RESULTS]:
        duration, of = t1 - t0, RODAS5P
        slopes, drift = jax.jacfwd(lambda y, t: terms.vf(t, y, args), argnums=(0, 1))(y0, t0)
        factors = lu_factor(jnp.eye(len(y0), dtype=y0.dtype) / (of.gamma * duration) - slopes)
        a, coupling, c, d = (jnp.asarray(numbers, y0.dtype) for numbers in (of.a, of.coupling, of.c, of.d))

        def stage(carry, index):
            rate = terms.vf(t0 + c[index] * duration, y0 + a[index] @ carry, args)
            right = rate + coupling[index] @ carry / duration + d[index] * duration * drift
            return carry.at[index].set(lu_solve(factors, right)), duration * rate

        u, k = lax.scan(stage, jnp.zeros((len(of.c), len(y0)), y0.dtype), np.arange(len(of.c)))
        y1 = y0 + jnp.asarray(of.b, y0.dtype) @ u
        dense_info = {"y0": y0, "y1": y1, "k": k, "u": u}
        return y1, jnp.asarray(of.b_error, y0.dtype) @ u, dense_info, None, diffrax.RESULTS.successful
