"""The tuned config as TOML, with its scores."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import tomli_w

from impslam.config import merge, presets
from impslam.errors import ConfigError
from impslam.paths import portable
from impslam.settings import parse_setting
from impslam.sweeps.cases import Log, Settings
from impslam.sweeps.rows import Row
from impslam.sweeps.task import AFTER, BEFORE, Task
from impslam.sweeps.tuning import best, finished, score_of, unknown
from impslam.sweeps.verdict import log_names


def tuned_config(
    task: Task, found: Settings, rows: Sequence[Row], score: str, study: Any, folder: Path
) -> str:
    """Return the tuned config for a file in `folder` as TOML, with its scores as comments."""
    lines = [
        f"# Found by imp tune in {len(finished(study))} trials; score: {score}, lower is better."
    ]
    lines.append(f"# Best trial: {best(study).number}, {best(study).value:.6g} over its logs.")
    logs = [*task.logs, *task.holdout]
    for name, log in zip(log_names(log.name for log in logs), logs, strict=True):
        held_out = ", held out" if log in task.holdout else ""
        lines.append(f"# {name}{held_out}: {_scores(rows, log, score)}")
    table: dict[str, Any] = {}
    for setting in [*task.settings, *(f"{key}={value}" for key, value in found)]:
        table = merge(table, parse_setting(setting))
    base = task.base if task.base in presets() else portable(Path(task.base), folder)
    return "\n".join(lines) + "\n" + tomli_w.dumps({"base": base, **table})


def _scores(rows: Sequence[Row], log: Log, score: str) -> str:
    """Return the scores of a log before and after; that of a held-out log may be unknown."""
    try:
        before, after = (_score(rows, log, when, score) for when in (BEFORE, AFTER))
    except ConfigError:
        return unknown(score)
    return f"{before} before, {after} after"


def _score(rows: Sequence[Row], log: Log, when: str, score: str) -> str:
    some = [row for row in rows if row["log"] == log.name and row["config"] == when]
    failed = next((row["error"] for row in some if row["error"]), "")
    return f"failed ({failed})" if failed else f"{score_of(some, score):.4g}"
