"""Every log is recognised by one reader alone, and read the same way twice."""

import gzip

import pytest
from tests.sources.bags import ROS1, some
from tests.sources.logs import WRITERS

from impslam.component import components
from impslam.config import load
from impslam.errors import ImpError
from impslam.sources.base import recognise
from impslam.types import Detections, LaserScan

SOURCES = components("source")
LOGS = WRITERS | {"ros1": lambda path: some(path, ROS1), "ros2": some}


@pytest.fixture(params=sorted(LOGS), ids=str)
def log(request, tmp_path):
    return LOGS[request.param](tmp_path / "log")


def test_exactly_one_reader_recognises_a_log(log):
    assert sum(cls.recognises(log) for cls in SOURCES.values()) == 1


def test_reading_twice_gives_the_same(log):
    source = recognise(log)(path=log)
    with source:
        one = [(type(m).__name__, m.stamp) for m in source]
    with recognise(log)(path=log) as again:
        two = [(type(m).__name__, m.stamp) for m in again]
    assert one == two
    seen = {LaserScan.__name__, Detections.__name__}
    assert any(name in seen for name, _ in one)


def test_the_preset_of_a_log_exists(log):
    with recognise(log)(path=log) as source:
        load(source.preset)


@pytest.mark.parametrize("name", sorted(SOURCES))
@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"\n\n",
        b"hello\n",
        b"\x00" * 100,
        b"\xff\xfe\x00",
        b"{}",
        b"1 2 3\n",
        gzip.compress(b"", mtime=0),  # a name of the test that does not depend on the time
    ],
)
def test_nothing_else_is_recognised(name, content, tmp_path):
    file = tmp_path / "thing.mcap"  # the name says nothing
    file.write_bytes(content)
    assert not SOURCES[name].recognises(file)
    with pytest.raises(ImpError) as error:
        recognise(file)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("name", sorted(SOURCES))
def test_an_empty_folder_is_not_recognised(name, tmp_path):
    assert not SOURCES[name].recognises(tmp_path)
