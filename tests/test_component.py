"""Components: registered by name, found by name, and wrong ones explained in one line."""

from importlib.metadata import EntryPoint

import pytest
from tests.registry import own_registry

from impslam import component
from impslam.component import build, components, find, load_plugin, near_miss, parameter, register
from impslam.errors import ConfigError
from impslam.extractors.base import Extractor


@pytest.fixture(autouse=True)
def _own_registry():
    with own_registry():
        yield


def one_line(error):
    text = str(error.value)
    assert "\n" not in text
    return text


class Nothing(Extractor):
    """Finds nothing.

    Not even walls.
    """

    width: float = parameter(0.5, "m", "how wide nothing is", gt=0)

    def extract(self, scan, rng):
        del scan, rng
        return []


class Needy(Nothing):
    """Needs a parameter."""

    sizes: float = parameter(..., "m", "how large")
    place: tuple[float, float] | None = parameter(None, "m", "where")


def test_registered_by_name_in_the_role_of_the_base_class():
    register("nothing")(Nothing)
    assert find("extractor", "nothing") is Nothing
    assert Nothing.name == "nothing"
    assert Nothing.describe() == "Finds nothing."
    assert "nothing" not in components("filter")


def test_the_same_class_may_register_again_but_no_other():
    register("nothing")(Nothing)
    register("nothing")(Nothing)

    with pytest.raises(ConfigError) as error:
        register("split_merge")(Nothing)
    assert "registered twice" in one_line(error)
    assert "impslam.extractors.split_merge" in one_line(error)


def test_a_class_of_one_name_in_another_module_does_not_take_its_place():
    register("nothing")(Nothing)
    other = type("Nothing", (Extractor,), {"__module__": "elsewhere", "extract": Nothing.extract})
    with pytest.raises(ConfigError, match=r"tests\.test_component and elsewhere"):
        register("nothing")(other)


@pytest.mark.parametrize(
    ("role", "word", "hint"),
    [
        ("extractor", "split_merg", "did you mean 'split_merge'?"),
        ("filter", "EKF", "ekf"),
        ("association", "zzz", "known: jcbb, known, mahalanobis, nearest"),
    ],
)
def test_a_wrong_name_is_answered_with_the_near_miss(role, word, hint):
    with pytest.raises(ConfigError) as error:
        find(role, word)
    assert word in one_line(error)
    assert hint in one_line(error)


def test_near_miss_lists_all_where_none_is_near():
    assert near_miss("xyz", ["alpha", "beta"]) == "known: alpha, beta"


@pytest.mark.parametrize(
    ("table", "said"),
    [
        ({}, "lacks 'kind'"),
        ("ekf", "expected a table"),
        ({"kind": "nothing", "widht": 1.0}, "mine.widht is not a parameter; did you mean 'width'?"),
        ({"kind": "needy", "size": 1.0}, "mine.size is not a parameter; did you mean 'sizes'?"),
        (
            {"kind": "needy", "sizes": 1.0, "place": "1,2"},
            "mine.place = '1,2': must be a list of 2 numbers, e.g. [0.1,0.2]",
        ),
        (
            {"kind": "needy", "sizes": 1.0, "place": [1]},
            "mine.place.1 is missing; give 2 numbers (m; where)",
        ),
        ({"knd": "x", "kind": "nothing"}, "mine.knd is not a parameter; did you mean 'kind'?"),
        ({"kind": "nothing", "width": -1.0}, "mine.width"),
        ({"kind": "nothing", "width": "broad"}, "mine.width"),
    ],
)
def test_a_wrong_table_is_explained_in_one_line(table, said):
    register("nothing")(Nothing)
    register("needy")(Needy)
    with pytest.raises(ConfigError) as error:
        build("extractor", table, "mine")
    assert said in one_line(error)


def test_every_parameter_of_every_component_has_unit_and_sentence():
    for role in component.roles():
        for name, cls in components(role).items():
            assert cls.describe(), f"{role} {name} has no docstring"
            for key, field in cls.model_fields.items():
                if key in {"path", "extractors"}:
                    continue
                assert field.description, f"{role} {name}.{key} is not explained"
                assert "unit" in (field.json_schema_extra or {}), f"{role} {name}.{key}: no unit"


def test_installed_plug_ins_are_imported(monkeypatch):
    """An entry point names a module; importing it registers what is in it."""
    entry = EntryPoint("toys", "tests.toys", "impslam.components")
    monkeypatch.setattr(component, "entry_points", lambda group: [entry] if group else [])
    component.load_entry_points()
    assert find("extractor", "toy").describe() == "A toy."


def test_a_broken_plug_in_is_named(monkeypatch):
    entry = EntryPoint("broken", "there_is.no_such_module", "impslam.components")
    monkeypatch.setattr(component, "entry_points", lambda group: [entry] if group else [])
    with pytest.raises(ConfigError) as error:
        component.load_entry_points()
    assert "plug-in broken = there_is.no_such_module: cannot be imported" in one_line(error)


def test_a_plug_in_is_a_file_or_a_module(tmp_path):
    file = tmp_path / "mine.py"
    file.write_text(PLUGIN.format(name="mine"))
    load_plugin(str(file))
    load_plugin(str(file))  # once is enough, twice does no harm
    assert components("extractor")["mine"].describe() == "Mine."
    load_plugin("tests.toys")
    assert "toy" in components("extractor")


def test_two_files_of_one_name_are_two_plug_ins(tmp_path):
    for folder in ("a", "b"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "mine.py").write_text(PLUGIN.format(name=folder))
        load_plugin(str(tmp_path / folder / "mine.py"))
    assert {"a", "b"} <= set(components("extractor"))


@pytest.mark.parametrize(
    ("name", "text", "said"),
    [
        ("gone.py", None, "no such file"),
        ("wrong.py", "1 +", "SyntaxError"),
        ("raises.py", "raise RuntimeError('no')", "RuntimeError: no"),
        ("exits.py", "raise SystemExit(3)", "SystemExit: 3"),
        ("taken.py", "taken", "registered twice"),
    ],
)
def test_a_plug_in_that_does_not_work_is_named_in_one_line(tmp_path, name, text, said):
    file = tmp_path / name
    if text is not None:
        file.write_text(PLUGIN.format(name="split_merge") if text == "taken" else text)
    for _ in range(2):  # a failed import leaves nothing behind
        with pytest.raises(ConfigError) as error:
            load_plugin(str(file))
        assert said in one_line(error)


PLUGIN = '''
from __future__ import annotations

from impslam.component import parameter, register
from impslam.extractors.base import Extractor


@register("{name}")
class Mine(Extractor):
    """Mine."""

    width: float = parameter(1.0, "m", "how wide")

    def extract(self, scan, rng):
        return []
'''


def test_part_of_a_nested_parameter_leaves_the_rest_as_it_was():
    table = {"kind": "encoders", "wheel_radius": 0.03, "track": 0.2}
    whole = build("odometry", table)
    part = build("odometry", {**table, "slip": {"sideways": 0.5}})
    assert part.slip == whole.slip.model_copy(update={"sideways": 0.5})
    with pytest.raises(ConfigError, match="sidewys"):
        build("odometry", {**table, "slip": {"sidewys": 0.5}})
