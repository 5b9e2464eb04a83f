"""What linkax asks of XLA, and of the insides of JAX and Equinox: all of it is in this package.

What we rely on (where; since which version), and what happens without it:

- XLA flag `xla_cpu_small_while_loop_byte_threshold`, as an extra backend option (`flags`; jaxlib 0.10). Without it:
  runs of one mechanism take five times as long; a warning says so.
- XLA flag `xla_cpu_experimental_ynn_fusion_type` (`flags`; jaxlib 0.10, known up to 0.12). Without it: batches of
  products call a library: up to twice the time.
- the name "xla_cpu_small_call" in a compiled program (`flags`; jaxlib 0.10). Without it: loops are taken for slow,
  and the warning comes.
- compiler options `xla_backend_optimization_level` and the like (`flags`; jaxlib 0.10). Without it: programs that run
  once compile twice as long.
- `jax.monitoring`, the event before XLA compiles (`memory_maps`; jax 0.10). Without it: XLA ends a process that has
  compiled too many programs.
- `jax.core.Tracer` (`tracing`; jax 0.10). Without it: numbers of a model cannot be checked.
- `jax.core.eval_context` (`tracing`; jax 0.10). Without it: known numbers inside a transformation compile as part of
  it.
- `jax.extend.core` Jaxpr, `dot_general_p` (`products_as_sums`; jax 0.10). Without it: products of small matrices call
  a library: half of the speed.
- `jax.interpreters` `ad`, `batching`, `mlir` (`cross_product`; jax 0.10). Without it: derivatives of vector products
  take several times as many operations.
- `jax.custom_batching.custom_vmap` (`one_kernel`, `batches`, `linalg.pivoted_qr`; jax 0.10). Without it: batches are
  as slow as their members one by one, and LAPACK may wait for ever (`one_by_one`).
- `equinox.internal` `create_vprim`, `filter_primitive_*` (`primitives`; equinox 0.13). Without it: no derivative in
  both modes of a run, or of what has none.
- `equinox.internal.while_loop(kind="bounded")` (`primitives`; equinox 0.13). Without it: limits at passages have no
  reverse mode.
- `_value`, `_enumeration` of Equinox's enumerations (`enumerations`; equinox 0.13). Without it: results of batches
  cannot be counted.

What diffrax is given that it does not expect is in `linkax.simulation.integrate.diffrax_contract`. `.ci/versions` holds
a short set of known answers against the lowest and the newest versions.
"""
