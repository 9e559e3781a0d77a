"""A tuning task: a config, logs to search on, and logs held out for validation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from impslam.config import Config, load, presets
from impslam.errors import ConfigError
from impslam.open_log import open_log
from impslam.sources.base import recognise
from impslam.sweeps.cases import SIMULATED, Case, Log, Settings, cases
from impslam.sweeps.measures import run_case
from impslam.sweeps.pool import Pool, ProcessDied
from impslam.sweeps.rows import Row
from impslam.sweeps.searches import parse_space, value_of
from impslam.sweeps.space import Space

BEFORE, AFTER = "before", "after"


@dataclass(frozen=True)
class Task:
    """A config to be tuned.

    Attributes
    ----------
    logs, holdout : logs to search on, and logs only used to score the result
    config : preset or file; None for the preset that fits the logs
    settings : fixed settings on top of the config, "key=value"
    seeds : number of seeds of each run
    """

    logs: Sequence[Log]
    holdout: Sequence[Log]
    config: str | None
    settings: Sequence[str]
    seeds: int

    @cached_property
    def base(self) -> str:
        """The preset or file that the tuned config is based on.

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
                "the logs need different configs, or one of their own; name one with -c"
            )
        return found.pop()

    @cached_property
    def _resolved(self) -> Config:
        log = self.logs[0]
        if log.is_world:
            return load(self.base, self.settings)
        return open_log(log.path, self.config, self.settings)[0]

    def space(self, searches: Sequence[str]) -> Space:
        """Return the search space; both ends of each range must give valid configs."""
        space = parse_space(searches, self._resolved)
        for end in ("low", "high"):
            self.cases(tuple((key, str(getattr(part, end))) for key, part in space.items()))
        return space

    def evidence(self, score: str) -> dict[str, Any]:
        """Return what the scores of a search depend on besides the searched parameters, for JSON."""
        rows = [case.row() for case in self.cases(())]
        names = ("log", "config")  # their contents count
        runs = [{key: row[key] for key in row if key not in names} for row in rows]
        return {"score": score, "runs": runs}

    def values(self, space: Space) -> dict[str, Any]:
        """Return the configured values of the searched parameters."""
        table = self._resolved.resolved()
        return {key: value_of(table, key) for key in space}

    def cases(self, found: Settings) -> list[Case]:
        """Return the runs that evaluate some settings."""
        return self._cases(found, self.logs)

    def _cases(self, found: Settings, logs: Sequence[Log]) -> list[Case]:
        fixed = [setting.partition("=") for setting in self.settings]
        pairs = {key.strip(): [value] for key, _, value in fixed} | {k: [v] for k, v in found}
        return cases(logs, [self.config], pairs, self.seeds)

    def compare(self, found: Settings, pool: Pool) -> list[Row]:
        """Return the rows of all logs before and after tuning, including held-out logs."""
        logs = [*self.logs, *self.holdout]
        work = [(BEFORE, case) for case in self._cases((), logs)]
        work += [(AFTER, case) for case in self._cases(found, logs)]
        rows: list[Row] = [{} for _ in work]
        for index, result in pool.each(run_case, [case for _, case in work]):
            when, case = work[index]
            row = {**case.row(), "error": result.why} if isinstance(result, ProcessDied) else result
            rows[index] = {**row, "config": when, "settings": {}}
        return rows


def _preset(log: Log) -> str:
    if log.is_world:
        return SIMULATED
    path = Path(log.path)
    with recognise(path)(path=path) as source:
        return source.preset
