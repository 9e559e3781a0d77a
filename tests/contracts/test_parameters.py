"""Every number that a user may set is refused in one line where nothing is of that size."""

import math
from collections.abc import Iterator
from typing import Any

import pytest
from pydantic import BaseModel, ValidationError
from pydantic.fields import FieldInfo

from impslam.component import build, components, roles
from impslam.config import Grid, load
from impslam.errors import ConfigError
from impslam.platform.station.robot_file import RobotFile
from impslam.simulation.robot import Lidar, WheelEncoders
from impslam.tracking.base import KeyframeGate

NEEDED = {"port": "/dev/null", "path": "a.log", "label": "x"}
NOT_FINITE = [math.nan, math.inf, -math.inf]
EXTREME = [1e300, -1e300, 1e-300, -1e-300]
MODELS: list[type[BaseModel]] = [Grid, KeyframeGate, RobotFile, Lidar, WheelEncoders]


def numbers(cls: type[BaseModel], *above: str) -> Iterator[tuple[tuple[str, ...], FieldInfo]]:
    """The fields of a model that hold numbers, those of its tables, too."""
    for name, field in cls.model_fields.items():
        kind = field.annotation
        if isinstance(kind, type) and issubclass(kind, BaseModel):
            yield from numbers(kind, *above, name)
        elif "float" in str(kind):
            yield (*above, name), field


def parts() -> list[Any]:
    """Every number of every component."""
    return [
        pytest.param(role, name, path, field, id=f"{role}.{name}.{'.'.join(path)}")
        for role in roles()
        for name, cls in components(role).items()
        if cls.__module__.startswith("impslam.")
        for path, field in numbers(cls)
    ]


def value_of(field: FieldInfo, value: float) -> Any:
    """What is given for a field: a tuple where it is one."""
    size = str(field.annotation).count("float") if "tuple" in str(field.annotation) else 0
    return (value, *[0.0] * (size - 1)) if size else value


def table_of(path: tuple[str, ...], value: Any) -> dict[str, Any]:
    for part in reversed(path):
        value = {part: value}
    return dict(value)


def with_meaning(field: FieldInfo) -> tuple[str, ...]:
    extra = field.json_schema_extra
    assert isinstance(extra, dict)
    return (repr(field.default), *str(extra["special"]).split())


def test_it_finds_the_numbers() -> None:
    assert len(parts()) > 100


@pytest.mark.parametrize(("role", "name", "path", "field"), parts())
def test_no_component_takes_what_nothing_measures(role, name, path, field) -> None:
    cls = components(role)[name]
    needed = {n: NEEDED.get(n, 1.0) for n, f in cls.model_fields.items() if f.is_required()}
    for value in NOT_FINITE + EXTREME:
        if repr(value) in with_meaning(field):
            assert repr(value).strip("-") in field.description
            continue
        with pytest.raises(ConfigError) as error:
            build(role, {"kind": name, **needed, **table_of(path, value_of(field, value))})
        said = str(error.value)
        assert ".".join(path) in said
        assert "\n" not in said
        assert len(said) < 200


@pytest.mark.parametrize("cls", MODELS)
def test_no_table_takes_what_nothing_measures(cls) -> None:
    for path, field in numbers(cls):
        for value in NOT_FINITE + EXTREME:
            if repr(value) not in with_meaning(field):
                with pytest.raises(ValidationError) as error:
                    cls(**table_of(path, value_of(field, value)))
                assert error.value.errors()[0]["loc"][: len(path)] == path


@pytest.mark.parametrize("value", ["nan", "inf", "1e300", "-1e300", "1e-300"])
@pytest.mark.parametrize(
    "key",
    [
        "odometry.wheel_radius",
        "odometry.track",
        "sensors.lidar.sigma",
        "sensors.lidar.period",
        "odometry.wheel_noise",
        "start",
        "grid.resolution",
    ],
)
def test_a_setting_is_refused_by_its_key(key: str, value: str) -> None:
    given = f"[{value}, 0.0, 0.0]" if key == "start" else value
    with pytest.raises(ConfigError, match=rf"^{key}[^\n]*: must be [^\n]*$"):
        load("imp", [f"{key}={given}"])


def test_integers_fit_in_a_word() -> None:
    for value in (1 << 63, -(1 << 63) - 1, 10**400):
        with pytest.raises(ConfigError, match=r"^seed = [^\n]*$"):
            load("imp", [f"seed={value}"])
    assert load("imp", [f"seed={(1 << 63) - 1}"]).seed == (1 << 63) - 1


@pytest.mark.parametrize("key", ["resolution=1000.0", "rho_bin=1e-6", "angle_bin=1e-6"])
def test_an_accumulator_beyond_memory_is_refused(key: str) -> None:
    walls = "sensors.lidar.extractors.walls"
    with pytest.raises(ConfigError, match=r"make .* cells; make them wider$"):
        load("imp", [f"{walls}.kind=hough", f"{walls}.{key}"])


@pytest.mark.parametrize("key", ["reach=1e-9", "sigma=0", "kind=nope"])
def test_the_tracker_is_checked_with_the_rest(key: str) -> None:
    with pytest.raises(ConfigError, match="tracker"):
        load("default", [f"tracker.{key}"])
