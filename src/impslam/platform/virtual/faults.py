"""Faults on command: what can be asked for, and what noise and delays do to bytes on a line."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from typing import Annotated, Any, Literal, TypeAlias

import numpy as np
from pydantic import ConfigDict, Field, TypeAdapter, ValidationError

from impslam.errors import ConfigError
from impslam.parameters import Parameters, parameter

Kind: TypeAlias = Literal["flip", "drop", "insert", "any"]
KINDS = ("flip", "drop", "insert")
HELD = 1 << 20  # bytes that a stalled line holds back; more than it carries in any fault's time


class _Fault(Parameters):
    """A fault as it is asked for: a typo in it is an error."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class Noise(_Fault):
    """Bytes spoilt on a line, in both directions."""

    fault: Literal["noise"] = "noise"
    device: Literal["autopilot", "lidar", "gps"]
    rate: float = parameter(..., "1/byte", "share of the bytes that are spoilt", gt=0.0, le=1.0)
    seconds: float = parameter(..., "s", "how long", gt=0.0)
    kind: Kind = parameter(
        "any", "", "one bit flipped, a byte dropped, one put in, or any of these"
    )


class Delay(_Fault):
    """Bytes held back, in both directions, and delivered at once when it ends."""

    fault: Literal["delay"] = "delay"
    device: Literal["autopilot", "lidar", "gps", "camera"]
    seconds: float = parameter(..., "s", "how long", gt=0.0)


class Unplug(_Fault):
    """A port that is gone and comes back under the same name."""

    fault: Literal["unplug"] = "unplug"
    device: Literal["autopilot", "lidar", "gps", "camera"]
    seconds: float = parameter(..., "s", "how long", gt=0.0)


class Reboot(_Fault):
    """A device whose supply fails for a moment."""

    fault: Literal["reboot"] = "reboot"
    device: Literal["autopilot", "lidar", "gps"]


class Malfunction(_Fault):
    """A lidar that measures no longer and says so, until it is reset."""

    fault: Literal["malfunction"] = "malfunction"
    device: Literal["lidar"] = "lidar"
    status: int = parameter(50, "", "what it says: SCIP's 50 to 97", ge=50, le=97)


class Stall(_Fault):
    """Motors that are blocked."""

    fault: Literal["stall"] = "stall"
    side: Literal["left", "right", "both"]
    seconds: float = parameter(..., "s", "how long", gt=0.0)


Fault: TypeAlias = Annotated[
    Noise | Delay | Unplug | Reboot | Malfunction | Stall, Field(discriminator="fault")
]
_FAULT: TypeAdapter[Fault] = TypeAdapter(Fault)


def parse_fault(table: Mapping[str, Any]) -> Fault:
    """Make a fault from what was asked for, such as {"fault": "reboot", "device": "lidar"}.

    Raises
    ------
    ConfigError
        If there is no such fault; one line.
    """
    try:
        return _FAULT.validate_python(dict(table))
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"])
        raise ConfigError(f"fault {where}: {first['msg']}") from None


class Disturbance:
    """What happens to the bytes on one direction of a line.

    Parameters
    ----------
    rng : of the noise
    counts : takes what was done to the bytes, under `KINDS` and "overrun"
    """

    def __init__(self, rng: np.random.Generator, counts: Counter[str]) -> None:
        self._rng, self._counts = rng, counts
        self._rate, self._kind, self._noisy_until = 0.0, "any", 0.0
        self._held_until, self._held = 0.0, bytearray()

    def noise(self, rate: float, kind: Kind, until: float) -> None:
        """Spoil a share of the bytes until a time in s."""
        self._rate, self._kind, self._noisy_until = rate, kind, until

    def hold(self, until: float) -> None:
        """Hold all bytes back until a time in s."""
        self._held_until = until

    def forget(self) -> None:
        """Lose the bytes that are being held back."""
        self._held.clear()

    def passed(self, data: bytes, time: float) -> bytes:
        """Return what comes out of the line at a time when `data` goes in."""
        if data and time < self._noisy_until:
            data = self._spoil(data)
        if time < self._held_until:
            self._counts["overrun"] += max(0, len(self._held) + len(data) - HELD)
            self._held += data[: HELD - len(self._held)]
            return b""
        if self._held:
            data = bytes(self._held) + data
            self._held.clear()
        return data

    def _spoil(self, data: bytes) -> bytes:
        places = np.flatnonzero(self._rng.random(len(data)) < self._rate)
        spoilt = bytearray(data)
        for place in places[::-1].tolist():  # from the end, so that places before stay valid
            kind = self._kind if self._kind != "any" else KINDS[self._rng.integers(len(KINDS))]
            self._counts[kind] += 1
            if kind == "flip":
                spoilt[place] ^= 1 << int(self._rng.integers(8))
            elif kind == "drop":
                del spoilt[place]
            else:
                spoilt.insert(place, int(self._rng.integers(256)))
        return bytes(spoilt)
