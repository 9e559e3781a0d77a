"""Configs: merging, taking parts out, round trips, and mistakes explained in one line."""

from pathlib import Path

import pytest
import tomli_w
from hypothesis import given
from hypothesis import strategies as st
from tests.registry import own_registry

from impslam.component import components
from impslam.config import carried, load, load_plugins, merge, presets, read_table
from impslam.errors import ConfigError
from impslam.filters.riekf import RightInvariantEkf
from impslam.settings import parse_setting


def refuse(*settings, base="default"):
    with pytest.raises(ConfigError) as error:
        load(base, settings)
    assert "\n" not in str(error.value)
    return str(error.value)


# --------------------------------------------------------------------------- merging

KEYS = st.sampled_from(["a", "b", "c"])
TABLES = st.recursive(
    st.dictionaries(KEYS, st.integers()), lambda inner: st.dictionaries(KEYS, inner), max_leaves=8
)

VALUES = st.dictionaries(st.sampled_from("xyz"), st.integers())
SHAPED = st.recursive(
    VALUES,
    lambda inner: st.builds(
        lambda values, tables: {**values, **tables},
        VALUES,
        st.dictionaries(st.sampled_from("abc"), inner),
    ),
    max_leaves=8,
)


@given(TABLES)
def test_merging_with_nothing_changes_nothing(table):
    assert merge(table, {}) == table
    assert merge({}, table) == table
    assert merge(table, table) == table


@given(SHAPED, SHAPED, SHAPED)
def test_merging_is_associative(a, b, c):
    """As long as no key is a table here and a value there, which no config is."""
    assert merge(merge(a, b), c) == merge(a, merge(b, c))


@given(TABLES, TABLES)
def test_merging_leaves_its_arguments_alone(a, b):
    before = repr((a, b))
    merge(a, b)
    assert repr((a, b)) == before


def test_the_same_kind_keeps_the_other_parameters():
    below = {"filter": {"kind": "ekf", "iterations": 3}}
    assert merge(below, {"filter": {"kind": "ekf", "tolerance": 0.1}}) == {
        "filter": {"kind": "ekf", "iterations": 3, "tolerance": 0.1}
    }
    assert merge(below, {"filter": {"iterations": 5}})["filter"]["kind"] == "ekf"


def test_another_kind_drops_the_parameters_of_the_one_before():
    below = {"filter": {"kind": "ekf", "iterations": 3}}
    assert merge(below, {"filter": {"kind": "riekf"}}) == {"filter": {"kind": "riekf"}}


def test_lists_are_replaced():
    assert merge({"start": [1, 2, 3]}, {"start": [4]}) == {"start": [4]}


# --------------------------------------------------------------------------- settings


@pytest.mark.parametrize(
    ("setting", "table"),
    [
        ("seed=3", {"seed": 3}),
        ("filter.kind=ekf", {"filter": {"kind": "ekf"}}),
        ("a.b.c = 1.5", {"a": {"b": {"c": 1.5}}}),
        ("start=[1.0, 2.0, 3.0]", {"start": [1.0, 2.0, 3.0]}),
        ("deskew=false", {"deskew": False}),
        ("topics.scan=/front/scan", {"topics": {"scan": "/front/scan"}}),
        ("name=a=b", {"name": "a=b"}),
    ],
)
def test_settings(setting, table):
    assert parse_setting(setting) == table


@pytest.mark.parametrize("setting", ["seed", "=3", " = 3"])
def test_a_setting_without_key_or_value_is_refused(setting):
    with pytest.raises(ConfigError, match="expected key=value"):
        parse_setting(setting)


def test_an_empty_table_is_refused():
    with pytest.raises(
        ConfigError, match="changes nothing; to switch a component off, set its kind to none"
    ):
        parse_setting("sensors.lidar.extractors={}")


def test_later_settings_win():
    assert load(settings=["seed=1", "seed=2"]).seed == 2


# --------------------------------------------------------------------------- loading


