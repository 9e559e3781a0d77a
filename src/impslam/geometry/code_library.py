"""The machine code of a kernel: made once, for what Python calls, out of all that it calls.

numba optimises each function and makes its machine code, then does so again in every function that
calls it. Here a function that only other functions call stays unoptimised bitcode, and what is left to
optimise is optimised once, as a whole.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from numba.core import environment
from numba.core.codegen import JITCodeLibrary

_ENVIRONMENT = "_ZN08NumbaEnv"  # what the names of numba's environments in machine code begin with


class CodeLibrary(JITCodeLibrary):
    """The code of one kernel and of what it calls; machine code when its address is asked for."""

    _codegen: Any

    def __init__(self, codegen: Any, name: str) -> None:
        super().__init__(codegen, name)
        self._is_machine_code = False

    @property
    def codegen(self) -> Any:
        """The code generator; environments are set once there is machine code that uses them."""
        return self._codegen if self._is_machine_code else _WithoutEnvironments()

    def finalize(self) -> None:
        """Link what the kernel calls; nothing can be added any more."""
        self._raise_if_finalized()
        for library in dict.fromkeys(self._linking_libraries):
            self._reload_init.update(library._reload_init)
            self._final_module.link_in(library._get_module_for_linking(), preserve=True)
        self._finalized = True

    def _optimize_functions(self, ll_module: Any) -> None:
        """Leave it to the optimisation of the whole kernel, which is no slower for that."""
        ll_module.data_layout = self._codegen._data_layout

    def get_pointer_to_function(self, name: str) -> int:
        """Return the address of the kernel's wrapper for Python, 0 where it has none."""
        self._ensure_finalized()
        if not self._is_machine_code:
            if not _defines(self._final_module, name):
                return 0
            self._make_machine_code()
        address: int = self._codegen._engine.get_function_address(name)
        return address

    def _make_machine_code(self) -> None:
        self._optimize_final_module()
        self._final_module.verify()
        self._finalize_final_module()
        self._is_machine_code = True
        for variable in self._final_module.global_variables:
            if variable.name.startswith(_ENVIRONMENT):
                known = environment.lookup_environment(variable.name)
                if known is not None:
                    self._codegen.set_env(variable.name, known)

    def serialize_using_object_code(self) -> tuple[str, str, tuple[bytes]]:
        """Return what `_unserialize` makes a library of: no other kernel is compiled from it."""
        return self.name, "object", (self._get_compiled_object(),)

    @classmethod
    def _unserialize(cls, codegen: Any, state: tuple[str, str, tuple[bytes]]) -> Any:
        name, _, (machine_code,) = state
        library = cls(codegen, name)
        library.enable_object_caching()
        library._set_compiled_object(machine_code)
        library._finalize_final_module()
        library._is_machine_code = True
        return library


class _WithoutEnvironments:
    """Stands for the code generator of a library that has no machine code."""

    def set_env(self, name: str, environment: object) -> None:
        """Do nothing."""


def _defines(module: Any, name: str) -> bool:
    try:
        return not module.get_function(name).is_declaration
    except NameError:
        return False


@contextmanager
def code_libraries(codegen: Any) -> Iterator[None]:
    """Have all that is compiled or loaded meanwhile in libraries of this kind."""
    before = codegen._library_class
    codegen._library_class = CodeLibrary
    try:
        yield
    finally:
        codegen._library_class = before
