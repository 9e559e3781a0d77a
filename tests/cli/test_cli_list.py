from __future__ import annotations

import tomllib

import pytest
import tomli_w
from pydantic import BaseModel
from tests.registry import own_registry

from impslam.cli.console import show_columns
from impslam.component import components, roles
from impslam.config import load, presets


def test_every_component_and_parameter_is_listed(imp) -> None:
    said = imp("list")
    assert said.code == 0
    words = set(said.out.split())
    for role in roles():
        for kind, component in components(role).items():
            assert {role, kind} <= words
            for name, field in component.model_fields.items():
                inner = isinstance(field.get_default(call_default_factory=True), BaseModel)
                assert name == "path" or inner or name in words
    assert set(presets()) <= words
    assert {"arena", "room"} <= words


@pytest.mark.parametrize("role", ["odometry", "sensors", "preset", "worlds"])
def test_one_role(imp, role) -> None:
    assert imp("list", role).out.splitlines()[0].startswith(role.rstrip("s"))


def test_presets_are_described_in_whole_sentences(imp) -> None:
    text = " ".join(imp("list", "presets").out.split())
    assert "a SICK LMS that measures the brightness of echoes." in text
    assert "among barcodes. thesis-both" in text
    assert "in each step (equation 2.23), also at rest." in text


def test_default_unit_and_sentence(imp) -> None:
    line = next(s for s in imp("list", "odometry").out.splitlines() if " track " in f"{s} ")
    field = components("odometry")["encoders"].model_fields["track"]
    assert " m " in line
    assert str(field.description)[:20] in line


def test_inner_tables_are_dotted(imp) -> None:
    assert "slip.forward" in imp("list", "odometry").out


def test_texts_are_wrapped_beside_the_other_columns(capsys) -> None:
    show_columns([("gate", "m", "word " * 30), ("odds", "", "-x- a-b")], 2)
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "  gate  m  " + " ".join(["word"] * 22)  # 120 columns at most
    assert lines[1] == " " * 11 + " ".join(["word"] * 8)
    assert lines[2:] == ["  odds     -x- a-b"]


def test_unknown_role(imp) -> None:
    said = imp("list", "filtre")
    assert said.code == 2
    assert "did you mean 'filter'?" in said.err


@pytest.mark.parametrize("preset", presets())
def test_config_round_trip(imp, tmp_path, preset) -> None:
    said = imp("config", preset, "--set", "seed=7")
    assert said.code == 0, said.err
    assert tomllib.loads(said.out)["seed"] == 7
    file = tmp_path / "config.toml"
    file.write_text(said.out)
    assert imp("config", file).out == said.out
    printed = tomli_w.dumps(tomllib.loads(said.out))  # as text: nan is not equal to nan
    assert tomli_w.dumps(load(file).resolved()) == printed


def test_config_prints_units(imp) -> None:
    lines = imp("config", "imp").out.splitlines()
    assert "start = [0.0, 0.0, 0.0]  # m, m, rad" in lines  # of the config itself
    assert "mount = [0.15, 0.0, 0.0]  # m, m, rad" in lines  # of a component
    assert "min_length = 0.4  # m" in lines  # of a component in a component
    assert "turn_per_distance = 0.01  # rad/sqrt(m)" in lines  # of a table of parameters
    assert "resolution = 0.05  # m" in lines
    assert "seconds = 0.5  # s" in lines
    assert "iterations = 4" in lines  # a count


def test_parts_of_plugins_are_listed(imp, tmp_path) -> None:
    (tmp_path / "mine.toml").write_text('base = "default"\nplugins = ["listed.py"]\n', "utf-8")
    code = (
        "from impslam.component import parameter, register\n"
        "from impslam.extractors.base import Extractor\n\n\n"
        '@register("listed_plugin")\n'
        "class Listed(Extractor):\n"
        '    """Finds nothing."""\n\n'
        '    width: float = parameter(0.25, "m", "width of nothing")\n\n'
        "    def extract(self, scan, rng):\n"
        "        return []\n"
    )
    (tmp_path / "listed.py").write_text(code, "utf-8")
    with own_registry():
        said = imp("list", "extractor", "-c", str(tmp_path / "mine.toml"))
    assert said.code == 0, said.err
    assert "listed_plugin  Finds nothing." in said.out
    assert "width  0.25  m  width of nothing" in said.out
