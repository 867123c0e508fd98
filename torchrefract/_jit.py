"""How functions are compiled by numba, once for each machine."""

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba
from numba.extending import intrinsic

_F = TypeVar("_F", bound=Callable[..., Any])

if numba.config.DISABLE_JIT:  # pyright: ignore[reportAttributeAccessIssue]  # set when it is imported
    raise ImportError("numba is told to compile nothing, by NUMBA_DISABLE_JIT")


def jit(function: _F) -> _F:
    """The function, compiled at its first call for the types of its arguments, and free of Python's lock.

    What was compiled is kept beside the source or, if nothing can be written there, in the user's cache.
    """
    options: dict[str, Any] = {"nogil": True, "error_model": "numpy"}
    try:
        return cast(_F, numba.njit(cache=True, **options)(function))
    except RuntimeError:  # nor can that be written
        return cast(_F, numba.njit(**options)(function))


def _fma(_: Any, a: Any, b: Any, c: Any) -> Any:
    """A b + c, rounded once."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.fma(*arguments)

    return a(a, b, c), generate


# As it is called: what numba calls hands itself over, too.
fma = cast(Callable[[Any, Any, Any], Any], intrinsic(_fma))
