"""The machine code of a kernel: generated once for each entry point, with all functions that it calls.

numba optimises each function and generates its machine code, then does so again in every function that
calls it. Here a function that is only called by others stays unoptimised bitcode, and an entry point is
optimised once, as a whole.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from numba.core import environment
from numba.core.codegen import JITCodeLibrary

_ENVIRONMENT = "_ZN08NumbaEnv"  # prefix of numba's environments in machine code


class CodeLibrary(JITCodeLibrary):
    """The code of one kernel and its callees; machine code is generated when its address is requested."""

    _codegen: Any

    def __init__(self, codegen: Any, name: str) -> None:
        super().__init__(codegen, name)
        self._is_machine_code = False

    @property
    def codegen(self) -> Any:
        """The code generator; environments are set only once machine code uses them."""
        return self._codegen if self._is_machine_code else _WithoutEnvironments()

    def finalize(self) -> None:
        """Link the callees; nothing can be added afterwards."""
        self._raise_if_finalized()
        for library in dict.fromkeys(self._linking_libraries):
            self._reload_init.update(library._reload_init)
            self._final_module.link_in(library._get_module_for_linking(), preserve=True)
        self._finalized = True

    def _optimize_functions(self, ll_module: Any) -> None:
        """Only set the data layout; the whole kernel is optimised later, at no loss of speed."""
        ll_module.data_layout = self._codegen._data_layout

    def get_pointer_to_function(self, name: str) -> int:
        """Return the address of the kernel's wrapper for Python, 0 if it has none."""
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
        """Return the state for `_unserialize`: object code alone, as no other kernel links to it."""
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
    """Placeholder for the code generator of a library without machine code."""

    def set_env(self, name: str, environment: object) -> None:
        """Do nothing."""


def _defines(module: Any, name: str) -> bool:
    try:
        return not module.get_function(name).is_declaration
    except NameError:
        return False


@contextmanager
def code_libraries(codegen: Any) -> Iterator[None]:
    """Use `CodeLibrary` for all code compiled or loaded within the context."""
    before = codegen._library_class
    codegen._library_class = CodeLibrary
    try:
        yield
    finally:
        codegen._library_class = before
