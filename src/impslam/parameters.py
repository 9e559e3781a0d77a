"""Parameters: typed fields with a unit, a description and bounds, checked when they are read.

Besides the bounds of its field, a number must be finite and plausible in its unit: otherwise arithmetic
would overflow somewhere, with a message about that.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any, get_args

from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    JsonValue,
    ValidationError,
    ValidationInfo,
    field_validator,
    model_validator,
)
from pydantic_core import InitErrorDetails, PydanticCustomError

SIZES: dict[str, tuple[float, float]] = {
    "m": (1e-9, 1e6),  # some atoms; more than any planar map
    "rad": (1e-9, 6.3),  # a full turn; more is an angle in degrees
    "s": (1e-6, 1e10),  # up to the offset between a Unix clock and one that starts at 0
    "m/s": (1e-3, 1e3),
    "rad/s": (1e-3, 1e3),
    "m/sqrt(m)": (1e-6, 10.0),  # 10: useless after a short distance
    "rad/sqrt(m)": (1e-6, 10.0),
    "rad/sqrt(rad)": (1e-6, 10.0),
}
"""Minimum and maximum magnitude of a number other than 0, by unit."""

ANY_SIZE = (1e-9, 1e9)
"""The same for other units: ratios, counts, rates."""


class Parameters(BaseModel):
    """A table of parameters; unknown keys are errors."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    @model_validator(mode="before")
    @classmethod
    def _check_no_booleans(cls, table: Any) -> Any:
        """Raise for true and false where a number is expected, which Python would take for 1 and 0.

        Not a validator of fields, because pydantic allows none for the one that names a member of a union.
        """
        for name in table if isinstance(table, dict) else ():
            if name not in cls.model_fields:
                continue
            kinds = _simple_kinds(cls.model_fields[name].annotation)
            is_number = bool not in kinds and not kinds.isdisjoint((float, int))
            if is_number and any(isinstance(number, bool) for number in _numbers(table[name])):
                wrong = PydanticCustomError("number_type", "must be a number, not true or false")
                lines = [InitErrorDetails(type=wrong, loc=(name,), input=table[name])]
                raise ValidationError.from_exception_data(cls.__name__, lines)
        return table

    @field_validator("*")
    @classmethod
    def _check_magnitude(cls, value: Any, info: ValidationInfo) -> Any:
        """Raise for implausible magnitudes, and for NaN and inf unless the field allows them."""
        field = cls.model_fields[str(info.field_name)]
        extra = field.json_schema_extra
        if not isinstance(extra, dict):
            return value  # not a parameter
        unit, meant = str(extra["unit"]), (repr(field.default), *str(extra["special"]).split())
        for position, number in enumerate(_numbers(value)):
            low, high = SIZES.get(unit_of(unit, position), ANY_SIZE)
            if isinstance(number, int):
                if abs(number) >= 1 << 63:
                    raise ValueError("must be a number of at most 18 digits")
            elif not math.isfinite(number):
                if repr(number) not in meant:
                    raise ValueError("must be a finite number")
            elif number and not low <= abs(number) <= high:
                raise ValueError(_wrong_size(unit_of(unit, position), low, high))
        return value


def unit_of(units: str, position: int) -> str:
    """Return the unit of the number at a position of a parameter, e.g. "rad" at 2 of "m, m, rad"."""
    each = units.split(", ")
    return each[position % len(each)]  # "m, m" is also that of lists of points


def _wrong_size(unit: str, low: float, high: float) -> str:
    if unit == "rad":
        return f"must be 0, or {low:g} to {high:g} in size (rad; 180 deg is 3.1416)"
    return f"must be 0, or {low:g} to {high:g} in size ({unit})"


def _simple_kinds(annotation: Any) -> frozenset[Any]:
    """Return the types of the values in an annotation, e.g. `float` of `tuple[float, float]`."""
    inner = get_args(annotation)
    return frozenset().union(*map(_simple_kinds, inner)) if inner else frozenset((annotation,))


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
    """Declare a parameter: its default, unit ("m", "rad", "1", ...) and meaning.

    `bounds` are pydantic's (`gt`, `ge`, `lt`, `le`, ...). Pass `...` for a parameter that has no
    sensible default. NaN or inf is allowed if it is the default, or named in `special` ("nan inf");
    then the sentence explains it. `noise` marks standard deviations that `imp tune` finds.
    """
    extra: dict[str, JsonValue] = {"unit": unit, "special": special, "noise": noise}
    return Field(default, description=sentence, json_schema_extra=extra, **bounds)
