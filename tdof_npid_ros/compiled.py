"""How the hot functions are compiled: Numba, IEEE arithmetic, machine code kept on disk.

No fast-math: a sum keeps its order and no multiply-add is fused but where it is written out, so a function gives the
same bits wherever it is
inlined and however many lanes are vectorised. That is what the equalities E1-E4 stand on.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, TypeVar, cast

import numba
from numba import types
from numba.extending import intrinsic, overload

F = TypeVar("F", bound=Callable[..., Any])

_PACKAGE = Path(__file__).parent
_SOURCES = (
    "compiled.py",
    "loop.py",
    "control/exponential.py",
    "control/law.py",
    "plants/kernels.py",
    "plants/lanes.py",
    "plants/states.py",
)


def compiled(function: F) -> F:
    """Compile a function into the compiled functions that call it."""
    return cast(F, numba.njit(error_model="numpy", nogil=True, forceinline=True)(function))


def called(function: F) -> F:
    """Compile a function that compiled functions call: for what is large and rarely needed, so that it exists once."""
    return cast(F, numba.njit(error_model="numpy", nogil=True)(function))


def _fused_multiply_add(typing_context: Any, a: Any, b: Any, c: Any) -> Any:
    """a * b + c, rounded once. Written out where it is wanted, so that every processor gives the same bits."""
    signature = types.float64(types.float64, types.float64, types.float64)
    return signature, lambda context, builder, sig, arguments: builder.fma(*arguments)


fused_multiply_add: Callable[[float, float, float], float] = intrinsic(_fused_multiply_add)


def implementation_of(stub: Callable[..., Any]) -> Callable[[F], F]:
    """Decorate a function that picks, by the types of the arguments, what a call of `stub` compiles to."""
    return cast(Callable[[F], F], overload(stub, strict=False))


def entry_point(function: F) -> F:
    """Compile a function that Python calls; its machine code is kept on disk for the next start.

    Numba looks only at the file of the function itself to see whether its cache is stale, but an entry point contains
    the inlined code of several files. So each state of those files has a cache folder of its own.
    """
    before = numba.config.CACHE_DIR
    numba.config.CACHE_DIR = str(_cache_root(before) / _sources_digest())
    try:
        return cast(F, numba.njit(error_model="numpy", nogil=True, cache=True)(function))
    finally:
        numba.config.CACHE_DIR = before


@cache
def uncached(entry: Any) -> Any:
    """An entry point whose machine code is not kept: for what a user's class is compiled into.

    A cache that names a class of the user's could not even be read where that class cannot be imported.
    """
    return numba.njit(error_model="numpy", nogil=True)(entry.py_func)


def _cache_root(configured: str) -> Path:
    if configured:
        return Path(configured)
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "tdof_npid_ros"


def _sources_digest() -> str:
    digest = hashlib.sha256()
    for name in _SOURCES:
        digest.update((_PACKAGE / name).read_bytes())
    return digest.hexdigest()[:16]
