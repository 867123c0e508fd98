"""How functions are compiled by numba, once for each machine."""

import hashlib
import os
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, TypeVar, cast

import numba
import numpy as np
from numba import types
from numba.extending import intrinsic
from numpy.typing import NDArray

_F = TypeVar("_F", bound=Callable[..., Any])

if numba.config.DISABLE_JIT:  # pyright: ignore[reportAttributeAccessIssue]  # set when it is imported
    raise ImportError("numba is told to compile nothing, by NUMBA_DISABLE_JIT")


def jit(function: _F) -> _F:
    """The function, compiled at its first call for the types of its arguments, and free of Python's lock.

    What was compiled is kept in numba's own folder for that if there is one, beside the source, or in the user's cache.
    """
    # Said, since numba would else hand on to it that it is called in one that is inlined.
    return _compiled(function, forceinline=False)


def inlined(function: _F) -> _F:
    """The same, made part of each function that calls it: for what passes registers on."""
    return _compiled(function, forceinline=True)


def _compiled(function: _F, **more: bool) -> _F:
    options: dict[str, Any] = {"nogil": True, "error_model": "numpy", **more}
    config: Any = numba.config
    before, config.CACHE_DIR = config.CACHE_DIR, _folder()
    try:
        return cast(_F, numba.njit(cache=True, **options)(function))
    except RuntimeError:  # nothing can be written anywhere
        return cast(_F, numba.njit(**options)(function))
    finally:
        config.CACHE_DIR = before


@cache
def _folder() -> str:
    """Where what is compiled of these sources is kept: of other ones elsewhere.

    By itself numba looks at the file of a function alone, not at those of the functions that it calls.
    """
    package = Path(__file__).parent
    alone = ("_jit.py", "_lanes.py", "_registers.py", "noise_kernel.py")
    folders = (package / layer / "kernels" for layer in ("fields", "warping"))
    sources = [
        *(package / name for name in alone),
        *(source for each in folders for source in sorted(each.glob("*.py"))),
    ]
    digest = hashlib.sha256(b"".join(source.read_bytes() for source in sources)).hexdigest()[:16]
    if given := str(numba.config.CACHE_DIR):  # pyright: ignore[reportAttributeAccessIssue]  # as above
        return str(Path(given) / f"torchrefract-{digest}")
    # Who has no home has none of that name either.
    places = package / "__pycache__", Path(os.path.expanduser("~")) / ".cache"
    writable = (place for place in places if os.access(place if place.exists() else place.parent, os.W_OK))
    return next((str(place / f"torchrefract-{digest}") for place in writable), "")  # then as numba has it


def _fma(_: Any, a: Any, b: Any, c: Any) -> Any:
    """A b + c, rounded once."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.fma(*arguments)

    return a(a, b, c), generate


def _pointer(_: Any, address: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.inttoptr(arguments[0], context.get_value_type(signature.return_type))

    return types.voidptr(address), generate


_to_pointer = cast(Callable[[Any], Any], intrinsic(_pointer))


@inlined
def floats_at(address: np.uint64, count: int) -> NDArray[np.float32]:
    """An array, (count,), of what lies there, which somebody else has to keep."""
    return numba.carray(_to_pointer(address), (count,), np.float32)


# As it is called: what numba calls hands itself over, too.
fma = cast(Callable[[Any, Any, Any], Any], intrinsic(_fma))


def _alone(_: Any) -> Any:
    """Has the function that calls it stay one of its own: for what is long and seldom called."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        builder.function.attributes.add("noinline")
        return context.get_dummy_value()

    return types.void(), generate


alone = cast(Callable[[], None], intrinsic(_alone))


def _horner(_: Any, a: Any, coefficients: Any) -> Any:
    """The polynomial of a with these coefficients, of the highest power first; a loop would not be unrolled."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        value, *rest = (builder.extract_value(arguments[1], i) for i in range(len(coefficients)))
        for coefficient in rest:
            value = builder.fma(value, arguments[0], coefficient)
        return value

    return a(a, coefficients), generate


horner = cast(Callable[[Any, Any], Any], intrinsic(_horner))
