"""Numbers side by side in one register of the processor, for what numba compiles.

LANES of them at once: 16 with AVX-512, 8 with AVX2, and 0 where a processor has neither: then nothing else is here that
can be compiled. `NUMBA_CPU_NAME` and `NUMBA_CPU_FEATURES` say otherwise, as for all that numba compiles.
"""

from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba import types
from numba.core import registry
from numba.extending import intrinsic as numba_intrinsic
from numba.extending import models, register_model

_target: Any = registry.cpu_target
_FEATURES = set(str(_target.target_context.codegen().magic_tuple()[2]).split(","))
LANES = 16 if "+avx512f" in _FEATURES else 8 if {"+avx2", "+fma"} <= _FEATURES else 0

_FLOAT, _WHOLE, _BYTE, _FLAG = ir.FloatType(), ir.IntType(32), ir.IntType(8), ir.IntType(1)
_INDEX = types.uintp


class _Lanes(types.Type):
    """So many numbers of a type, as the compiler has them."""

    def __init__(self, name: str, element: ir.Type):
        super().__init__(name=f"{LANES} {name}")
        self.element = element


@register_model(_Lanes)
class _Model(models.PrimitiveModel):
    def __init__(self, manager: Any, lanes: _Lanes):
        super().__init__(manager, lanes, ir.VectorType(lanes.element, LANES))


Floats, Wholes, Flags = _Lanes("float32", _FLOAT), _Lanes("int32", _WHOLE), _Lanes("bool", _FLAG)


def _intrinsic(typed: Callable[..., Any]) -> Callable[..., Any]:
    """As it is called: what is compiled hands itself over, too."""
    return numba_intrinsic(typed)


def _operation(build: Callable[..., Any], result: Any, *arguments: Any) -> Callable[..., Any]:
    """What is called in compiled functions: `build(builder, *values)` makes its instructions."""

    def typed(*_: Any) -> Any:
        return result(*arguments), lambda context, builder, signature, values: build(builder, *values)

    # numba counts the arguments of what it is given.
    takers: dict[int, Callable[..., Any]] = {
        1: lambda context, a: typed(),
        2: lambda context, a, b: typed(),
        3: lambda context, a, b, c: typed(),
    }
    return _intrinsic(takers[len(arguments)])


def _call(builder: Any, name: str, result: ir.Type, *values: Any) -> Any:
    """One of LLVM's own functions."""
    known = builder.module.globals.get(name)
    kind = ir.FunctionType(result, [value.type for value in values])
    return builder.call(known or ir.Function(builder.module, kind, name), values)


def _alike(element: ir.Type, value: Any, count: int = LANES) -> ir.Constant:
    return ir.Constant(ir.VectorType(element, count), [value] * count)


def _spread(builder: Any, value: Any) -> Any:
    one = ir.Constant(ir.VectorType(value.type, LANES), ir.Undefined)
    one = builder.insert_element(one, value, ir.Constant(_WHOLE, 0))
    return builder.shuffle_vector(one, one, _alike(_WHOLE, 0))


def _picked(builder: Any, low: Any, high: Any, place: Any) -> Any:
    if LANES == 16:
        return _call(builder, "llvm.x86.avx512.vpermi2var.ps.512", low.type, low, place, high)
    found = [_call(builder, "llvm.x86.avx2.permps", low.type, half, place) for half in (low, high)]
    return builder.select(builder.icmp_unsigned("<", place, _alike(_WHOLE, LANES)), *found)


def _all(builder: Any, flags: Any) -> Any:
    bits = ir.IntType(LANES)
    return builder.icmp_unsigned("==", builder.bitcast(flags, bits), ir.Constant(bits, -1))


def _any(builder: Any, flags: Any) -> Any:
    bits = ir.IntType(LANES)
    return builder.icmp_unsigned("!=", builder.bitcast(flags, bits), ir.Constant(bits, 0))


def _floor(builder: Any, value: Any) -> Any:
    return _call(builder, f"llvm.floor.v{LANES}f32", value.type, value)


