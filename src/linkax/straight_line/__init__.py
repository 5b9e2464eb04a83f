"""Functions of arrays as straight lines of scalar operations.

Most entries of the small arrays of a mechanism are known when a program is compiled: zeros, ones, indices. XLA starts a
kernel for each operation on arrays, and computes with all entries. A straight line computes each scalar that is not
known once, and all of them in one kernel; a batch is the same line over lanes.

- `graph`: scalar operations, of which what is known folds, and what is computed already is not computed again.
- `entries`: arrays by their entries. `rules`, `indexing`: what operations of JAX do with these.
- `program`: a traced function as kernels, and what stays on arrays between them.
- `kernel`: scalar operations as one kernel of XLA.
- `transform`: `straight_line`, with its derivatives and batches.
- `known`: which entries of arrays a program may know.

It knows nothing of mechanisms.
"""
