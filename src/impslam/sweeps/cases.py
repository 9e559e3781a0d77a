"""The runs of a sweep: every log with every config, every combination of settings, and every seed."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any, TypeAlias

from impslam import toml
from impslam.config import load, presets, read_table
from impslam.errors import ConfigError, SourceError
from impslam.evaluation.landmark_files import landmarks_path
from impslam.open_log import open_log
from impslam.provenance import fingerprint
from impslam.settings import parse_setting
from impslam.simulation.robot import SimulatedRobot
from impslam.simulation.world import load_world, shipped_worlds
from impslam.sources.base import recognise
from impslam.sweeps.rows import Row

Settings: TypeAlias = tuple[tuple[str, str], ...]
"""Keys of a config and their values, as TOML."""
ROBOT = SimulatedRobot(imu=None, truth_rate=1.0)
"""The robot of simulated drives: encoders and lidar, as in the thesis."""
SIMULATED = "imp"
"""The default preset for worlds: that of the simulated robot."""


@dataclass(frozen=True, slots=True)
class Log:
    """A log, or a world in which a drive is simulated for each seed, with the reference for scoring.

    Attributes
    ----------
    name : as given by the user
    path : absolute, for workers on other machines; or the name of a shipped world
    content : SHA-256 of its bytes
    is_world : whether a drive is simulated
    truth, relations : reference files for the path; None for the truth in the log itself
    references : SHA-256 of these files and of the landmarks beside the log; "" if there are none
    """

    name: str
    path: str
    content: str
    is_world: bool
    truth: str | None = None
    relations: str | None = None
    references: str = ""


@dataclass(frozen=True, slots=True)
class Case:
    """One run: a log mapped with a config, settings on top of it, and a seed.

    `config_name` is as given by the user, `config` is absolute, and `config_content` is the SHA-256 of its
    content; the preset of the log is "", None and "".
    """

    log: Log
    config_name: str
    config: str | None
    config_content: str
    settings: Settings
    seed: int

    @property
    def overrides(self) -> list[str]:
        """The settings and the seed in the form expected by `load`."""
        return [*(f"{key}={value}" for key, value in self.settings), f"seed={self.seed}"]

    def row(self) -> Row:
        """Return the identity of the run; runs with equal rows have equal results."""
        return {
            "log": self.log.name,
            "config": self.config_name,
            "settings": {key: plain(value) for key, value in self.settings},
            "seed": self.seed,
            "log_sha256": self.log.content,
            "config_sha256": self.config_content,
            "references_sha256": self.log.references,
        }


def cases(
    logs: Sequence[Log],
    configs: Sequence[str | None],
    settings: Mapping[str, Sequence[str]],
    seeds: int,
) -> list[Case]:
    """Return all combinations, in the order of logs, configs, settings and seeds.

    Raises
    ------
    ConfigError
        If a config is invalid with these settings.
    """
    if "seed" in settings:
        raise ConfigError("seed: each run has its own one; give the number of seeds with --seeds")
    made: list[Case] = []
    for config in configs:
        name = "" if config is None else str(Path(config))
        content, absolute = _content(config), _absolute(config)
        for values in product(*settings.values()):
            chosen = tuple(zip(settings, values, strict=True))
            some = [
                Case(log, name, absolute, content, chosen, seed)
                for log in logs
                for seed in range(seeds)
            ]
            _check(some[0])
            made += some
    order = {log.name: k for k, log in enumerate(logs)}
    return sorted(made, key=lambda case: order[case.log.name])


def _check(case: Case) -> None:
    """Reject invalid settings before anything runs."""
    if case.log.is_world:
        load(case.config or SIMULATED, case.overrides)
    else:
        open_log(case.log.path, case.config, case.overrides)


def _content(config: str | None) -> str:
    if config is None:
        return ""
    table = json.dumps(read_table(config), sort_keys=True, default=str)
    return hashlib.sha256(table.encode()).hexdigest()


def _absolute(config: str | None) -> str | None:
    """Return the name of a preset, or the absolute path of a config file."""
    return config if config is None or config in presets() else str(Path(config).resolve())


def find_log(name: str, truth: str | None = None, relations: str | None = None) -> Log:
    """Return the log or the world with a name.

    Raises
    ------
    ConfigError, SourceError
        If there is neither, with one line that says what to do.
    """
    path = Path(name)
    is_shipped = name in shipped_worlds() and not path.exists()
    if is_shipped or path.suffix == ".toml":
        if given := truth or relations:
            raise ConfigError(f"{name}: drives in a world have their own truth; leave out {given}")
        place = name if is_shipped else str(path.resolve())
        return Log(name, place, _world_content(name), is_world=True)
    if not path.exists():
        worlds = ", ".join(shipped_worlds())
        raise SourceError(f"{name}: no such file or folder, and none of the worlds {worlds}")
    recognise(path)
    for file in (truth, relations):
        if file is not None and not Path(file).is_file():
            raise ConfigError(f"{file}: no such file; check the path")
    files = [None if file is None else Path(file).resolve() for file in (truth, relations)]
    references = _references([*files, landmarks_path(path)])
    true, related = (None if file is None else str(file) for file in files)
    return Log(name, str(path.resolve()), fingerprint(path), False, true, related, references)


def _references(files: Iterable[Path | None]) -> str:
    """Return the SHA-256 of the files with the truth of a log; "" if none of them exists."""
    known = [fingerprint(file) if file and file.is_file() else "" for file in files]
    return hashlib.sha256(" ".join(known).encode()).hexdigest() if any(known) else ""


def _world_content(name: str) -> str:
    return hashlib.sha256(load_world(name).model_dump_json().encode()).hexdigest()


def alternatives(settings: Sequence[str]) -> dict[str, list[str]]:
    """Return the values of each key of "key=value,value"; commas in brackets or quotes do not separate.

    A key that occurs in several settings has the values of all of them.

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
    """Return a setting's value as a number, a boolean or a string."""
    try:
        known = toml.parse(f"value = {value}", "")["value"]
    except ConfigError:
        return value
    return known if isinstance(known, bool | int | float | str) else value