def _fma(builder: Any, *values: Any) -> Any:
    return _call(builder, f"llvm.fma.v{LANES}f32", values[0].type, *values)


def _extreme(kind: str) -> Callable[..., Any]:
    return lambda builder, value: _call(builder, f"llvm.vector.reduce.{kind}.v{LANES}i32", _WHOLE, value)


def _chosen(compared: str, sign: str) -> Callable[..., Any]:
    return lambda builder, a, b: builder.select(getattr(builder, compared)(sign, a, b), a, b)


def _element(place: int) -> Callable[..., Any]:
    return lambda builder, value: builder.extract_element(value, ir.Constant(_WHOLE, place))


all_floats = _operation(_spread, Floats, types.float32)  # one number in all lanes
all_wholes = _operation(_spread, Wholes, types.int32)
total = _operation(lambda builder, a, b: builder.fadd(a, b), Floats, Floats, Floats)
difference = _operation(lambda builder, a, b: builder.fsub(a, b), Floats, Floats, Floats)
product = _operation(lambda builder, a, b: builder.fmul(a, b), Floats, Floats, Floats)
fma = _operation(_fma, Floats, Floats, Floats, Floats)  # a b + c, rounded once
# The second where the first is no number.
lower = _operation(_chosen("fcmp_ordered", "<"), Floats, Floats, Floats)
higher = _operation(_chosen("fcmp_ordered", ">"), Floats, Floats, Floats)
floor = _operation(_floor, Floats, Floats)
to_wholes = _operation(lambda builder, a: builder.fptosi(a, ir.VectorType(_WHOLE, LANES)), Wholes, Floats)
plus = _operation(lambda builder, a, b: builder.add(a, b), Wholes, Wholes, Wholes)
times = _operation(lambda builder, a, b: builder.mul(a, b), Wholes, Wholes, Wholes)
minus = _operation(lambda builder, a, b: builder.sub(a, b), Wholes, Wholes, Wholes)
smaller = _operation(_chosen("icmp_signed", "<"), Wholes, Wholes, Wholes)
larger = _operation(_chosen("icmp_signed", ">"), Wholes, Wholes, Wholes)
# Of all lanes.
smallest = _operation(_extreme("smin"), types.int32, Wholes)
largest = _operation(_extreme("smax"), types.int32, Wholes)
first = _operation(_element(0), types.int32, Wholes)
last = _operation(_element(LANES - 1), types.int32, Wholes)
# Flags: a number below 0 counts as a large one, so that `below` asks for both ends of a range at once.
below = _operation(lambda builder, a, b: builder.icmp_unsigned("<", a, b), Flags, Wholes, Wholes)
equal = _operation(lambda builder, a, b: builder.icmp_signed("==", a, b), Flags, Wholes, Wholes)
either = _operation(lambda builder, a, b: builder.or_(a, b), Flags, Flags, Flags)
both = _operation(lambda builder, a, b: builder.and_(a, b), Flags, Flags, Flags)
everywhere = _operation(_all, types.boolean, Flags)
anywhere = _operation(_any, types.boolean, Flags)
where = _operation(lambda builder, flag, a, b: builder.select(flag, a, b), Floats, Flags, Floats, Floats)
# The numbers at places of two registers that follow one another; places are in [0, 2 LANES).
pick = _operation(_picked, Floats, Floats, Floats, Wholes)


