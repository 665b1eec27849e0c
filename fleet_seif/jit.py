"""The one place that decides how kernels are compiled, and how many threads libraries of linear algebra may use.

Kernels are plain functions over arrays. They are compiled by numba on first use and cached on disk; with
NUMBA_DISABLE_JIT=1 they run as ordinary Python. `fastmath` stays off: same input, same bits. Kernels
keep the interpreter lock: they take microseconds, and handing it over costs a step milliseconds.
"""

from collections.abc import Callable
from typing import TypeVar, cast

import numba
import scipy.linalg  # noqa: F401  # with a BLAS of its own, which the controller below has to find
import threadpoolctl

F = TypeVar("F", bound=Callable[..., object])
_libraries = threadpoolctl.ThreadpoolController()


def kernel(function: F) -> F:
    """Compile a function over arrays; its type stays what it was for the type checker."""
    return cast(F, numba.njit(cache=True, error_model="numpy")(function))


def long_kernel(function: F) -> F:
    """The same for one that takes milliseconds and runs beside other threads: it lets go of the interpreter lock."""
    return cast(F, numba.njit(cache=True, error_model="numpy", nogil=True)(function))


def one_thread(function: F) -> F:
    """Run a function with single-threaded BLAS: the same bits on any number of cores, no threads waiting for others."""
    return cast(F, _libraries.wrap(limits=1, user_api="blas")(function))
