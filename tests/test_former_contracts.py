"""Plug-ins and configs written for an earlier impslam: one line says what has changed."""

import pytest
from tests.registry import own_registry

from impslam.cli import main
from impslam.component import build, load_plugin, roles
from impslam.config import load
from impslam.errors import ConfigError


@pytest.fixture(autouse=True)
def _own_registry():
    with own_registry():
        yield


def plug_in(role, base, body):
    return f"""
from __future__ import annotations
from typing import ClassVar
from impslam.component import register
from impslam.{role}.base import {base}
from impslam.types import Message, LaserScan, WheelAngles

@register("former")
class Former({base}):
    \"\"\"As it was.\"\"\"

{body}
"""


FORMER = [
    (
        *("odometry", "odometry", "Odometry"),
        "    consumes: ClassVar[type[Message]] = WheelAngles\n    def update(self, message): ...",
        "fault, motions, usable",
    ),
    (
        *("sensor", "sensors", "Sensor"),
        "    consumes: ClassVar[type[Message]] = LaserScan\n    def observe(self, message, twist): ...",
        "sweeps",
    ),
    (
        *("extractor", "extractors", "Extractor"),
        "    def find(self, scan): ...",
        "extract",
    ),
    (
        *("landmark", "landmarks", "LandmarkModel"),
        "    def predict(self, pose, m): ...\n    def initialise(self, pose, z): ...",
        "invert, observe, outline",
    ),
    (
        *("lifecycle", "lifecycle", "Lifecycle"),
        "    def start(self, models): ...\n    def promote(self, seen, stamp, lost): ...",
        "move, review",
    ),
    (
        *("association", "association", "Association"),
        "    def associate(self, belief, seen): ...",
        "assign",
    ),
    (
        *("source", "sources", "Source"),
        "    def __iter__(self): ...",
        "__enter__, __exit__, recognises, streams",
    ),
    (
        *("filter", "filters", "Filter"),
        "    def update(self, seen): ...",
        "correct, covariance, extend, hypothesise, joint",
    ),
    (
        *("estimator", "estimators", "Estimator"),
        "    def step(self, motion, scan): ...",
        "add, landmarks, start, state_size",
    ),
    (
        *("tracker", "tracking", "Tracker"),
        "    def match(self, scan, guess): ...",
        "steps",
    ),
    (
        *("device", "platform.devices", "Device"),
        "    def read(self): ...",
        "_serve",
    ),
]


def test_every_role_is_tested():
    assert {role for role, *_ in FORMER} == set(roles())


@pytest.mark.parametrize(("role", "package", "base", "body", "lacks"), FORMER)
def test_what_a_component_lacks_is_named_with_its_contract(
    tmp_path, role, package, base, body, lacks
):
    file = tmp_path / "former.py"
    file.write_text(plug_in(package, base, body))
    load_plugin(str(file))
    with pytest.raises(ConfigError) as error:
        build(role, {"kind": "former"})
    said = str(error.value)
    assert said.startswith(f"{role} 'former' (impslam_plugin_former")
    assert lacks in said
    assert f"the contract is {base} in impslam.{package}.base" in said
    assert "\n" not in said


def test_what_a_component_consumes_is_part_of_the_contract(tmp_path):
    methods = "".join(f"    def {name}(self, readings): ...\n" for name in NEW)
    (tmp_path / "former.py").write_text(plug_in("odometry", "Odometry", methods))
    load_plugin(str(tmp_path / "former.py"))
    with pytest.raises(ConfigError, match="lacks consumes: update it for this version"):
        build("odometry", {"kind": "former"})


NEW = ("usable", "motions", "fault")


def test_a_command_ends_in_one_line(tmp_path, capsys):
    (tmp_path / "former.py").write_text(plug_in("odometry", "Odometry", FORMER[0][3]))
    (tmp_path / "mine.toml").write_text(
        'base = "imp"\nplugins = ["former.py"]\n[odometry]\nkind = "former"\n'
    )
    assert main(["config", str(tmp_path / "mine.toml")]) == 2
    said = capsys.readouterr().err
    assert said.startswith(f"imp: error: {tmp_path / 'mine.toml'}: odometry 'former'")
    assert said.count("\n") == 1


def test_a_package_that_is_gone_is_told(tmp_path):
    (tmp_path / "former.py").write_text("from impslam.matching.base import Matcher\n")
    with pytest.raises(
        ConfigError, match=r"written for another version of impslam.*CHANGELOG"
    ) as e:
        load_plugin(str(tmp_path / "former.py"))
    assert "\n" not in str(e.value)


@pytest.mark.parametrize(("role", "instead"), [("tracker", "odometry"), ("estimator", "landmarks")])
def test_a_run_has_a_tracker_and_an_estimator(role, instead):
    """Taken out, their place was filled by the default without a word."""
    with pytest.raises(ConfigError, match=f'{role}.kind = "none".* use kind = "{instead}"'):
        load("default", [f"{role}.kind=none"])
    assert getattr(load("default", [f"{role}.kind={instead}"]), role) == {"kind": instead}
