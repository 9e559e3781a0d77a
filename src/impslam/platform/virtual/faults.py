"""The faults of a virtual robot."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal, TypeAlias

from pydantic import ConfigDict, Field, TypeAdapter, ValidationError

from impslam.errors import ConfigError
from impslam.parameters import Parameters, parameter
from impslam.platform.virtual.disturbance import Kind


class _Fault(Parameters):
    """The base class of faults, which forbids unknown keys."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class LineNoise(_Fault):
    """Corrupted bytes on a line, in both directions."""

    fault: Literal["noise"] = "noise"
    device: Literal["autopilot", "lidar", "gps"]
    rate: float = parameter(..., "1/byte", "share of corrupted bytes", gt=0.0, le=1.0)
    seconds: float = parameter(..., "s", "how long", gt=0.0)
    kind: Kind = parameter(
        "any", "", "one bit flipped, a byte dropped, a byte inserted, or any of these"
    )


class Delay(_Fault):
    """Bytes held back, in both directions, and delivered at once when it ends."""

    fault: Literal["delay"] = "delay"
    device: Literal["autopilot", "lidar", "gps", "camera"]
    seconds: float = parameter(..., "s", "how long", gt=0.0)


class Unplug(_Fault):
    """A port that disappears and comes back under the same name."""

    fault: Literal["unplug"] = "unplug"
    device: Literal["autopilot", "lidar", "gps", "camera"]
    seconds: float = parameter(..., "s", "how long", gt=0.0)


class Reboot(_Fault):
    """A short power failure of a device."""

    fault: Literal["reboot"] = "reboot"
    device: Literal["autopilot", "lidar", "gps"]


class Malfunction(_Fault):
    """A lidar that stops measuring and reports it, until it is reset."""

    fault: Literal["malfunction"] = "malfunction"
    device: Literal["lidar"] = "lidar"
    status: int = parameter(50, "", "status of SCIP, 50 to 97", ge=50, le=97)


class Stall(_Fault):
    """Blocked motors."""

    fault: Literal["stall"] = "stall"
    side: Literal["left", "right", "both"]
    seconds: float = parameter(..., "s", "how long", gt=0.0)


class Carry(_Fault):
    """A robot that is lifted and put down elsewhere, with the same heading; its wheels do not turn."""

    fault: Literal["carry"] = "carry"
    place: tuple[float, float] | None = parameter(
        None, "m", "position in the world; by default where the robot started"
    )


Fault: TypeAlias = Annotated[
    LineNoise | Delay | Unplug | Reboot | Malfunction | Stall | Carry, Field(discriminator="fault")
]
_FAULT: TypeAdapter[Fault] = TypeAdapter(Fault)


def parse_fault(table: Mapping[str, Any]) -> Fault:
    """Return the fault of a request such as {"fault": "reboot", "device": "lidar"}.

    Raises
    ------
    ConfigError
        If there is no such fault, in one line.
    """
    try:
        return _FAULT.validate_python(dict(table))
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"])
        raise ConfigError(f"fault {where}: {first['msg']}") from None
