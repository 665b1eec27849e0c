"""The one place that decides how kernels are compiled.

Kernels are plain functions over arrays. They are compiled by numba on first use and cached on disk; with
NUMBA_DISABLE_JIT=1 they run as ordinary Python. `fastmath` stays off: same input, same bits. Kernels
keep the interpreter lock: they take microseconds, and handing it over costs a step milliseconds.
"""

from collections.abc import Callable
from typing import TypeVar, cast

import numba

F = TypeVar("F", bound=Callable[..., object])


def kernel(function: F) -> F:
    """Compile a function over arrays; its type stays what it was for the type checker."""
    return cast(F, numba.njit(cache=True, error_model="numpy")(function))
