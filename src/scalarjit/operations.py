"""Scalar operations: what each computes of constants, its type, and its instructions in LLVM's language."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

BOOL = np.dtype(bool)


@dataclass(frozen=True)
class Operation:
    """An operation on scalars.

    - `compute`: what NumPy computes of constants.
    - `of_real`, `of_signed`, `of_unsigned`: the instruction for operands of each kind; those of `bool` are unsigned.
      A name that begins with `@` is a function of LLVM for all types, and one with `!` one of C for float64.
    - `is_test`: whether the result is a bool.
    """

    compute: Callable[..., Any]
    of_real: str | None = None
    of_signed: str | None = None
    of_unsigned: str | None = None
    is_test: bool = False


def _of_kinds(compute, real, signed=None, unsigned=None, is_test=False):
    return Operation(compute, real, signed, unsigned or signed, is_test)


def _test(compute, real, signed, unsigned):
    return Operation(compute, f"fcmp {real}", f"icmp {signed}", f"icmp {unsigned}", True)


def _shifted_right(kind, one, other):
    """As a number with a sign, of kind "i", or without one, "u"."""
    of_kind = f"{kind}{one.itemsize}"
    return (one.view(of_kind) >> other.view(of_kind)).view(one.dtype)


def _quotient(one, other):
    if one.dtype.kind == "f":
        return one / other
    if other == 0:
        return np.invert(np.zeros_like(one))
    size = abs(int(one)) // abs(int(other))  # exact, where a quotient of reals rounds
    quotient = size if (one < 0) == (other < 0) else -size
    return one if quotient > np.iinfo(one.dtype).max else one.dtype.type(quotient)  # −2⁶³ / −1 = −2⁶³


def _log_gamma(number):
    try:
        return math.lgamma(number)
    except (ValueError, OverflowError):  # at a pole, and beyond the largest number
        return math.inf


def _remainder(one, other):
    return np.fmod(one, other) if other != 0 or one.dtype.kind == "f" else one


OPERATIONS = {
    "add": _of_kinds(np.add, "fadd", "add"),
    "sub": _of_kinds(np.subtract, "fsub", "sub"),
    "mul": _of_kinds(np.multiply, "fmul", "mul"),
    "div": _of_kinds(_quotient, "fdiv", "sdiv", "udiv"),
    "rem": _of_kinds(_remainder, "frem", "srem", "urem"),
    "and": _of_kinds(np.bitwise_and, None, "and"),
    "or": _of_kinds(np.bitwise_or, None, "or"),
    "xor": _of_kinds(np.bitwise_xor, None, "xor"),
    "shift_left": _of_kinds(np.left_shift, None, "shl"),
    "shift_right_arithmetic": _of_kinds(partial(_shifted_right, "i"), None, "ashr"),
    "shift_right_logical": _of_kinds(partial(_shifted_right, "u"), None, "lshr"),
    "eq": _test(np.equal, "oeq", "eq", "eq"),
    "ne": _test(np.not_equal, "une", "ne", "ne"),
    "lt": _test(np.less, "olt", "slt", "ult"),
    "le": _test(np.less_equal, "ole", "sle", "ule"),
    "gt": _test(np.greater, "ogt", "sgt", "ugt"),
    "ge": _test(np.greater_equal, "oge", "sge", "uge"),
    "sqrt": _of_kinds(np.sqrt, "@sqrt"),
    "floor": _of_kinds(np.floor, "@floor"),
    "ceil": _of_kinds(np.ceil, "@ceil"),
    "round": _of_kinds(np.round, "@roundeven"),
    "round_away": _of_kinds(lambda x: np.copysign(np.floor(np.abs(x) + 0.5), x), "@round"),
    "copysign": _of_kinds(np.copysign, "@copysign"),
    "sin": _of_kinds(np.sin, "!sin"),
    "cos": _of_kinds(np.cos, "!cos"),
    "tan": _of_kinds(np.tan, "!tan"),
    "asin": _of_kinds(np.arcsin, "!asin"),
    "acos": _of_kinds(np.arccos, "!acos"),
    "atan": _of_kinds(np.arctan, "!atan"),
    "atan2": _of_kinds(np.arctan2, "!atan2"),
    "sinh": _of_kinds(np.sinh, "!sinh"),
    "cosh": _of_kinds(np.cosh, "!cosh"),
    "tanh": _of_kinds(np.tanh, "!tanh"),
    "asinh": _of_kinds(np.arcsinh, "!asinh"),
    "acosh": _of_kinds(np.arccosh, "!acosh"),
    "atanh": _of_kinds(np.arctanh, "!atanh"),
    "exp": _of_kinds(np.exp, "!exp"),
    "exp2": _of_kinds(np.exp2, "!exp2"),
    "log": _of_kinds(np.log, "!log"),
    "log1p": _of_kinds(np.log1p, "!log1p"),
    "expm1": _of_kinds(np.expm1, "!expm1"),
    "cbrt": _of_kinds(np.cbrt, "!cbrt"),
    "pow": _of_kinds(np.power, "!pow"),
    "erf": _of_kinds(math.erf, "!erf"),
    "erfc": _of_kinds(math.erfc, "!erfc"),
    "lgamma": _of_kinds(_log_gamma, "!lgamma"),
    "nextafter": _of_kinds(np.nextafter, "!nextafter"),
    # Written by `emission`, of several instructions.
    "neg": Operation(np.negative),
    "abs": Operation(np.abs),
    "not": Operation(np.invert),
    "max": Operation(np.maximum),
    "min": Operation(np.minimum),
    "is_finite": Operation(np.isfinite, is_test=True),
    "select": Operation(lambda condition, yes, no: yes if condition else no),
}


def llvm_type(dtype: np.dtype) -> str:
    """The type of a scalar in registers."""
    if dtype.kind == "f":
        return {2: "half", 4: "float", 8: "double"}[dtype.itemsize]
    return "i1" if dtype == BOOL else f"i{8 * dtype.itemsize}"


def memory_type(dtype: np.dtype) -> str:
    """The type of a scalar in memory."""
    return "i8" if dtype == BOOL else llvm_type(dtype)


def is_supported(dtype: np.dtype) -> bool:
    """Whether scalars of a type are computed: no complex ones, and none of less than single precision."""
    # By the kind of scalars: a type that was unpickled is equal to another one, and not it.
    return dtype.kind in "iub" or dtype.type in (np.float32, np.float64)