@_intrinsic
def load(_: Any, values: Any, place: Any) -> Any:
    """Floats: LANES numbers of an array, (n,), of float32 or bytes, from a place on."""

    def generate(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        return _as_floats(builder, _loaded(context, builder, signature, given, LANES))

    return Floats(values, _INDEX), generate


@_intrinsic
def load_wholes(_: Any, values: Any, place: Any) -> Any:
    """Wholes: LANES numbers of an array, (n,), of int32, from a place on."""

    def generate(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        return _loaded(context, builder, signature, given, LANES)

    return Wholes(values, _INDEX), generate


@_intrinsic
def load_three(_: Any, values: Any, place: Any) -> Any:
    """Three Floats: the channels of LANES pixels that lie together in an array, (n,), from a place on."""

    def generate(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        found = _loaded(context, builder, signature, given, 3 * LANES)
        order = [[3 * i + c for i in range(LANES)] for c in range(3)]
        channels = [builder.shuffle_vector(found, found, _order(own)) for own in order]
        return context.make_tuple(builder, signature.return_type, [_as_floats(builder, own) for own in channels])

    return types.UniTuple(Floats, 3)(values, _INDEX), generate


@_intrinsic
def load_pairs(_: Any, values: Any, place: Any, apart: Any) -> Any:
    """Two Floats: for each lane a number of an array, (n,), and the next one, so far from a place on, Wholes."""

    def generate(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        one, two = (_concatenated(builder, own) for own in _loaded_apart(context, builder, signature, given))
        found = [_each_four(builder, one, two, (k, k + 2, k + 4, k + 6)) for k in range(2)]
        return context.make_tuple(builder, signature.return_type, [_as_floats(builder, own) for own in found])

    return types.UniTuple(Floats, 2)(values, _INDEX, Wholes), generate


@_intrinsic
def sums_of_eights(_: Any, values: Any, places: Any, weights: Any, own: Any, line: Any, apart: Any) -> Any:
    """Eight Floats, with 8 lanes: of each lane the sum of four lines of eight numbers in a row, as often as it weighs.

    values: (n,), float32, of which each line begins `line` behind the one before.
    places: (m,), int32, where the first of them begin, of the first lane at `own`.
    weights: (k,), float32, likewise of the first line, those of each more `apart` behind.
    """

    def generate(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        data, starts, factors = (_address(context, builder, signature.args[i], given[i]) for i in range(3))
        found = list[Any]()
        for i in range(LANES):
            at = builder.add(given[3], ir.Constant(given[3].type, i))
            begin, total = builder.gep(data, [builder.load(builder.gep(starts, [at]))]), None
            for _line in range(4):
                weight = _spread(builder, builder.load(builder.gep(factors, [at])))
                eight = _unaligned(builder, begin, LANES)
                total = builder.fmul(weight, eight) if total is None else _fma(builder, weight, eight, total)
                begin, at = builder.gep(begin, [given[4]]), builder.add(at, given[5])
            found.append(total)
        return context.make_tuple(builder, signature.return_type, _transposed(builder, found))

    return types.UniTuple(Floats, 8)(values, places, weights, _INDEX, _INDEX, _INDEX), generate


@_intrinsic
def store(_: Any, values: Any, place: Any, lanes: Any) -> Any:
    """Write Floats to an array, (n,), of float32, or rounded to one of bytes, from a place on."""

    def generate(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        return _stored(context, builder, signature, given[:2], given[2])

    return types.void(values, _INDEX, Floats), generate


@_intrinsic
def store_three(_: Any, values: Any, place: Any, a: Any, b: Any, c: Any) -> Any:
    """The same with three channels of pixels that lie together."""

    def generate(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        two, third = (builder.shuffle_vector(*pair, _order(range(2 * LANES))) for pair in (given[2:4], [given[4]] * 2))
        pixels = builder.shuffle_vector(two, third, _order([i + c * LANES for i in range(LANES) for c in range(3)]))
        return _stored(context, builder, signature, given[:2], pixels)

    return types.void(values, _INDEX, Floats, Floats, Floats), generate


@_intrinsic
def store_wholes(_: Any, values: Any, place: Any, lanes: Any) -> Any:
    """Write Wholes to an array, (n,), of int32, from a place on."""

    def generate(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        return _written(context, builder, _address(context, builder, signature.args[0], *given[:2]), given[2])

    return types.void(values, _INDEX, Wholes), generate


@_intrinsic
def fetch(_: Any, values: Any, place: Any) -> Any:
    """Have the processor bring a place of an array, (n,), near, which is soon to be read."""

    def generate(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        at = builder.bitcast(_address(context, builder, signature.args[0], *given), _BYTE.as_pointer())
        read, often, data = (ir.Constant(_WHOLE, number) for number in (0, 3, 1))
        _call(builder, "llvm.prefetch.p0", ir.VoidType(), at, read, often, data)
        return context.get_dummy_value()

    return types.void(values, _INDEX), generate


def _order(places: Any) -> ir.Constant:
    return ir.Constant(ir.VectorType(_WHOLE, len(places)), list(places))


def _address(context: Any, builder: Any, kind: Any, array: Any, place: Any = None) -> Any:
    data = context.make_array(kind)(context, builder, array).data
    return data if place is None else builder.gep(data, [place])


def _loaded(context: Any, builder: Any, signature: Any, given: Any, count: int) -> Any:
    return _unaligned(builder, _address(context, builder, signature.args[0], *given[:2]), count)


def _unaligned(builder: Any, at: Any, count: int) -> Any:
    """So many numbers; arrays may begin anywhere."""
    found = builder.load(builder.bitcast(at, ir.VectorType(at.type.pointee, count).as_pointer()))
    found.align = 1
    return found


def _loaded_apart(context: Any, builder: Any, signature: Any, given: Any) -> list[list[Any]]:
    """Two numbers for each lane: those of the first two of each four lanes, and those of the last two."""
    at = _address(context, builder, signature.args[0], *given[:2])
    found = list[Any]()
    for i in range(LANES):
        place = builder.sext(builder.extract_element(given[2], ir.Constant(_WHOLE, i)), ir.IntType(64))
        found.append(_unaligned(builder, builder.gep(at, [place]), 2))
    fours = range(0, LANES, 4)
    return [[found[four + i + k] for four in fours for k in range(2)] for i in (0, 2)]


def _concatenated(builder: Any, parts: list[Any]) -> Any:
    """One register of several."""
    while len(parts) > 1:
        order = _order(range(2 * parts[0].type.count))
        parts = [builder.shuffle_vector(*two, order) for two in zip(parts[::2], parts[1::2], strict=True)]
    return parts[0]


def _each_four(builder: Any, a: Any, b: Any, order: tuple[int, ...]) -> Any:
    """Of each four numbers of two registers some, by their places among these eight."""
    places = [4 * four + i + (LANES - 4) * (i > 3) for four in range(LANES // 4) for i in order]
    return builder.shuffle_vector(a, b, _order(places))


def _transposed(builder: Any, rows: list[Any]) -> list[Any]:
    """Eight registers of 8 numbers: the first of all, the second of all, ..."""
    halves = list[list[Any]]()
    for four in (rows[:4], rows[4:]):
        low, high = (
            [_each_four(builder, *four[i : i + 2], order) for i in (0, 2)] for order in ((0, 4, 1, 5), (2, 6, 3, 7))
        )
        halves.append(
            [_each_four(builder, *own, order) for own in (low, high) for order in ((0, 1, 4, 5), (2, 3, 6, 7))]
        )
    orders = (0, 1, 2, 3, 8, 9, 10, 11), (4, 5, 6, 7, 12, 13, 14, 15)
    return [builder.shuffle_vector(a, b, _order(order)) for order in orders for a, b in zip(*halves, strict=True)]


def _stored(context: Any, builder: Any, signature: Any, given: Any, lanes: Any) -> Any:
    at = _address(context, builder, signature.args[0], *given)
    return _written(context, builder, at, lanes if at.type.pointee == _FLOAT else _as_bytes(builder, lanes))


def _written(context: Any, builder: Any, at: Any, values: Any) -> Any:
    written = builder.store(values, builder.bitcast(at, values.type.as_pointer()))
    written.align = 1
    return context.get_dummy_value()


def _as_floats(builder: Any, values: Any) -> Any:
    return values if values.type.element == _FLOAT else builder.uitofp(values, ir.VectorType(_FLOAT, LANES))


def _as_bytes(builder: Any, values: Any) -> Any:
    count = values.type.count
    top = _alike(_FLOAT, 255.0, count)
    values = builder.select(builder.fcmp_ordered("<", values, top), values, top)
    values = _call(builder, f"llvm.rint.v{count}f32", values.type, values)
    return builder.trunc(builder.fptosi(values, ir.VectorType(_WHOLE, count)), ir.VectorType(_BYTE, count))
