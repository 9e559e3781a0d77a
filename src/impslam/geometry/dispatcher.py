"""What compiles a kernel: as a function of Python, or into another kernel."""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import Any

from numba.core import event, sigutils
from numba.core.compiler_lock import global_compiler_lock
from numba.core.registry import CPUDispatcher
from numba.core.typing.templates import make_concrete_template

from impslam.geometry.borrowing import KernelCompiler
from impslam.geometry.code_library import code_libraries

_ENTRY = {"nopython": True, "nogil": True, "boundscheck": None, "no_cfunc_wrapper": True}
_PART = _ENTRY | {"no_cpython_wrapper": True}


class KernelDispatcher(CPUDispatcher):
    """Compiles a function for Python, and separately as a part of the kernels that call it.

    A part has no wrapper for Python and no machine code of its own, and is not cached; its caller is.
    """

    _compiler: Any
    targetctx: Any

    def __init__(self, function: Callable[..., object], *_: object) -> None:  # of a pickle
        super().__init__(function, targetoptions=_ENTRY, pipeline_class=KernelCompiler)
        self._part_compiler = copy.copy(self._compiler)
        self._part_compiler.targetoptions = _PART
        self._parts: dict[tuple[Any, ...], Any] = {}

    def compile(self, sig: Any) -> Any:
        """Compile for Python."""
        with global_compiler_lock, code_libraries(self.targetctx.codegen()):
            return super().compile(sig)

    def get_call_template(self, args: Any, kws: Any) -> tuple[Any, ...]:
        """Compile as a part of a kernel that calls this one, and return the type of the call."""
        signature, types = self._compiler.fold_argument_types(args, kws)
        part = self._part(tuple(types))
        name = self.py_func.__name__
        template = make_concrete_template(name, key=name, signatures=[part.signature])
        return template, signature, types, {}

    def get_overload(self, sig: Any) -> Any:
        """Return the entry point of a part."""
        types, _ = sigutils.normalize_signature(sig)
        return self._part(tuple(types)).entry_point

    def _part(self, types: tuple[Any, ...]) -> Any:
        with global_compiler_lock, self._compiling_counter:
            if types not in self._parts:
                self._parts[types] = self._compiled_part(types)
            return self._parts[types]

    def _compiled_part(self, types: tuple[Any, ...]) -> Any:
        details = {"dispatcher": self, "args": types, "return_type": None}
        with (
            code_libraries(self.targetctx.codegen()),
            event.trigger_event("numba:compile", data=details),
        ):
            return self._part_compiler.compile(types, None)
