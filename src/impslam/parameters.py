"""Parameters: typed fields with a unit, a sentence and bounds, checked where they are read.

Whatever a field says itself, a number is finite and of a size that its unit can have: beyond,
arithmetic overflows somewhere and the message would be about that.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

from pydantic import BaseModel, ConfigDict, Field, JsonValue, ValidationInfo, field_validator

SIZES: dict[str, tuple[float, float]] = {
    "m": (1e-9, 1e6),  # an atom or ten; farther than any map in a plane
    "rad": (1e-9, 1e3),
    "s": (1e-6, 1e10),  # also between a clock that counts from 1970 and one that counts from 0
    "m/s": (1e-3, 1e3),
    "rad/s": (1e-3, 1e3),
    "m/sqrt(m)": (1e-6, 10.0),  # 10: no better than a guess after a step
    "rad/sqrt(m)": (1e-6, 10.0),
    "rad/sqrt(rad)": (1e-6, 10.0),
}
"""The smallest and the largest size of a number in each unit, beside 0."""

ANY_SIZE = (1e-9, 1e9)
"""The same for other units: ratios, counts, rates."""


class Parameters(BaseModel):
    """A table of parameters; a key that is none of them is an error."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    @field_validator("*")
    @classmethod
    def _has_a_size(cls, value: Any, info: ValidationInfo) -> Any:
        """Refuse numbers that nothing of their unit has, and NaN and inf where they mean nothing."""
        field = cls.model_fields[str(info.field_name)]
        extra = field.json_schema_extra
        if not isinstance(extra, dict):
            return value  # no parameter
        unit, meant = str(extra["unit"]), (repr(field.default), *str(extra["special"]).split())
        low, high = SIZES.get(unit.split(",", 1)[0], ANY_SIZE)
        for number in _numbers(value):
            if isinstance(number, int):
                if abs(number) >= 1 << 63:
                    raise ValueError("Input should be a number of at most 18 digits")
            elif not math.isfinite(number):
                if repr(number) not in meant:
                    raise ValueError("Input should be a finite number")
            elif number and not low <= abs(number) <= high:
                raise ValueError(f"Input should be 0, or {low:g} to {high:g} in size ({unit})")
        return value


def _numbers(value: Any) -> Iterator[float | int]:
    if isinstance(value, float | int):
        yield value
    elif isinstance(value, tuple | list):
        for part in value:
            yield from _numbers(part)


def parameter(
    default: Any,
    unit: str,
    sentence: str,
    *,
    special: str = "",
    noise: bool = False,
    **bounds: Any,
) -> Any:
    """Declare a parameter: its default, its unit ("m", "rad", "1", ...) and what it means.

    `bounds` are pydantic's (`gt`, `ge`, `lt`, `le`, ...). Pass `...` for a parameter that has no
    sensible default. NaN or inf is allowed if it is the default, or named in `special` ("nan inf");
    then the sentence says what it means. `noise` marks standard deviations that `imp tune` finds.
    """
    extra: dict[str, JsonValue] = {"unit": unit, "special": special, "noise": noise}
    return Field(default, description=sentence, json_schema_extra=extra, **bounds)
