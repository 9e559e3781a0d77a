"""Options of comparisons, in a module of their own for the command line."""

from __future__ import annotations

from typing import Literal, TypeAlias

Alignment: TypeAlias = Literal["fit", "start", "none"]
"""Alignment of the path: fitted to the truth, aligned at the start, or none."""
GATE = 0.5
"""m: maximum distance of an estimate from its true landmark; landmarks are farther apart."""
