"""Pictures and numbers that commands write, each completely or not at all."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from impslam.errors import ConfigError
from impslam.evaluation.json_values import json_values
from impslam.paths import write_bytes


def check_png(path: Path) -> None:
    """Raise `ConfigError` unless a path has the suffix of a PNG."""
    if path.suffix.lower() != ".png":
        raise ConfigError(f"{path}: pictures are written as PNG; give -o NAME.png")


def json_text(facts: Mapping[str, Any]) -> str:
    """Return numbers as JSON; unknown values are null."""
    return json.dumps(json_values(facts), indent=2, ensure_ascii=False, allow_nan=False)


def write_json(path: Path, facts: Mapping[str, Any]) -> None:
    """Write numbers as JSON; see `json_text` and `write_bytes`."""
    write_bytes(path, f"{json_text(facts)}\n".encode())
