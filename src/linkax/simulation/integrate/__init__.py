"""How motion goes on: a run, the equation that diffrax integrates, its solver, step control and derivatives."""
