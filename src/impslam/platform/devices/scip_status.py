"""The status codes of SCIP 2.0 in words (Hokuyo C-42-03320B, sections 8 and 9)."""

from __future__ import annotations

from typing import Final

OK: Final = "00"
DATA: Final = "99"
RESUMED: Final = "98"
UPDATE_MODE: Final = "0I"

_GENERAL = {
    OK: "all is well",
    "0A": "the sensor could not compose its answer",
    "0B": "its buffer is full, or it is doing this already",
    "0C": "a parameter is missing",
    "0D": "it does not know this command",
    "0E": "it does not know this command",
    "0F": "a parameter is missing",
    "0G": "the text in the request is longer than 16 characters",
    "0H": "the text in the request has characters that it does not take",
    UPDATE_MODE: "it is in firmware update mode; if RS does not end that, use Hokuyo's update tool",
}
_STEPS = {
    "01": "the first step is not a number",
    "02": "the last step is not a number",
    "03": "the cluster count is not a number",
    "04": "the last step is out of range",
    "05": "the last step lies before the first",
}
_STREAM = _STEPS | {
    "06": "the scan interval is not a number",
    "07": "the number of scans is not a number",
    RESUMED: "it resumes: the laser works normally",
    DATA: "a scan",
}
_POLL = _STEPS | {"10": "the laser is off"}
_WORDS: dict[str, dict[str, str]] = {
    "MD": _STREAM,
    "MS": _STREAM,
    "GD": _POLL,
    "GS": _POLL,
    "BM": {"01": "a malfunction keeps the laser off", "02": "the laser is on already"},
    "TM": {
        "01": "there is no such control code",
        "02": "the adjust mode is on already",
        "03": "the adjust mode is off already",
        "04": "the time is given in adjust mode only",
    },
    "SS": {
        "01": "the bit rate is not a number",
        "02": "there is no such bit rate",
        "03": "it has this bit rate already",
        "04": "this model's bit rate cannot be set",
    },
    "CR": {
        "01": "there is no such motor speed",
        "02": "the motor speed is out of range",
        "03": "the motor has this speed already",
        "04": "this model's motor speed cannot be set",
    },
    "HS": {
        "01": "there is no such sensitivity",
        "02": "it has this sensitivity already",
        "03": "this model's sensitivity cannot be set",
    },
    "DB": {
        "01": "there is no such simulation",
        "02": "this simulation runs already",
        "03": "no simulation runs",
        "04": "this model simulates no malfunction",
        "05": "there is a real malfunction",
    },
    "SC": {"0": "it speaks SCIP 2.0 now"},
}


def is_verifying(status: str) -> bool:
    """Return whether the sensor has paused to verify an error (21 to 49)."""
    return status.isdigit() and 21 <= int(status) <= 49


def is_malfunction(command: str, status: str) -> bool:
    """Return whether the hardware has failed (50 to 97, or 01 of BM); RS may clear it."""
    if command == "BM":
        return status == "01"
    return status.isdigit() and 50 <= int(status) <= 97


def words(command: str, status: str) -> str:
    """Return the meaning of a status in the answer to a command (its first two letters)."""
    meanings = _WORDS.get(command[:2], {}) | _GENERAL
    if status in meanings:
        return meanings[status]
    if is_verifying(status):
        return f"it has stopped to verify an error (status {status})"
    if is_malfunction(command[:2], status):
        return f"hardware trouble, such as of laser or motor (status {status})"
    return f"status {status}, which the protocol does not explain"
