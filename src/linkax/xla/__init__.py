"""What linkax asks of XLA, and of the insides of JAX and Equinox.

All of it is in this package, but for two names: `linalg.pivoted_qr` has a `custom_vmap` of its own, and
`simulation.integrate.discrete_adjoint` makes a `ShapedArray`. `scalarjit` has a table of its own.

What we rely on (where; since which version), and what happens without it:

- the name `eqxi` in diffrax's module of `diffeqsolve`, by which it checks times (`diffrax_contract`; diffrax 0.7.2).
  Without it: programs call back to Python, so that JAX keeps none of a run on disk; a warning says so.
- events of JAX's cache (`program_cache`; jax 0.10). Without them: its warning comes for each program, or never.

Without one of the following names, from jax 0.10 and equinox 0.13 on, linkax cannot be imported or fails where it is
used. What would have to be found another way:

- `jax.core.Tracer` (`tracing`): whether numbers of a model are known, and can be checked.
- `jax.core.eval_context` (`tracing`): known numbers inside a transformation, computed without being part of it.
- `jax.core.ShapedArray` (`cross_product`, `undefined`): shapes of what a primitive returns.
- `jax.extend.core.Primitive`, `jax.interpreters` `ad`, `batching`, `mlir` (`cross_product`): derivatives of vector
  products, in a fraction of the operations.
- `jax.custom_derivatives.SymbolicZero` (`derivatives`): which arguments have no tangent.
- `jax.custom_batching.custom_vmap`, `jax.lax.platform_dependent` (`batches`): batches faster than their
  members one by one, and without LAPACK that waits for ever (`one_by_one`).
- `jax.monitoring`, the event before XLA compiles, and `clear_caches` of JAX and Equinox (`memory_maps`): room for
  compiled programs, without which XLA ends a process that has compiled too many.
- `equinox.internal` `create_vprim`, `filter_primitive_*` (`primitives`): derivatives in both modes of a run, and of
  what has none.
- `equinox.internal.while_loop(kind="bounded")` (`primitives`): the reverse mode of limits at passages.
- `_value`, `_enumeration` of Equinox's enumerations (`enumerations`): counts of the results of a batch.

What diffrax is given that it does not expect is in `linkax.simulation.integrate.diffrax_contract`. `.ci/versions` holds
a short set of known answers against the lowest and the newest versions.
"""
