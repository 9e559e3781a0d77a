"""What is tuned: a config on some logs, with others kept apart; and the config that comes of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import tomli_w

from impslam.config import Config, load, merge, parse_setting, presets
from impslam.errors import ConfigError
from impslam.open_log import open_log
from impslam.sources.base import recognise
from impslam.sweeps.cases import SIMULATED, Case, Log, Settings, cases
from impslam.sweeps.measures import run_case
from impslam.sweeps.pool import Lost, Pool
from impslam.sweeps.rows import Row
from impslam.sweeps.searches import parse_space, value_of
from impslam.sweeps.space import Space
from impslam.sweeps.tuning import best, finished, score_of

BEFORE, AFTER = "before", "after"


@dataclass(frozen=True)
class Task:
    """A config to be tuned.

    Attributes
    ----------
    logs, holdout : those that are searched on, and those that the result is scored on alone
    config : preset or file; None: the preset that fits the logs
    settings : on top of the config, "key=value", and not searched
    seeds : of each run
    """

    logs: Sequence[Log]
    holdout: Sequence[Log]
    config: str | None
    settings: Sequence[str]
    seeds: int

    @cached_property
    def base(self) -> str:
        """The preset or file that the tuned config begins with.

        Raises
        ------
        ConfigError
            If the logs do not share one.
        """
        if self.config is not None:
            return self.config
        found = {_preset(log) for log in self.logs}
        if len(found) > 1 or not found <= set(presets()):
            raise ConfigError(
                "the logs ask for different configs, or for one of their own; name one with -c"
            )
        return found.pop()

    @cached_property
    def _resolved(self) -> Config:
        log = self.logs[0]
        if log.is_world:
            return load(self.base, self.settings)
        return open_log(log.path, self.config, self.settings)[0]

    def space(self, searches: Sequence[str]) -> Space:
        """Return what is searched; each end of each range must be a config that can be used."""
        space = parse_space(searches, self._resolved)
        for end in ("low", "high"):
            self.cases(tuple((key, str(getattr(part, end))) for key, part in space.items()))
        return space

    def values(self, space: Space) -> Settings:
        """Return what the config has for the parameters that are searched."""
        table = self._resolved.resolved()
        return tuple((key, str(value_of(table, key))) for key in space)

    def cases(self, found: Settings) -> list[Case]:
        """Return the runs that some settings are judged by."""
        return self._cases(found, self.logs)

    def _cases(self, found: Settings, logs: Sequence[Log]) -> list[Case]:
        fixed = [setting.partition("=") for setting in self.settings]
        pairs = {key.strip(): [value] for key, _, value in fixed} | {k: [v] for k, v in found}
        return cases(logs, [self.config], pairs, self.seeds)

    def evidence(self, found: Settings, pool: Pool) -> list[Row]:
        """Return the rows of all logs before and after, those that were kept apart included."""
        logs = [*self.logs, *self.holdout]
        work = [(BEFORE, case) for case in self._cases((), logs)]
        work += [(AFTER, case) for case in self._cases(found, logs)]
        rows: list[Row] = [{} for _ in work]
        for index, result in pool.each(run_case, [case for _, case in work]):
            when, case = work[index]
            row = {**case.row(), "error": result.why} if isinstance(result, Lost) else result
            rows[index] = {**row, "config": when, "settings": {}}
        return rows

    def tuned(self, found: Settings, rows: Sequence[Row], score: str, study: Any) -> str:
        """Return the tuned config as TOML, with what speaks for it as comments."""
        lines = [
            f"# Found by imp tune in {len(finished(study))} trials; score: {score}, the less the better."
        ]
        lines.append(f"# Best trial: {best(study).number}, {best(study).value:.6g} over its logs.")
        for log in [*self.logs, *self.holdout]:
            kept = ", kept apart" if log in self.holdout else ""
            before, after = (_score(rows, log, when, score) for when in (BEFORE, AFTER))
            lines.append(f"# {Path(log.name).name}{kept}: {before} before, {after} after")
        table: dict[str, Any] = {}
        for setting in [*self.settings, *(f"{key}={value}" for key, value in found)]:
            table = merge(table, parse_setting(setting))
        base = self.base if self.base in presets() else str(Path(self.base).resolve())
        return "\n".join(lines) + "\n" + tomli_w.dumps({"base": base, **table})


def _score(rows: Sequence[Row], log: Log, when: str, score: str) -> str:
    some = [row for row in rows if row["log"] == log.name and row["config"] == when]
    failed = next((row["error"] for row in some if row["error"]), "")
    return f"failed ({failed})" if failed else f"{score_of(some, score):.4g}"


def _preset(log: Log) -> str:
    if log.is_world:
        return SIMULATED
    path = Path(log.path)
    with recognise(path)(path=path) as source:
        return source.preset
