"""How many programs XLA compiles."""

from contextlib import contextmanager

import jax

from linkax.xla.memory_maps import COMPILING


@contextmanager
def compilations():
    """A list that gets an entry for each program that XLA compiles meanwhile."""
    names = []
    note = lambda event, _, **what: names.append(what) if event == COMPILING else None
    jax.monitoring.register_event_duration_secs_listener(note)
    yield names
    jax.monitoring.unregister_event_duration_listener(note)
