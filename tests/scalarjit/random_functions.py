"""Random functions of arrays, of the operations that a mechanism's equations consist of."""

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

SHAPES = ((), (3,), (4,), (3, 4), (2, 3, 3))
OPERATIONS = 14


class RandomFunction:
    """A random function of (scalar, vector, matrix), the same for the same seed; results in a list."""

    def __init__(self, seed):
        self.seed = seed

    def __call__(self, *arguments):
        rng = np.random.default_rng(self.seed)
        pool = [*arguments]
        for _ in range(OPERATIONS):
            kind = KINDS[rng.integers(len(KINDS))]
            made = kind(rng, pool)
            pool.append(jnp.tanh(made) if jnp.issubdtype(made.dtype, jnp.floating) else made)
        return pool[len(arguments) :]


def arguments(seed, dtype=float):
    rng = np.random.default_rng(1000 + seed)
    return [jnp.asarray(rng.normal(size=shape), dtype) for shape in ((), (4,), (3, 4))]


def _real(rng, pool):
    real = [array for array in pool if jnp.issubdtype(array.dtype, jnp.floating)]
    return real[rng.integers(len(real))]


def _vector(rng, pool):
    return jnp.ravel(_real(rng, pool))[:5]


def _matrix(rng, pool, rows=3, columns=3):
    values = jnp.resize(jnp.ravel(_real(rng, pool)), (rows, columns))
    known = rng.choice([0.0, 1.0, -1.0, np.nan], size=(rows, columns), p=[0.5, 0.1, 0.1, 0.3])
    return jnp.where(np.isnan(known), values, np.nan_to_num(known)).astype(values.dtype)


def _index(rng, pool, size):
    """One that is not known."""
    return jnp.argmax(jnp.resize(_vector(rng, pool), (size,)))


def _each(rng, pool):
    root = lambda x: jnp.sqrt(1.0 + x * x)
    functions = (jnp.sin, jnp.cos, jnp.abs, jnp.sign, jnp.negative, root, jnp.exp, jnp.arctan)
    return functions[rng.integers(len(functions))](_real(rng, pool))


def _pair(rng, pool):
    functions = (jnp.add, jnp.subtract, jnp.multiply, jnp.maximum, jnp.minimum, lambda a, b: a / (2.0 + b * b))
    return functions[rng.integers(len(functions))](_matrix(rng, pool), _matrix(rng, pool))


def _product(rng, pool):
    left, right = _matrix(rng, pool, 3, 4), _matrix(rng, pool, 4, 2)
    chosen = rng.integers(3)
    if chosen == 0:
        return left @ right
    if chosen == 1:
        return jnp.einsum("bij,bjk->bik", jnp.stack([left, -left]), jnp.stack([right, right]))
    return left @ jnp.resize(_vector(rng, pool), (4,))


def _reduction(rng, pool):
    functions = (jnp.sum, jnp.max, jnp.min, jnp.prod, jnp.cumsum)
    return functions[rng.integers(len(functions))](_matrix(rng, pool), axis=int(rng.integers(2)))


def _choice(rng, pool):
    a, b = _matrix(rng, pool), _matrix(rng, pool)
    conditions = (a > b, a <= 0.1, (a < b) & (b < 0.5), jnp.logical_not(a == b) | (b >= 0.2))
    return jnp.where(conditions[rng.integers(len(conditions))], a, b)


def _pieces(rng, pool):
    matrix, chosen = _matrix(rng, pool, 4, 3), rng.integers(7)
    if chosen == 0:
        return matrix[np.array([2, 0, 3])]
    if chosen == 1:
        return matrix[::2, ::-1].T
    if chosen == 2:
        return jnp.concatenate([matrix, matrix[:1] * 2.0]).reshape(3, 5)
    if chosen == 3:
        return lax.pad(matrix, jnp.asarray(0.5, matrix.dtype), ((1, -1, 0), (0, 2, 1)))
    if chosen == 4:
        return matrix[np.array([0, 1, 1]), np.array([2, 2, 0])]
    if chosen == 5:
        return jnp.diagonal(matrix[:3]) + jnp.roll(matrix, 1, axis=0)[0]
    return jnp.stack(jnp.split(matrix, 2), axis=1)


def _written(rng, pool):
    matrix, vector = _matrix(rng, pool, 4, 3), jnp.resize(_vector(rng, pool), (3,))
    chosen = rng.integers(4)
    if chosen == 0:
        return matrix.at[1].set(vector)
    if chosen == 1:
        return matrix.at[np.array([0, 2, 0])].add(vector[:, None])
    if chosen == 2:
        return matrix.at[:, 1].multiply(2.0)
    return lax.dynamic_update_slice(matrix, vector[None], (_index(rng, pool, 4), 0))


def _unknown(rng, pool):
    matrix, at = _matrix(rng, pool, 4, 3), _index(rng, pool, 4)
    chosen = rng.integers(4)
    if chosen == 0:
        return matrix[at]
    if chosen == 1:
        return lax.dynamic_slice_in_dim(matrix, at, 2)
    if chosen == 2:
        return matrix[jnp.stack([at, (at + 1) % 4])]
    return jnp.take_along_axis(matrix, jnp.argsort(jnp.zeros((4, 3)), axis=0), axis=0) * at


def _loop(rng, pool):
    matrix, vector = _matrix(rng, pool), jnp.resize(_vector(rng, pool), (3,))
    if rng.integers(2):
        return lax.fori_loop(0, 3, lambda i, v: 0.5 * matrix @ v + matrix[i], vector)
    return lax.scan(lambda v, row: (v * 0.5 + row, v @ row), vector, matrix, reverse=bool(rng.integers(2)))[1]


def _branch(rng, pool):
    a, b = _matrix(rng, pool), _matrix(rng, pool)
    return lax.cond(jnp.sum(a) > 0.3, lambda a, b: a @ b, lambda a, b: a - b, a, b)


def _mapped(rng, pool):
    matrix = _matrix(rng, pool)
    function = lambda row: jnp.sum(jnp.sin(row) * matrix[0])
    if rng.integers(2):
        return jax.vmap(function)(matrix)
    return jax.jvp(function, (matrix[1],), (matrix[2],))[1]


def _whole(rng, pool):
    return jnp.sum(_matrix(rng, pool) > 0.0, axis=0) * 2 - _index(rng, pool, 3)


KINDS = (
    *(_each, _pair, _pair, _product, _product, _reduction, _choice, _pieces, _pieces),
    *(_written, _unknown, _loop, _branch, _mapped, _whole),
)
