"""What linkax asks of XLA, and of the insides of JAX and Equinox.

All of it is in this package and in `linkax.straight_line`, but for two names: `linalg.pivoted_qr` has a `custom_vmap`
of its own, and `simulation.integrate.discrete_adjoint` makes a `ShapedArray`.

What we rely on (where; since which version), and what happens without it:

- XLA flag `xla_cpu_small_while_loop_byte_threshold`, as an extra backend option (`flags`; jaxlib 0.10). Without it:
  runs of one mechanism take five times as long; a warning says so.
- XLA flag `xla_cpu_experimental_ynn_fusion_type` (`flags`; jaxlib 0.10, known up to 0.12). Without it: batches of
  products call a library: up to twice the time.
- the name "xla_cpu_small_call" in a compiled program (`flags`; jaxlib 0.10). Without it: loops are taken for slow,
  and the warning comes.
- the name `eqxi` in diffrax's module of `diffeqsolve`, by which it checks times (`diffrax_contract`; diffrax 0.7.2).
  Without it: programs call back to Python, so that JAX keeps none of a run on disk; a warning says so.
- events of JAX's cache (`program_cache`, `kept_programs`; jax 0.10). Without them: the warning comes for each program,
  or never, and programs that JAX found on disk may be written, which do not run.
- `jax.experimental.serialize_executable`, that a program names what it calls of LAPACK, which lowering loads, and
  "callback" where it calls Python (`kept_programs`; jax 0.10). Without it: later processes trace, or fail.
- compiler options `xla_backend_optimization_level` and the like (`flags`; jaxlib 0.10). Without it: programs that run
  once compile twice as long.

Without one of the following names, from jax 0.10 and equinox 0.13 on, linkax cannot be imported or fails where it is
used. What would have to be found another way:

- `jax.core.Tracer` (`tracing`): whether numbers of a model are known, and can be checked.
- `jax.core.eval_context` (`tracing`): known numbers inside a transformation, computed without being part of it.
- `jax.core.ShapedArray` (`cross_product`, `undefined`): shapes of what a primitive returns.
- `jax.extend.core.Primitive`, `jax.interpreters` `ad`, `batching`, `mlir` (`cross_product`): derivatives of vector
  products, in a fraction of the operations.
- `jax.extend.core` Jaxpr and Literal, names and parameters of JAX's primitives (`straight_line.program`,
  `straight_line.rules`); `jax.extend.mlir` (`straight_line.kernel`); `jax.interpreters` (`straight_line.transform`):
  straight lines. A primitive that is not known there stays on arrays.
- that XLA takes a fusion from a program, of the dialect `mhlo`, and compiles it in the kernel of a loop
  (`straight_line.kernel`; jaxlib 0.10, known up to 0.12), which is tried. Without it: runs take several times as long;
  a warning says so. Outside of such a loop, or with constants or arguments as results, a fusion ends the process.
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
