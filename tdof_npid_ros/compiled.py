"""How the hot functions are compiled: Numba, IEEE arithmetic, machine code kept on disk.

No fast-math: a sum keeps its order and no multiply-add is fused but where it is written out, so a function gives the
same bits wherever it is
inlined and however many lanes are vectorised. That is what the four equalities (docs/architecture.md) stand on.
"""

from __future__ import annotations

import hashlib
import os
import tempfile
import warnings
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
    "bag/scan.py",
    "loop.py",
    "control/exponential.py",
    "control/law.py",
    "plants/kernels.py",
    "plants/lanes.py",
    "plants/per_lane.py",
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


def inlined_implementation_of(stub: Callable[..., Any]) -> Callable[[F], F]:
    """As `implementation_of`, and it is always inlined."""
    return cast(Callable[[F], F], overload(stub, strict=False, jit_options={"forceinline": True}))


def entry_point(function: F) -> F:
    """Compile a function that Python calls; its machine code is kept on disk for the next start.

    Numba looks only at the file of the function itself to see whether its cache is stale, but an entry point contains
    the inlined code of several files. So each state of those files has a cache folder of its own.
    """
    before = numba.config.CACHE_DIR
    folder = _cache_folder(before)
    if folder is None:
        return cast(F, numba.njit(error_model="numpy", nogil=True)(function))
    numba.config.CACHE_DIR = str(folder)
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


@cache
def _cache_folder(configured: str) -> Path | None:
    """Where machine code is kept; None where nothing can be.

    Numba would then take another place, beside the sources or in the home, without regard to the other files' state.
    """
    try:
        root = configured or os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
        folder = (Path(root) if configured else Path(root) / "tdof_npid_ros") / _sources_digest()
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return folder
    except (OSError, RuntimeError) as error:  # the latter: no home is known
        warnings.warn(
            f"machine code cannot be kept ({error}), so each start compiles anew: set NUMBA_CACHE_DIR", stacklevel=2
        )
        return None


def _sources_digest() -> str:
    digest = hashlib.sha256()
    for name in _SOURCES:
        digest.update((_PACKAGE / name).read_bytes())
    return digest.hexdigest()[:16]