def test_a_part_is_swapped_by_one_line():
    config = load("imp", ["filter.kind=riekf", "association.kind=jcbb"])
    estimator = config.make_estimator()
    assert isinstance(estimator._filter, RightInvariantEkf)
    assert estimator._association.name == "jcbb"


def test_none_takes_a_part_out():
    config = load("imp", ["sensors.lidar.extractors.corners.kind=none"])
    assert set(config.sensors["lidar"]["extractors"]) == {"walls", "cylinders"}
    assert "corners" not in config.resolved()["sensors"]["lidar"]["extractors"]
    assert "lidar" not in load("imp", ["sensors.lidar.kind=none"]).sensors


def test_a_part_that_every_run_has_cannot_be_taken_out():
    """The message says what to set instead."""
    assert refuse("odometry.kind=none").endswith("set odometry.kind=lidar_only")
    assert load("default", ["odometry.kind=lidar_only"]).odometry == {"kind": "lidar_only"}
    assert refuse("filter.kind=none").endswith("estimators that do not need it ignore it")


def test_missing_parameters_are_named_together_with_units():
    said = refuse("odometry.kind=encoders")
    assert said.startswith("odometry.wheel_radius (m, radius of the wheels")
    assert " and odometry.track (m, " in said
    assert said.endswith(" are missing; add them")


def test_a_part_that_was_taken_out_can_be_put_back():
    config = load("thesis-lines", ["sensors.lidar.extractors.cylinders.kind=circle"])
    assert config.sensors["lidar"]["extractors"]["cylinders"] == {"kind": "circle"}


def test_files_stand_on_presets_and_on_one_another(tmp_path: Path):
    first, second = tmp_path / "first.toml", tmp_path / "second.toml"
    first.write_text('base = "imp"\nseed = 5\n[filter]\niterations = 2\n')
    second.write_text(f"base = '{first.as_posix()}'\nseed = 6\n")
    config = load(second)
    assert config.seed == 6
    assert config.filter == {"kind": "riekf", "iterations": 2}
    assert config.odometry == load("imp").odometry


@pytest.mark.parametrize("preset", presets())
def test_every_preset_round_trips(preset, tmp_path: Path):
    """What a run writes down is the whole of its parameters, and loads to the same ones."""
    file = tmp_path / "config.toml"
    file.write_text(tomli_w.dumps(load(preset).resolved()))
    assert tomli_w.dumps(load(file).resolved()) == file.read_text()  # as text: nan is not nan


@pytest.mark.parametrize("preset", presets())
def test_every_preset_names_its_robot_and_begins_with_a_sentence(preset):
    assert load(preset).robot
    text = (Path(__file__).parents[1] / f"src/impslam/presets/{preset}.toml").read_text()
    assert text.startswith("# ")


def test_all_presets_of_the_project_are_there():
    wanted = {"imp", "thesis-points", "thesis-lines", "thesis-both", "default"}
    wanted |= {"thesis-printed-noise", "thesis-constant-noise", "thesis-dropping"}
    assert wanted | {"turtlebot3-waffle", "mines-rover", "lego-robot4"} <= set(presets())


@pytest.mark.parametrize("role", ["filter", "association", "lifecycle"])
def test_every_component_resolves_and_loads_again(role, tmp_path: Path):
    for name in components(role):
        resolved = load("imp", [f"{role}.kind={name}"]).resolved()
        file = tmp_path / "config.toml"
        file.write_text(tomli_w.dumps(resolved))
        assert tomli_w.dumps(load(file).resolved()) == tomli_w.dumps(resolved)  # some are nan


def test_another_estimator_for_a_resolved_config_has_its_own_keyframes(tmp_path: Path):
    file = tmp_path / "config.toml"
    file.write_text(tomli_w.dumps(load("default").resolved()))
    room = load(file, ["estimator.kind=landmarks"])
    assert room.make_gate() == load("default", ["estimator.kind=landmarks"]).make_gate()
    assert room.make_gate() != load(file).make_gate()
    (tmp_path / "room.toml").write_text(f'base = "{file}"\n[estimator]\nkind = "landmarks"\n')
    assert load(tmp_path / "room.toml").make_gate() == room.make_gate()


