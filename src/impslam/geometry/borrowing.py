"""Compile kernels so that variables that only borrow an array hold no reference to it.

numba counts a reference for each array that a function receives, reads from a tuple or slices. The counts
are atomic, and took a tenth of the time of a run in functions that are called for each point of a scan. A
caller keeps its arrays until the call ends, so a function need not count what it reads of them.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from numba.core import ir
from numba.core.compiler import CompilerBase, DefaultPassBuilder
from numba.core.compiler_machinery import PassManager, register_pass
from numba.core.lowering import Lower
from numba.core.typed_passes import NativeLowering

_VIEWS = {"getattr", "getitem", "static_getitem", "build_tuple", "exhaust_iter", "cast"}
"""Operations whose result refers to the memory of their operands, unless an index is an array."""


class KernelCompiler(CompilerBase):
    """numba's compiler with `KernelLowering`."""

    def define_pipelines(self) -> list[PassManager]:
        """Return the passes that compile a kernel."""
        passes = DefaultPassBuilder.define_nopython_pipeline(self.state)
        passes.passes = [
            (KernelLowering if each is NativeLowering else each, text)
            for each, text in passes.passes
        ]
        passes.finalize()
        return [passes]


class KernelLower(Lower):
    """Generates the code of a function, without references of the variables that borrow."""

    def init(self) -> None:
        """Find the variables that borrow; called by numba."""
        super().init()
        models, types = self.context.data_model_manager, self.fndesc.typemap
        self._counting, self._borrowing = self.context, self.context.subtarget(enable_nrt=False)
        self._borrowers = borrowers(
            self.func_ir, lambda name: bool(models[types[name]].contains_nrt_meminfo())
        )

    def lower_inst(self, inst: Any) -> None:
        """Generate the code of a statement."""
        name = inst.target.name if isinstance(inst, ir.Assign) else None
        name = inst.value if isinstance(inst, ir.Del) else name
        self.context = self._borrowing if name in self._borrowers else self._counting
        super().lower_inst(inst)


@register_pass(mutates_CFG=True, analysis_only=False)
class KernelLowering(NativeLowering):
    """numba's pass with `KernelLower`."""

    _name = "kernel_lowering"

    @property
    def lowering_class(self) -> type[Lower]:
        """The class that generates code."""
        return KernelLower


def borrowers(function: Any, has_array: Callable[[str], bool]) -> set[str]:
    """Return the variables of a function that only refer to arrays of its arguments, or constants.

    Their values are arguments, or are read from other borrowers. None is returned, as the caller owns what
    a function returns.
    """
    statements = [one for block in function.blocks.values() for one in block.body]
    assigned = [one for one in statements if isinstance(one, ir.Assign)]
    returned = {one.value.name for one in statements if isinstance(one, ir.Return)}
    found = {one.target.name for one in assigned if has_array(one.target.name)} - returned

    def borrows(value: Any) -> bool:
        if isinstance(value, ir.Expr):
            if value.op not in _VIEWS or (value.op == "getitem" and has_array(value.index.name)):
                return False
            arrays = (variable.name for variable in value.list_vars() if has_array(variable.name))
            return found.issuperset(arrays)
        return value.name in found if isinstance(value, ir.Var) else True

    before = None
    while found != before:
        before = set(found)
        found.difference_update(one.target.name for one in assigned if not borrows(one.value))
    return found
