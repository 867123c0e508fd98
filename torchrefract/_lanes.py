"""Numbers side by side in one register of the processor, for what numba compiles.

Where a processor has none that serve, LANES is 0, and nothing else is here that can be compiled.
"""

from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba import types

from torchrefract._registers import (
    BYTE,
    FLOAT,
    INDEX,
    LANES,
    WHOLE,
    Flags,
    Floats,
    Wholes,
    address,
    alike,
    as_bytes,
    as_floats,
    call,
    concatenated,
    each_four,
    fma_of,
    in_order,
    intrinsic,
    operation,
    spread,
    transposed,
    unaligned,
    written,
)


def _picked(builder: Any, low: Any, high: Any, place: Any) -> Any:
    if LANES == 16:
        return call(builder, "llvm.x86.avx512.vpermi2var.ps.512", low.type, low, place, high)
    found = [call(builder, "llvm.x86.avx2.permps", low.type, half, place) for half in (low, high)]
    return builder.select(builder.icmp_unsigned("<", place, alike(WHOLE, LANES)), *found)


def _all(builder: Any, flags: Any) -> Any:
    bits = ir.IntType(LANES)
    return builder.icmp_unsigned("==", builder.bitcast(flags, bits), ir.Constant(bits, -1))


def _any(builder: Any, flags: Any) -> Any:
    bits = ir.IntType(LANES)
    return builder.icmp_unsigned("!=", builder.bitcast(flags, bits), ir.Constant(bits, 0))


def _floor(builder: Any, value: Any) -> Any:
    return call(builder, f"llvm.floor.v{LANES}f32", value.type, value)


def _extreme(kind: str) -> Callable[..., Any]:
    return lambda builder, value: call(builder, f"llvm.vector.reduce.{kind}.v{LANES}i32", WHOLE, value)


def _chosen(compared: str, sign: str) -> Callable[..., Any]:
    return lambda builder, a, b: builder.select(getattr(builder, compared)(sign, a, b), a, b)


def _element(place: int) -> Callable[..., Any]:
    return lambda builder, value: builder.extract_element(value, ir.Constant(WHOLE, place))


all_floats = operation(spread, Floats, types.float32)  # one number in all lanes
all_wholes = operation(spread, Wholes, types.int32)
total = operation(lambda builder, a, b: builder.fadd(a, b), Floats, Floats, Floats)
difference = operation(lambda builder, a, b: builder.fsub(a, b), Floats, Floats, Floats)
product = operation(lambda builder, a, b: builder.fmul(a, b), Floats, Floats, Floats)
fma = operation(fma_of, Floats, Floats, Floats, Floats)  # a b + c, rounded once
# The second where the first is no number.
lower = operation(_chosen("fcmp_ordered", "<"), Floats, Floats, Floats)
higher = operation(_chosen("fcmp_ordered", ">"), Floats, Floats, Floats)
floor = operation(_floor, Floats, Floats)
to_wholes = operation(lambda builder, a: builder.fptosi(a, ir.VectorType(WHOLE, LANES)), Wholes, Floats)
plus = operation(lambda builder, a, b: builder.add(a, b), Wholes, Wholes, Wholes)
times = operation(lambda builder, a, b: builder.mul(a, b), Wholes, Wholes, Wholes)
minus = operation(lambda builder, a, b: builder.sub(a, b), Wholes, Wholes, Wholes)
smaller = operation(_chosen("icmp_signed", "<"), Wholes, Wholes, Wholes)
larger = operation(_chosen("icmp_signed", ">"), Wholes, Wholes, Wholes)
# Of all lanes.
smallest = operation(_extreme("smin"), types.int32, Wholes)
largest = operation(_extreme("smax"), types.int32, Wholes)
first = operation(_element(0), types.int32, Wholes)
last = operation(_element(LANES - 1), types.int32, Wholes)
# Flags: a number below 0 counts as a large one, so that `below` asks for both ends of a range at once.
below = operation(lambda builder, a, b: builder.icmp_unsigned("<", a, b), Flags, Wholes, Wholes)
equal = operation(lambda builder, a, b: builder.icmp_signed("==", a, b), Flags, Wholes, Wholes)
either = operation(lambda builder, a, b: builder.or_(a, b), Flags, Flags, Flags)
both = operation(lambda builder, a, b: builder.and_(a, b), Flags, Flags, Flags)
everywhere = operation(_all, types.boolean, Flags)
anywhere = operation(_any, types.boolean, Flags)
where = operation(lambda builder, flag, a, b: builder.select(flag, a, b), Floats, Flags, Floats, Floats)
# The numbers at places of two registers that follow one another; places are in [0, 2 LANES).
pick = operation(_picked, Floats, Floats, Floats, Wholes)