def test_keyframes_that_a_config_chooses_hold_for_every_estimator(tmp_path: Path):
    file = tmp_path / "config.toml"
    file.write_text(tomli_w.dumps(load("default", ["keyframes.distance=0.3"]).resolved()))
    assert load(file, ["estimator.kind=landmarks"]).make_gate() == load(file).make_gate()


# --------------------------------------------------------------------------- plug-ins


def test_a_config_brings_its_plug_ins(tmp_path: Path):
    part = tmp_path / "part.py"
    part.write_text((Path(__file__).parent / "toys.py").read_text().replace('"toy"', '"part"'))
    file = tmp_path / "mine.toml"
    file.write_text('plugins = ["part.py"]\nbase = "imp"\n')  # from the config's own folder
    kind = "sensors.lidar.extractors.toys.kind=part"
    with own_registry():
        config = load(file, [kind])
        assert config.plugins == (str(part),)
        assert config.resolved()["sensors"]["lidar"]["extractors"]["toys"] == {"kind": "part"}
    with own_registry():
        load_plugins(file)
        load("imp", [kind])
    assert "no extractor is called 'part'" in refuse(kind, base="imp")


def test_plug_ins_of_a_setting_are_found_from_here(tmp_path: Path, monkeypatch):
    (tmp_path / "part.py").write_text("")
    monkeypatch.chdir(tmp_path)
    with own_registry():
        assert load(settings=['plugins=["part.py"]']).plugins == (str(tmp_path / "part.py"),)


@pytest.mark.parametrize("value", ["3", '"part.py"', "[1]"])
def test_plug_ins_are_a_list(value):
    assert "expected a list" in refuse(f"plugins={value}")


# --------------------------------------------------------------------------- mistakes


@pytest.mark.parametrize(
    ("setting", "said"),
    [
        ("sede=3", "sede is not a parameter; did you mean 'seed'?"),
        ("seed=-1", "seed"),
        ("seed=many", "seed"),
        ("start=[1.0]", "start"),
        ("start=[nan, 0.0, 0.0]", "start"),
        ("start=[0, 0, 180]", "(rad; 180 deg is 3.1416)"),
        ("start=1,2,3", "start = '1,2,3': must be a list of 3 numbers, e.g. [0.1,0.2,0.3]"),
        ("sensors.lidar.mount=[10, 5, 30]", "(rad; 180 deg is 3.1416)"),
        ("sensors.lidar.mount=[10, 5]", "give 3 numbers (m, m, rad; pose [x, y, yaw]"),
        ("sensors.lidar.sigma=200", "must be at most 100 m"),
        ("lidar.range_max=5", "did you mean 'sensors.lidar.range_max'?"),
        ("lidar=off", "did you mean 'sensors.lidar'?"),
        ("filter.kind=efk", "did you mean 'ekf'?"),
        ("filter.iteration=2", "did you mean 'iterations'?"),
        ("filter=ekf", "filter"),
        ("grid.resolution=0", "grid.resolution"),
        ("grid.resolutoin=1", "did you mean 'resolution'?"),
        ("landmarks.wal.kind=wall", "did you mean 'wall'?"),
        ("sensors.lidar.extractors.walls.kind=slit_merge", "did you mean 'split_merge'?"),
        ("sensors.lidar.extractors.walls=true", "sensors"),
        ("odometry.noise.sidewards=1", "did you mean 'sideways'?"),
        ("sensors.lidar.sigma=true", "sensors.lidar.sigma = True: must be a number, not true or"),
        ("sensors.lidar.mount=[true, 0, 0]", "must be a number, not true or false"),
        ("seed=true", "seed = True: must be a number"),
        ("start=[0, false, 0]", "must be a number, not true or false"),
    ],
)
def test_mistakes_are_told_in_one_line(setting, said):
    assert said in refuse(setting)


