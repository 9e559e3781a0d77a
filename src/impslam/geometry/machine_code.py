"""Cache the machine code of kernels between runs, and load it fast.

numba's own cache tracks the file of a function, but not the kernels of other files that are compiled into
it; and loading machine code imports all that compiling needs: 0.3 s, much of it scipy.
"""

from __future__ import annotations

import functools
import hashlib
import logging
import multiprocessing
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FunctionType
from typing import Any, get_type_hints

from numba.core import environment
from numba.core.caching import FunctionCache, IndexDataCacheFile
from numba.core.runtime.nrt import rtsys

from impslam.geometry import borrowing, code_library
from impslam.geometry.scipy_extension import load

log = logging.getLogger(__name__)


class CodeFiles(IndexDataCacheFile):
    """The cache files of one kernel. A file that cannot be unpickled counts as missing.

    The files name the types of the kernel's arguments, and another version of this program may have
    renamed these types. A file may also be damaged, for example by a power loss.
    """

    def _load_index(self) -> dict[object, str]:
        try:
            index: dict[object, str] = super()._load_index()
        except Exception as error:
            log.debug("compiled code is not used: %s: %s", self._index_path, error)
            return {}
        return index

    def _load_data(self, name: str) -> object:
        try:
            return super()._load_data(name)
        except Exception as error:
            raise OSError(f"{name}: {error}") from error  # as of a missing file


class MachineCode(FunctionCache):
    """Compiled code in NUMBA_CACHE_DIR, beside the module, or in the user's cache folder.

    The first of these that is writable is used. Code that cannot be cached still runs.
    """

    def __init__(self, function: Callable[..., object]) -> None:
        super().__init__(function)
        files = self._cache_file
        self._cache_file = CodeFiles(
            files._cache_path, self._impl.filename_base, files._source_stamp
        )

    def load_overload(self, sig: object, target_context: Any) -> object:
        """Return a cached function of the same source, or None.

        Machine code only needs numba's runtime; numba imports the rest when it has to compile.
        """
        self._cache_file._source_stamp = source_stamp(self._py_func)
        rtsys.initialize(target_context)
        _load_linear_algebra()
        with (
            self._guard_against_spurious_io_errors(),
            _bare_environments(),
        ):
            return self._load_overload(sig, target_context)

    def save_overload(self, sig: object, data: object) -> None:
        """Save a compiled function for the next run."""
        try:
            super().save_overload(sig, data)
        except OSError as error:
            warn_once(f"compiled code cannot be kept: {error}")


@functools.cache
def _load_linear_algebra() -> None:
    """Load the modules that numba's runtime looks up when a kernel first multiplies matrices.

    It would otherwise import all of `scipy.linalg`: 0.2 s and 25 MB.
    """
    for name in ("scipy.linalg.cython_blas", "scipy.linalg.cython_lapack"):
        load(name, name)


@functools.cache
def warn_once(problem: str) -> None:
    """Warn that compiled code is not cached."""
    if multiprocessing.parent_process() is None:  # a worker's parent has warned already
        log.warning(
            "%s, so every run compiles again (a minute or two); set NUMBA_CACHE_DIR to a writable folder",
            problem,
        )


def source_stamp(function: FunctionType) -> str:
    """Return a hash of all source that is compiled into a function.

    It covers the function's file, the files of the kernels that it calls, the fields of the named tuples in
    their annotations, constants from other modules, and the modules that determine the machine code.
    """
    digest, seen = hashlib.sha256(), {function}
    for module in (borrowing, code_library):
        digest.update(_file_hash(module.__file__))
    waiting = [function]
    for caller in waiting:
        digest.update(_file_hash(caller.__code__.co_filename))
        for name in (*caller.__code__.co_names, *map(str, caller.__annotations__.values())):
            value = caller.__globals__.get(name)
            called = getattr(value, "py_func", None)
            if isinstance(value, type) and hasattr(value, "_fields"):
                digest.update(_layout(value).encode())
            elif called is None and isinstance(value, bool | int | float | str | tuple):
                digest.update(f"{name} = {value!r}".encode())
            elif called is not None and called not in seen:
                seen.add(called)
                waiting.append(called)
    return digest.hexdigest()


@functools.cache
def _layout(kind: Any) -> str:
    """Return the fields of a named tuple, and of those in it, which machine code reads by index."""
    parts = [_layout(part) for part in get_type_hints(kind).values() if hasattr(part, "_fields")]
    return f"{kind.__name__}{kind._fields}{parts}"


@functools.cache
def _file_hash(path: str) -> bytes:
    file = Path(path)
    return hashlib.sha256(file.read_bytes()).digest() if file.is_file() else b""


@contextmanager
def _bare_environments() -> Iterator[None]:
    """Load numba's functions in machine code without importing their modules.

    Only interpreted code needs the names of these modules. numba holds its lock in this context, so that
    no other thread loads anything.
    """
    whole: Callable[..., Any] = environment._rebuild_env
    environment._rebuild_env = _rebuild_bare
    try:
        yield
    finally:
        environment._rebuild_env = whole


def _rebuild_bare(module: str, constants: list[object], name: str) -> object:
    known = environment.lookup_environment(name)
    if known is not None:
        return known
    names = vars(sys.modules[module]) if module in sys.modules else {"__name__": module}
    bare = environment.Environment(names)
    bare.consts[:] = constants
    bare.env_name = name
    environment.Environment._memo[name] = bare
    return bare
