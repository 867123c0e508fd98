"""What instructions on registers of LANES numbers are made of, for `_lanes`.

LANES of them at once: 16 with AVX-512, 8 with AVX2, and 0 where a processor has neither. `NUMBA_CPU_NAME` and
`NUMBA_CPU_FEATURES` say otherwise, as for all that numba compiles.
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

FLOAT, WHOLE, BYTE, FLAG = ir.FloatType(), ir.IntType(32), ir.IntType(8), ir.IntType(1)
INDEX = types.uintp


class _Lanes(types.Type):
    """So many numbers of a type, as the compiler has them."""

    def __init__(self, name: str, element: ir.Type):
        super().__init__(name=f"{LANES} {name}")
        self.element = element


@register_model(_Lanes)
class _Model(models.PrimitiveModel):
    def __init__(self, manager: Any, lanes: _Lanes):
        super().__init__(manager, lanes, ir.VectorType(lanes.element, LANES))


Floats, Wholes, Flags = _Lanes("float32", FLOAT), _Lanes("int32", WHOLE), _Lanes("bool", FLAG)


def intrinsic(typed: Callable[..., Any]) -> Callable[..., Any]:
    """As it is called: what is compiled hands itself over, too."""
    return numba_intrinsic(typed)


def operation(build: Callable[..., Any], result: Any, *arguments: Any) -> Callable[..., Any]:
    """What is called in compiled functions: `build(builder, *values)` makes its instructions."""

    def typed(*_: Any) -> Any:
        return result(*arguments), lambda context, builder, signature, values: build(builder, *values)

    # numba counts the arguments of what it is given.
    takers: dict[int, Callable[..., Any]] = {
        1: lambda context, a: typed(),
        2: lambda context, a, b: typed(),
        3: lambda context, a, b, c: typed(),
    }
    return intrinsic(takers[len(arguments)])


def call(builder: Any, name: str, result: ir.Type, *values: Any) -> Any:
    """One of LLVM's own functions."""
    known = builder.module.globals.get(name)
    kind = ir.FunctionType(result, [value.type for value in values])
    return builder.call(known or ir.Function(builder.module, kind, name), values)


def alike(element: ir.Type, value: Any, count: int = LANES) -> ir.Constant:
    """A register of one known number."""
    return ir.Constant(ir.VectorType(element, count), [value] * count)


def spread(builder: Any, value: Any) -> Any:
    """A register of one number."""
    one = ir.Constant(ir.VectorType(value.type, LANES), ir.Undefined)
    one = builder.insert_element(one, value, ir.Constant(WHOLE, 0))
    return builder.shuffle_vector(one, one, alike(WHOLE, 0))


def fma_of(builder: Any, *values: Any) -> Any:
    """A b + c, rounded once."""
    return call(builder, f"llvm.fma.v{LANES}f32", values[0].type, *values)


def in_order(places: Any) -> ir.Constant:
    """Places, as a shuffle takes them."""
    return ir.Constant(ir.VectorType(WHOLE, len(places)), list(places))


def address(context: Any, builder: Any, kind: Any, array: Any, place: Any = None) -> Any:
    """Where an array begins, or a place of it."""
    data = context.make_array(kind)(context, builder, array).data
    return data if place is None else builder.gep(data, [place])


def unaligned(builder: Any, at: Any, count: int) -> Any:
    """So many numbers; arrays may begin anywhere."""
    found = builder.load(builder.bitcast(at, ir.VectorType(at.type.pointee, count).as_pointer()))
    found.align = 1
    return found


def concatenated(builder: Any, parts: list[Any]) -> Any:
    """One register of several."""
    while len(parts) > 1:
        all_of_both = in_order(range(2 * parts[0].type.count))
        parts = [builder.shuffle_vector(*two, all_of_both) for two in zip(parts[::2], parts[1::2], strict=True)]
    return parts[0]


def each_four(builder: Any, a: Any, b: Any, order: tuple[int, ...]) -> Any:
    """Of each four numbers of two registers some, by their places among these eight."""
    places = [4 * four + i + (LANES - 4) * (i > 3) for four in range(LANES // 4) for i in order]
    return builder.shuffle_vector(a, b, in_order(places))


def transposed(builder: Any, rows: list[Any]) -> list[Any]:
    """Eight registers of 8 numbers: the first of all, the second of all, ..."""
    halves = list[list[Any]]()
    for a, b, c, d in (rows[:4], rows[4:]):
        found = list[Any]()
        for pairs in ((0, 4, 1, 5), (2, 6, 3, 7)):
            first, second = each_four(builder, a, b, pairs), each_four(builder, c, d, pairs)
            found += [each_four(builder, first, second, order) for order in ((0, 1, 4, 5), (2, 3, 6, 7))]
        halves.append(found)
    orders = (0, 1, 2, 3, 8, 9, 10, 11), (4, 5, 6, 7, 12, 13, 14, 15)
    return [builder.shuffle_vector(a, b, in_order(order)) for order in orders for a, b in zip(*halves, strict=True)]


def written(context: Any, builder: Any, at: Any, values: Any) -> Any:
    """Has values written to an address, wherever it lies."""
    store = builder.store(values, builder.bitcast(at, values.type.as_pointer()))
    store.align = 1
    return context.get_dummy_value()


def as_floats(builder: Any, values: Any) -> Any:
    """Numbers of any type as floats."""
    return values if values.type.element == FLOAT else builder.uitofp(values, ir.VectorType(FLOAT, LANES))


def as_bytes(builder: Any, values: Any) -> Any:
    """Floats rounded to bytes."""
    count = values.type.count
    top = alike(FLOAT, 255.0, count)
    values = builder.select(builder.fcmp_ordered("<", values, top), values, top)
    values = call(builder, f"llvm.rint.v{count}f32", values.type, values)
    return builder.trunc(builder.fptosi(values, ir.VectorType(WHOLE, count)), ir.VectorType(BYTE, count))
