"""Compiling: where Numba keeps its cache, and effects' laws as functions called by their address.

A law is a small Python function.  It is compiled once by itself to machine code with one signature and reached by
its address, so that the stepper is one compiled program for every set of effects, and an effect of a user's own
joins it without recompiling anything else.
"""

from __future__ import annotations

import functools
import os
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import platformdirs


def _writable(folder: Path) -> bool:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return True
    except OSError:
        return False


if "NUMBA_CACHE_DIR" not in os.environ and not _writable(Path(__file__).parent / "__pycache__"):
    _caches = (Path(platformdirs.user_cache_dir("station")) / "numba", Path(tempfile.gettempdir()) / "station-numba")
    os.environ["NUMBA_CACHE_DIR"] = str(next((c for c in _caches if _writable(c)), _caches[-1]))

from llvmlite import ir  # noqa: E402  (Numba reads its cache folder when it is imported)
from numba import cfunc, njit, types  # noqa: E402
from numba.core import cgutils  # noqa: E402
from numba.core.errors import NumbaError  # noqa: E402
from numba.extending import intrinsic  # noqa: E402

from station.errors import UsageError  # noqa: E402

__all__ = ["address", "call_law", "element", "kernel", "njit"]

kernel = functools.partial(njit, cache=True, nogil=True, _nrt=False)
"""njit for loops that allocate nothing: arrays are not counted in and out at every call (five times as fast where many
arrays go through small functions).  Numba keeps the switch to itself (``_nrt``), but knows it in all its targets."""

_POINTER = types.CPointer(types.float64)
LAW = types.float64(types.float64, types.float64, types.float64, _POINTER, _POINTER, types.float64)
_compiled: dict[Callable[..., float], Any] = {}


def address(law: Callable[..., float]) -> int:
    """Machine address of a law, compiled on first use and kept alive (and cached on disk where it has a file).

    UsageError: a law that Numba cannot compile.
    """
    if law not in _compiled:
        on_disk = law.__code__.co_filename.endswith(".py") and Path(law.__code__.co_filename).exists()
        try:
            try:
                _compiled[law] = cfunc(LAW, cache=on_disk, error_model="numpy")(law)
            except ModuleNotFoundError:  # the cache was written where the same file was loaded under another name
                _compiled[law] = cfunc(LAW, error_model="numpy")(law)
        except NumbaError as error:
            where = f"{law.__code__.co_filename}, line {law.__code__.co_firstlineno}"
            reason = next((line.strip() for line in str(error).splitlines()[1:] if line.strip()), str(error))
            raise UsageError(f"effects: the law {law.__name__} ({where}) does not compile: {reason}") from None
    return _compiled[law].address


@intrinsic
def call_law(typingctx, where, x, v, w, p, s, h):  # type: ignore[no-untyped-def]
    """Call the law at an address."""
    signature = types.float64(types.int64, types.float64, types.float64, types.float64, _POINTER, _POINTER,
                              types.float64)

    def codegen(context, builder, sig, args):  # type: ignore[no-untyped-def]
        double = ir.DoubleType()
        pointer = ir.PointerType(double)
        kind = ir.FunctionType(double, [double, double, double, pointer, pointer, double])
        return builder.call(builder.inttoptr(args[0], ir.PointerType(kind)), args[1:])

    return signature, codegen


@intrinsic
def element(typingctx, array, index):  # type: ignore[no-untyped-def]
    """Pointer to one element of a contiguous float64 array."""
    signature = _POINTER(array, types.int64)

    def codegen(context, builder, sig, args):  # type: ignore[no-untyped-def]
        data = context.make_array(sig.args[0])(context, builder, args[0]).data
        return cgutils.gep_inbounds(builder, data, args[1])

    return signature, codegen
