"""Functions that JAX traces once, however often one program calls them.

Before XLA compiles a simulation, JAX traces it in Python, which takes about as long. The same equations stand in
several places of a program, and each transformation (`vmap`, `grad`) walks through all of it again, more than once
where there are loops. Of a function marked here JAX keeps what it has found for each kind of arguments. XLA compiles
it in place, so that it runs as fast as without the mark.
"""

import equinox as eqx

traced_once = eqx.filter_jit