def test_a_tracker_that_follows_odometry_is_not_run_without_odometry():
    said = refuse("odometry.kind=lidar_only", base="imp")
    assert "the tracker 'odometry' needs odometry" in said
    assert "--set tracker.kind=scan_to_map" in said
    load("imp", ["odometry.kind=lidar_only", "tracker.kind=scan_to_map"])


def test_missing_and_broken_files(tmp_path: Path):
    assert "did you mean 'default'?" in refuse(base="defualt")
    broken = tmp_path / "broken.toml"
    broken.write_text("a = [")
    assert "not valid TOML" in refuse(base=broken)
    broken.write_bytes(b"\xff\xfe")
    assert "cannot be read" in refuse(base=broken)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (
            "[sensors.lidar]\nsigmma = 1",
            "sensors.lidar.sigmma is not a parameter; did you mean 'sigma'?",
        ),
        ("[sensors.lidar]\nsigma = true", "sensors.lidar.sigma = True: must be a number"),
        ('[filter]\nkind = "ekff"', "filter.kind: no filter is called 'ekff'"),
        ("[keyframes]\nangle = -1", "keyframes.angle = -1"),
        ('plugins = ["gone.py"]', "plugins: "),
    ],
)
def test_a_mistake_in_a_file_is_told_with_the_file(tmp_path: Path, text: str, said: str):
    file, above = tmp_path / "mine.toml", tmp_path / "above.toml"
    file.write_text(f'base = "imp"\n{text}\n')
    above.write_text(f"base = '{file.as_posix()}'\nseed = 1\n")
    assert refuse(base=file).startswith(f"{file}: {said}")
    assert refuse(base=above).startswith(f"{file}: {said}")  # the file that has it


def test_a_mistake_in_a_setting_is_not_the_files(tmp_path: Path):
    file = tmp_path / "mine.toml"
    file.write_text('base = "imp"\n')
    assert refuse("seed=-1", base=file).startswith("seed = -1: ")


def test_a_base_that_is_missing_is_told_with_the_file_that_names_it(tmp_path: Path):
    file = tmp_path / "mine.toml"
    file.write_text('base = "gone.toml"\n')
    where = f"neither a preset nor the file {str(tmp_path / 'gone.toml')!r}"
    assert refuse(base=file).startswith(f"{file}: base = 'gone.toml': {where}")


def test_a_base_is_relative_to_the_file_that_names_it(tmp_path: Path, monkeypatch):
    """Not to the working directory, which has files of the same names here."""
    folder, elsewhere = tmp_path / "robots", tmp_path / "elsewhere"
    for place, track in ((folder, 0.3), (elsewhere, 0.4)):
        (place / "parts").mkdir(parents=True)
        (place / "wheels.toml").write_text(f'base = "imp"\nodometry.track = {track}\n')
        (place / "parts" / "laser.toml").write_text('base = "../wheels.toml"\nseed = 1\n')
    (folder / "mine.toml").write_text('base = "parts/laser.toml"\n')
    monkeypatch.chdir(elsewhere)
    config = load("../robots/mine.toml")
    assert (config.odometry["track"], config.seed) == (0.3, 1)


@pytest.mark.parametrize("base", ["loop.toml", "../a/loop.toml", "{folder}/loop.toml"])
def test_a_file_that_is_its_own_base(tmp_path: Path, base: str):
    file = tmp_path / "a" / "loop.toml"
    file.parent.mkdir()
    file.write_text(f"base = '{base.format(folder=file.parent.as_posix())}'")
    with pytest.raises(ConfigError, match="its own base"):
        read_table(file)


# --------------------------------------------------------------------------- from logs


def asks(preset: str) -> str:
    """The line with which a log is refused that asks for this preset."""
    with pytest.raises(ConfigError) as error:
        carried(preset, Path("a.mcap"))
    said = str(error.value)
    assert said.startswith("a.mcap: ")
    assert said.endswith("name a preset or a config with -c")
    assert "\n" not in said
    assert len(said) < 300
    return said


