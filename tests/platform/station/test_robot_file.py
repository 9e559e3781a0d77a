"""Robot files define devices, and invalid ones give clear errors."""

import pytest

from impslam.errors import ConfigError
from impslam.platform.station.robot_file import load_robot

GOOD = """
name = "imp-7"
max_speed = 0.3
[devices.autopilot]
kind = "autopilot"
port = "/dev/imp-autopilot"
[devices.lidar]
kind = "urg"
port = "socket://10.0.0.2:10940"
"""


@pytest.fixture
def write(tmp_path):
    def _write(text):
        path = tmp_path / "robot.toml"
        path.write_text(text)
        return path

    return _write


def test_devices_are_named_by_their_tables(write):
    robot = load_robot(write(GOOD))
    devices = robot.make_devices()
    assert {name: device.name for name, device in devices.items()} == {
        "autopilot": "autopilot",
        "lidar": "urg",
    }
    assert devices["lidar"].title == "lidar"
    assert (robot.name, robot.max_speed, robot.preset) == ("imp-7", 0.3, "imp")


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("name = ", "not valid TOML"),
        ("", "names no device"),
        (GOOD.replace("max_speed", "max_sped"), "did you mean 'max_speed'"),
        (GOOD.replace("0.3", "-1.0"), "greater than 0"),
        (GOOD.replace('"urg"', '"ugr"'), "did you mean 'urg'"),
        (GOOD.replace("port =", "prot ="), "did you mean 'port'"),
    ],
)
def test_errors_are_one_line(write, text, complaint):
    with pytest.raises(ConfigError) as caught:
        load_robot(write(text))
    assert complaint in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("preset", "found"),
    [("mine.toml", "{folder}/mine.toml"), ("imp", "imp"), ("none.toml", "none.toml")],
)
def test_a_config_beside_the_robot_file_is_its_preset(write, tmp_path, preset, found):
    """It is found from any folder; a service runs in that of the logs."""
    for name in ("mine.toml", "imp"):  # the name of a preset has priority
        (tmp_path / name).write_text('base = "imp"\n')
    robot = load_robot(write(f'preset = "{preset}"\n{GOOD}'))
    assert robot.preset == found.format(folder=tmp_path)


def test_a_virtual_robot_needs_no_devices(write):
    """It has its own, whatever the file says of its name, limits and folder."""
    path = write('name = "imp-7"\nmax_speed = 0.3')
    assert load_robot(path, virtual=True).max_speed == 0.3
    with pytest.raises(ConfigError, match="names no device"):
        load_robot(path)


def test_a_missing_file_is_an_error(tmp_path):
    with pytest.raises(ConfigError, match=r"robot\.toml: no such file; give -c a robot file"):
        load_robot(tmp_path / "robot.toml")
