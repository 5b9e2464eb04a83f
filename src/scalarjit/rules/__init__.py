"""What each primitive of JAX computes: an entry of its result, of entries of its arguments.

One rule serves small arrays, whose entries are computed one by one, all at once by NumPy's indexing, and large ones,
whose entry is computed in a loop at an index that is not known before.
"""

from scalarjit.rules import arithmetic, moves, places, sums
from scalarjit.rules.rule import RULES

__all__ = ["RULES", "arithmetic", "moves", "places", "sums"]
