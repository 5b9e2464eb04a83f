"""Functions of arrays, compiled by LLVM in this process."""

from scalarjit.alive import kept_while_alive as kept_while_alive
from scalarjit.caches import clear_caches as clear_caches
from scalarjit.flat import Flat as Flat
from scalarjit.kept_programs import keep_in as keep_in
from scalarjit.known import with_known_entries as with_known_entries
from scalarjit.program import scalarised as scalarised
