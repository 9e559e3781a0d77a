"""How runs may be compared: apart from what compares them, since the command line offers it."""

from __future__ import annotations

from typing import Literal, TypeAlias

Alignment: TypeAlias = Literal["fit", "start", "none"]
"""Where errors are taken: the path fitted to the truth, laid on its start, or as it is given."""
GATE = 0.5
"""m: an estimate further off than this is of something else ; landmarks are farther apart."""
