"""Functions of arrays, compiled by LLVM in this process."""

from scalarjit.transform import scalarised as scalarised