def test_a_log_may_carry_a_preset_or_a_config():
    assert load(carried("imp", Path("a.mcap"))) == load("imp")
    text = tomli_w.dumps(load("imp", ["odometry.track=0.41"]).resolved())
    assert tomli_w.dumps(load(carried(text, Path("a.mcap"))).resolved()) == text


def test_a_log_may_not_name_a_file(tmp_path: Path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("evil.py").write_text("import pathlib\npathlib.Path('ran').touch()")
    Path("evil.toml").write_text('plugins = ["evil.py"]\nbase = "imp"\n')
    Path("default.toml").write_text('plugins = ["evil.py"]\nbase = "imp"\n')
    for name in ["evil.toml", str(tmp_path / "evil.toml"), "./evil.toml", "default.toml", "imq"]:
        assert "which is not a shipped one" in asks(name)
    assert not Path("ran").exists()


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('plugins = ["evil.py"]\n', "plugins = ['evil.py'], which a log may not choose"),
        ('plugins = "antigravity"\n', "plugins = 'antigravity', which a log may not choose"),
        ('base = "evil.toml"\n', "base = 'evil.toml', which a log may not choose"),
        ('base = "imp"\n', "base = 'imp', which a log may not choose"),
        ("a\n=", "its own config: not valid TOML"),
        ("seed = 1\n", "odometry, sensors, association, lifecycle and filter are missing"),
        ("a = " + "[" * 1500 + "\n", "nested too deeply"),
        ("seed = " + "9" * 5000 + "\n", "too many digits"),
        ("imp" * 10_000, "asks for the preset 'impimp"),
    ],
)
def test_a_log_may_not_choose_what_is_run_or_read(text, said, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("evil.py").write_text("import pathlib\npathlib.Path('ran').touch()")
    Path("evil.toml").write_text('plugins = ["evil.py"]\nbase = "imp"\n')
    assert said in asks(text)
    assert not Path("ran").exists()


def test_a_text_is_no_config_but_from_a_log(tmp_path):
    assert "neither a file nor a preset" in refuse(base=tomli_w.dumps(load("imp").resolved()))


# --------------------------------------------------------------------------- beyond reading


@pytest.mark.parametrize(
    "text",
    ["a = " + "[" * 1500, "a = " + "{a=" * 1500, "seed = " + "9" * 5000, "[" + "a." * 1500 + "a]"],
)
def test_toml_beyond_reading_is_told_in_one_line(text, tmp_path):
    file = tmp_path / "deep.toml"
    file.write_text(text)
    assert "deep.toml" in refuse(base=file)
    key, equals, value = text.partition(" = ")
    if equals:
        assert f"--set {key}" in refuse(f"{key}={value}")


@pytest.mark.parametrize("value", ["0x" + "f" * 5000, "1" + "0" * 400, "-1" + "0" * 400])
@pytest.mark.parametrize("key", ["odometry.track", "sensors.lidar.sigma", "keyframes.distance"])
def test_a_number_beyond_floats_is_told_in_one_line(key, value):
    assert len(refuse(f"{key}={value}")) < 300


@pytest.mark.parametrize("place", ["a\\u0000.py", "a\\u0000", "a\\u0000/b.py"])
def test_plug_ins_with_a_nul_in_their_name(place, tmp_path):
    assert "plugins" in refuse(f'plugins=["{place}"]')
    file = tmp_path / "nul.toml"
    file.write_text(f'plugins = ["{place}"]')
    assert "plugins" in refuse(base=file)


@pytest.mark.parametrize("base", ["a\\u0000.toml", "a\\u0000/b.toml"])
def test_a_base_with_a_nul_in_its_name(base, tmp_path):
    file = tmp_path / "nul.toml"
    file.write_text(f'base = "{base}"')
    assert "neither a preset nor the file" in refuse(base=file)
