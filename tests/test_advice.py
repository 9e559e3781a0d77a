"""What the program's messages recommend can be done: every key they name exists."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from pydantic import BaseModel

import impslam
from impslam.component import components
from impslam.config import Config

SOURCE = Path(impslam.__file__).parent
FILES = {"csv", "tum", "toml", "png", "yaml", "local", "example"}
KEY = re.compile(r"(?<![\w/.])([a-z_]+(?:\.[a-z_]+)+)(?![\w/(])")
ROLES = {"sensors": "sensor", "landmarks": "landmark"}


def texts(node: ast.AST) -> Iterator[str]:
    """Yield the strings of a file; what is filled in at run time is one name."""
    for part in ast.walk(node):
        if isinstance(part, ast.JoinedStr):
            pieces = [p.value if isinstance(p, ast.Constant) else "a_name" for p in part.values]
            yield "".join(map(str, pieces))
        elif isinstance(part, ast.Constant) and isinstance(part.value, str):
            yield part.value


def named() -> list[str]:
    """The keys of a config that any string of the program names."""
    found: set[str] = set()
    for path in SOURCE.rglob("*.py"):
        if "simulation" not in path.parts:  # its keys are those of a world
            for text in texts(ast.parse(path.read_text())):
                found |= {key for key in KEY.findall(text) if is_of_a_config(key)}
    return sorted(found)


def is_of_a_config(key: str) -> bool:
    table, *_, last = key.split(".")
    if (SOURCE / key.replace(".", "/")).with_suffix(".py").exists():  # a module
        return False
    return table in Config.model_fields and last not in FILES and table != "robot"


def fields(role: str) -> set[str]:
    return {"kind", *(name for cls in components(role).values() for name in cls.model_fields)}


def exists(key: str) -> bool:
    table, *rest = key.split(".")
    if table in {"sensors", "landmarks"}:
        rest = rest[1:]
    if rest[:1] == ["extractors"]:
        table, rest = "extractor", rest[2:]
    if not rest or "a_name" in rest:
        return True
    annotation = Config.model_fields[table].annotation if table in Config.model_fields else None
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return rest[0] in annotation.model_fields
    return rest[0] in fields(ROLES.get(table, table))


@pytest.fixture(scope="module")
def keys() -> list[str]:
    return named()


def test_it_finds_the_keys(keys: list[str]) -> None:
    assert {"sensors.a_name.latency", "odometry.max_speed", "source.left_joint"} <= set(keys)
    assert not exists("sensors.lidar.time_offset")


def test_every_key_that_is_recommended_exists(keys: list[str]) -> None:
    assert [key for key in keys if not exists(key)] == []
