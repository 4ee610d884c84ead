"""Vectors of 512 bits in code compiled by numba: their type, their operators, and functions written as LLVM code.

Hot loops use these vectors, because numba does not vectorise a loop over only 8 words. Without vectors, the loops were
2.5 times slower. Vectors work on any processor, but only as local variables.
"""

import math
import operator
from collections.abc import Callable
from functools import wraps
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from llvmlite import ir
from numba import extending as untyped_extending
from numba import types

extending: Any = untyped_extending


def aligned(shape: tuple[int, ...], dtype: type[np.generic]) -> npt.NDArray[Any]:
    """Return an array of zeros whose address is a multiple of 64 bytes, as vectors need."""
    size = math.prod(shape) * np.dtype(dtype).itemsize
    room = np.zeros(size + 64, dtype=np.uint8)
    first = -room.ctypes.data % 64
    return room[first : first + size].view(dtype).reshape(shape)


_BITS: Final = ir.IntType(64)
_VECTOR: Final = ir.VectorType(_BITS, 8)


class _VectorType(types.Type):
    """numba's type of a local variable that is a vector: 512 bits, loaded from an `aligned` array."""


VECTOR: Final = _VectorType("Vector")


@extending.register_model(_VectorType)
class _VectorModel(extending.models.PrimitiveModel):  # type: ignore[misc] # numba has no types
    def __init__(self, manager: Any, type_: Any) -> None:
        super().__init__(manager, type_, _VECTOR)


def _define(operation: Callable[..., Any], name: str, operands: int) -> None:
    """Define an operator of vectors as the LLVM instruction of that name."""
    extending.type_callable(operation)(
        lambda _context: lambda *given: VECTOR if given == (VECTOR,) * operands else None
    )
    extending.lower_builtin(operation, *(VECTOR,) * operands)(
        lambda _context, builder, _signature, given: getattr(builder, name)(*given)
    )


_define(operator.and_, "and_", 2)
_define(operator.or_, "or_", 2)
_define(operator.xor, "xor", 2)
_define(operator.invert, "not_", 1)
_define(operator.add, "add", 2)
_define(operator.lshift, "shl", 2)
_define(operator.rshift, "lshr", 2)


def in_llvm(result: Any, *kinds: Any) -> Callable[[Callable[..., Any]], Any]:
    """Return a decorator for functions that write LLVM code. Compiled code can call the decorated functions.

    `result` is the type of the result, and `kinds` are the types of the arguments. None stands for any array: the
    LLVM code gets the address of the array's data.
    """

    def decorate(write: Callable[..., Any]) -> Any:
        @wraps(write)  # numba counts the arguments of its signature
        def typed(_context: Any, *given: Any) -> Any:
            def code(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
                plain = [
                    argument if kind else context.make_array(array)(context, builder, argument).data
                    for kind, array, argument in zip(kinds, signature.args, arguments, strict=True)
                ]
                return write(builder, *plain) or context.get_dummy_value()

            return result(*(kind or array for kind, array in zip(kinds, given, strict=True))), code

        return extending.intrinsic(typed)

    return decorate


@in_llvm(VECTOR, None, types.int64)
def load(builder: Any, data: Any, place: Any) -> Any:
    """Return vector number `place` of an array."""
    vector = builder.load(builder.gep(builder.bitcast(data, _VECTOR.as_pointer()), [place]))
    vector.align = 64
    return vector


@in_llvm(types.void, None, types.int64, VECTOR)
def store(builder: Any, data: Any, place: Any, vector: Any) -> None:
    """Store a vector at the index `place` of an array of vectors."""
    builder.store(vector, builder.gep(builder.bitcast(data, _VECTOR.as_pointer()), [place])).align = 64


def repeated(builder: Any, value: Any, kind: Any) -> Any:
    """Return a vector of LLVM type `kind` that repeats a value."""
    unset = ir.Constant(kind, ir.Undefined)
    one = builder.insert_element(unset, value, ir.Constant(ir.IntType(32), 0))
    return builder.shuffle_vector(one, unset, ir.Constant(ir.VectorType(ir.IntType(32), kind.count), None))


@in_llvm(VECTOR, types.uint64)
def splat(builder: Any, word: Any) -> Any:
    """Return a vector that repeats a word."""
    return repeated(builder, word, _VECTOR)


@in_llvm(types.uint64, types.uint64)
def first_one(builder: Any, word: Any) -> Any:
    """Return the bit number of the lowest 1 in a word. The word must not be 0."""
    return builder.cttz(word, ir.Constant(ir.IntType(1), 1))


@in_llvm(VECTOR, VECTOR, VECTOR)
def below(builder: Any, left: Any, right: Any) -> Any:
    """Compare two vectors word by word. A word of the result is all ones if the left word is less, and 0 otherwise."""
    return builder.sext(builder.icmp_unsigned("<", left, right), _VECTOR)


def _called(builder: Any, name: str, result: Any, *given: Any) -> Any:
    """Return a call of LLVM's intrinsic function `name`, with this type of result."""
    kind = ir.FunctionType(result, [each.type for each in given])
    return builder.call(builder.module.declare_intrinsic(name, (), kind), given)


@in_llvm(VECTOR, VECTOR)
def first_ones(builder: Any, vector: Any) -> Any:
    """Return the bit number of the lowest 1 in each word. No word may be 0."""
    return _called(builder, "llvm.cttz.v8i64", _VECTOR, vector, ir.Constant(ir.IntType(1), 1))


@in_llvm(types.int64, types.uint64)
def ones_in_word(builder: Any, word: Any) -> Any:
    """Return the number of ones of a word."""
    return builder.ctpop(word)


@in_llvm(types.int64, VECTOR)
def ones_in(builder: Any, vector: Any) -> Any:
    """Return the number of ones of a vector."""
    counts = _called(builder, "llvm.ctpop.v8i64", _VECTOR, vector)
    return _called(builder, "llvm.vector.reduce.add.v8i64", _BITS, counts)


@in_llvm(types.boolean, VECTOR)
def some(builder: Any, vector: Any) -> Any:
    """Return whether at least one bit of a vector is 1."""
    whole = builder.bitcast(vector, ir.IntType(512))
    return builder.icmp_unsigned("!=", whole, ir.Constant(ir.IntType(512), 0))