@intrinsic
def load(_: Any, values: Any, place: Any) -> Any:
    """Floats: LANES numbers of an array, (n,), of float32 or bytes, from a place on."""

    def generate(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        return as_floats(builder, _loaded(context, builder, signature, given, LANES))

    return Floats(values, INDEX), generate


@intrinsic
def load_wholes(_: Any, values: Any, place: Any) -> Any:
    """Wholes: LANES numbers of an array, (n,), of int32, from a place on."""

    def generate(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        return _loaded(context, builder, signature, given, LANES)

    return Wholes(values, INDEX), generate


@intrinsic
def load_three(_: Any, values: Any, place: Any) -> Any:
    """Three Floats: the channels of LANES pixels that lie together in an array, (n,), from a place on."""

    def generate(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        found = _loaded(context, builder, signature, given, 3 * LANES)
        order = [[3 * i + c for i in range(LANES)] for c in range(3)]
        channels = [builder.shuffle_vector(found, found, in_order(own)) for own in order]
        return context.make_tuple(builder, signature.return_type, [as_floats(builder, own) for own in channels])

    return types.UniTuple(Floats, 3)(values, INDEX), generate


@intrinsic
def load_pairs(_: Any, values: Any, place: Any, apart: Any) -> Any:
    """Two Floats: for each lane a number of an array, (n,), and the next one, so far from a place on, Wholes."""

    def generate(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        one, two = (concatenated(builder, own) for own in _loaded_apart(context, builder, signature, given))
        found = [each_four(builder, one, two, (k, k + 2, k + 4, k + 6)) for k in range(2)]
        return context.make_tuple(builder, signature.return_type, [as_floats(builder, own) for own in found])

    return types.UniTuple(Floats, 2)(values, INDEX, Wholes), generate


@intrinsic
def sums_of_eights(_: Any, values: Any, places: Any, weights: Any, own: Any, line: Any, apart: Any) -> Any:
    """Eight Floats, with 8 lanes: of each lane the sum of four lines of eight numbers in a row, as often as it weighs.

    values: (n,), float32, of which each line begins `line` behind the one before.
    places: (m,), int32, where the first of them begin, of the first lane at `own`.
    weights: (k,), float32, likewise of the first line, those of each more `apart` behind.
    """

    def generate(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        data, starts, factors = (address(context, builder, signature.args[i], given[i]) for i in range(3))
        found = list[Any]()
        for i in range(LANES):
            at = builder.add(given[3], ir.Constant(given[3].type, i))
            begin, total = builder.gep(data, [builder.load(builder.gep(starts, [at]))]), None
            for _line in range(4):
                weight = spread(builder, builder.load(builder.gep(factors, [at])))
                eight = unaligned(builder, begin, LANES)
                total = builder.fmul(weight, eight) if total is None else fma_of(builder, weight, eight, total)
                begin, at = builder.gep(begin, [given[4]]), builder.add(at, given[5])
            found.append(total)
        return context.make_tuple(builder, signature.return_type, transposed(builder, found))

    return types.UniTuple(Floats, 8)(values, places, weights, INDEX, INDEX, INDEX), generate


@intrinsic
def store(_: Any, values: Any, place: Any, lanes: Any) -> Any:
    """Write Floats to an array, (n,), of float32, or rounded to one of bytes, from a place on."""

    def generate(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        return _stored(context, builder, signature, given[:2], given[2])

    return types.void(values, INDEX, Floats), generate


@intrinsic
def store_three(_: Any, values: Any, place: Any, a: Any, b: Any, c: Any) -> Any:
    """The same with three channels of pixels that lie together."""

    def generate(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        two, third = (
            builder.shuffle_vector(*pair, in_order(range(2 * LANES))) for pair in (given[2:4], [given[4]] * 2)
        )
        pixels = builder.shuffle_vector(two, third, in_order([i + c * LANES for i in range(LANES) for c in range(3)]))
        return _stored(context, builder, signature, given[:2], pixels)

    return types.void(values, INDEX, Floats, Floats, Floats), generate


@intrinsic
def store_wholes(_: Any, values: Any, place: Any, lanes: Any) -> Any:
    """Write Wholes to an array, (n,), of int32, from a place on."""

    def generate(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        return written(context, builder, address(context, builder, signature.args[0], *given[:2]), given[2])

    return types.void(values, INDEX, Wholes), generate


@intrinsic
def fetch(_: Any, values: Any, place: Any) -> Any:
    """Have the processor bring a place of an array, (n,), near, which is soon to be read."""

    def generate(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        at = builder.bitcast(address(context, builder, signature.args[0], *given), BYTE.as_pointer())
        read, often, data = (ir.Constant(WHOLE, number) for number in (0, 3, 1))
        call(builder, "llvm.prefetch.p0", ir.VoidType(), at, read, often, data)
        return context.get_dummy_value()

    return types.void(values, INDEX), generate


def _loaded(context: Any, builder: Any, signature: Any, given: Any, count: int) -> Any:
    return unaligned(builder, address(context, builder, signature.args[0], *given[:2]), count)


def _loaded_apart(context: Any, builder: Any, signature: Any, given: Any) -> list[list[Any]]:
    """Two numbers for each lane: those of the first two of each four lanes, and those of the last two."""
    at = address(context, builder, signature.args[0], *given[:2])
    found = list[Any]()
    for i in range(LANES):
        place = builder.sext(builder.extract_element(given[2], ir.Constant(WHOLE, i)), ir.IntType(64))
        found.append(unaligned(builder, builder.gep(at, [place]), 2))
    fours = range(0, LANES, 4)
    return [[found[four + i + k] for four in fours for k in range(2)] for i in (0, 2)]


def _stored(context: Any, builder: Any, signature: Any, given: Any, lanes: Any) -> Any:
    at = address(context, builder, signature.args[0], *given)
    return written(context, builder, at, lanes if at.type.pointee == FLOAT else as_bytes(builder, lanes))
