"""The runs of a sweep: every log with every config, every combination of settings, and every seed."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any, TypeAlias

from impslam import toml
from impslam.config import load, parse_setting, presets, read_table
from impslam.errors import ConfigError, SourceError
from impslam.open_log import open_log
from impslam.provenance import fingerprint
from impslam.simulation.robot import SimulatedRobot
from impslam.simulation.world import load_world, shipped_worlds
from impslam.sources.base import recognise
from impslam.sweeps.rows import Row

Settings: TypeAlias = tuple[tuple[str, str], ...]
"""Keys of a config and their values, as TOML."""
ROBOT = SimulatedRobot(imu=None, truth_rate=1.0)
"""The robot of simulated drives, without what no preset listens to, which saves a second a run."""
SIMULATED = "imp"
"""The preset for worlds, where none is given: that of the robot that drives in them."""


@dataclass(frozen=True, slots=True)
class Log:
    """A log, or a world in which a drive is simulated for each seed; and what it is scored against.

    Attributes
    ----------
    name : as the user gave it
    path : absolute, for workers elsewhere; the name of a shipped world
    content : SHA-256 of its bytes
    is_world : whether a drive is simulated
    truth, relations : files that tell of the true path; None: what the log itself tells
    """

    name: str
    path: str
    content: str
    is_world: bool
    truth: str | None = None
    relations: str | None = None


@dataclass(frozen=True, slots=True)
class Case:
    """One run: a log mapped with a config, settings on top of it, and a seed.

    `config_content` is the SHA-256 of what the config's name stood for; "" for the preset of the log.
    """

    log: Log
    config: str | None
    config_content: str
    settings: Settings
    seed: int

    @property
    def overrides(self) -> list[str]:
        """The settings and the seed as `load` takes them."""
        return [*(f"{key}={value}" for key, value in self.settings), f"seed={self.seed}"]

    def row(self) -> Row:
        """Return what says which run it is; two runs with equal rows have equal results."""
        return {
            "log": self.log.name,
            "config": Path(self.config).name if self.config else "",
            "settings": {key: plain(value) for key, value in self.settings},
            "seed": self.seed,
            "log_sha256": self.log.content,
            "config_sha256": self.config_content,
        }


def cases(
    logs: Sequence[Log],
    configs: Sequence[str | None],
    settings: Mapping[str, Sequence[str]],
    seeds: int,
) -> list[Case]:
    """Return every combination, in the order of logs, configs, settings and seeds.

    Raises
    ------
    ConfigError
        If a config cannot be used with these settings.
    """
    made: list[Case] = []
    for name in configs:
        content, anywhere = _content(name), _anywhere(name)
        for values in product(*settings.values()):
            chosen = tuple(zip(settings, values, strict=True))
            some = [
                Case(log, anywhere, content, chosen, seed) for log in logs for seed in range(seeds)
            ]
            _check(some[0])
            made += some
    order = {log.name: k for k, log in enumerate(logs)}
    return sorted(made, key=lambda case: order[case.log.name])


def _check(case: Case) -> None:
    """Refuse settings that do not exist before anything runs."""
    if case.log.is_world:
        load(case.config or SIMULATED, case.overrides)
    else:
        open_log(case.log.path, case.config, case.overrides)


def _content(config: str | None) -> str:
    if config is None:
        return ""
    table = json.dumps(read_table(config), sort_keys=True, default=str)
    return hashlib.sha256(table.encode()).hexdigest()


def _anywhere(config: str | None) -> str | None:
    """Return a name that stands for the same config in every folder."""
    return config if config is None or config in presets() else str(Path(config).resolve())


def find_log(name: str, truth: str | None = None, relations: str | None = None) -> Log:
    """Return the log, or the world, of a name.

    Raises
    ------
    ConfigError, SourceError
        If there is neither; one line that says what to do.
    """
    path = Path(name)
    if name in shipped_worlds() and not path.exists():
        return Log(name, name, _world_content(name), is_world=True)
    if path.suffix == ".toml":
        return Log(name, str(path.resolve()), _world_content(name), is_world=True)
    if not path.exists():
        worlds = ", ".join(shipped_worlds())
        raise SourceError(f"{name}: no such file or folder, and none of the worlds {worlds}")
    recognise(path)
    for file in (truth, relations):
        if file is not None and not Path(file).is_file():
            raise ConfigError(f"{file}: no such file; check the path")
    files = (None if file is None else str(Path(file).resolve()) for file in (truth, relations))
    return Log(name, str(path.resolve()), fingerprint(path), False, *files)


def _world_content(name: str) -> str:
    return hashlib.sha256(load_world(name).model_dump_json().encode()).hexdigest()


def alternatives(settings: Sequence[str]) -> dict[str, list[str]]:
    """Return the values of each key of "key=value,value": commas within brackets or quotes belong to one.

    A key that stands in several settings has the values of all.

    Raises
    ------
    ConfigError
        If one is not of this form.
    """
    found: dict[str, list[str]] = {}
    for setting in settings:
        parse_setting(setting)
        key, _, text = setting.partition("=")
        found.setdefault(key.strip(), []).extend(part.strip() for part in _split(text))
    return found


def _split(text: str) -> list[str]:
    parts, depth, quote = [""], 0, ""
    for character in text:
        if quote:
            quote = "" if character == quote else quote
        elif character in "\"'":
            quote = character
        depth += (character in "[{") - (character in "]}")
        if character == "," and not depth and not quote:
            parts.append("")
        else:
            parts[-1] += character
    return parts


def plain(value: str) -> Any:
    """Return a setting's value as a number, a truth value or text."""
    try:
        known = toml.parse(f"value = {value}", "")["value"]
    except ConfigError:
        return value
    return known if isinstance(known, bool | int | float | str) else value
