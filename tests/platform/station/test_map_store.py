"""The maps on the disk: nothing outside the folder, nothing overwritten, and a recycle bin."""

import os
from dataclasses import replace

import pytest
from tests.observers import runs

from impslam.errors import ImpError
from impslam.maps import archive
from impslam.platform.station.map_store import MapStore
from impslam.platform.station.store import StoreError


def make(folder, name, scans=50):
    (folder / name).mkdir(parents=True)
    known = replace(runs.play([]), about={"logs": [{"scans": 1}, {"scans": scans - 1}]})
    known.save(folder / name / "map.imp")
    return folder / name


@pytest.fixture
def folder(tmp_path):
    """A folder with two maps, a damaged one, and other files."""
    folder = tmp_path / "maps"
    for i, name in enumerate(("map-1", "map-2")):
        os.utime(make(folder, name, 50 + i) / "map.imp", (1000.0 + i, 1000.0 + i))
    (folder / "map-2" / "report.html").write_text("a page")
    (folder / "broken").mkdir()
    (folder / "broken" / "map.imp").write_text("no map")
    os.utime(folder / "broken" / "map.imp", (900.0, 900.0))
    (folder / "empty").mkdir()
    (folder / "map.imp").write_text("not in a folder")
    (folder / "link").symlink_to(folder / "map-1")
    return folder


def test_maps_are_listed_newest_first(folder):
    store = MapStore(folder, lambda: "map-1")
    two, one, broken = store.maps()
    assert (one.name, one.scans, one.mapping, one.report, one.damage) == (
        "map-1",
        50,
        True,
        False,
        "",
    )
    assert (two.name, two.scans, two.mapping, two.report) == ("map-2", 51, False, True)
    assert two.size == (folder / "map-2" / "map.imp").stat().st_size
    assert two.modified == 1001.0
    assert broken.name == "broken"
    assert "not a map, or damaged" in broken.damage
    make(folder, "map-3", 7)
    assert store.maps()[0].scans == 7
    assert MapStore(folder / "nowhere").maps() == []


def test_a_map_goes_to_the_bin_and_comes_back(folder):
    store = MapStore(folder)
    before = (folder / "map-2" / "map.imp").read_bytes()
    store.delete("map-2")
    assert [one.name for one in store.maps()] == ["map-1", "broken"]
    (binned,) = store.bin()
    assert binned.original == "map-2"
    assert binned.size > len(before)
    make(folder, "map-2", 1)
    with pytest.raises(StoreError, match="a map of this name exists"):
        store.restore(binned.name)
    store.delete("map-2")
    store.restore(binned.name)
    assert (folder / "map-2" / "map.imp").read_bytes() == before
    store.purge()
    assert store.bin() == []
    assert list((folder / ".bin").iterdir()) == []


def test_the_map_that_is_being_made_is_not_deleted(folder):
    store = MapStore(folder, lambda: "map-1")
    with pytest.raises(StoreError, match="is the map in progress"):
        store.delete("map-1")
    store.delete("map-2")


@pytest.mark.parametrize(
    "name", ["", ".", "..", ".bin", "link", "nothing", "../maps/map-1", "map.imp"]
)
def test_only_maps_of_the_folder_are_accessible(folder, name):
    store = MapStore(folder)
    store.delete("map-2")
    for act in (store.path, store.delete, store.restore):
        with pytest.raises(StoreError, match="no such map"):
            act(name)


def test_only_the_description_of_a_map_is_read(folder):
    assert archive.about(folder / "map-1" / "map.imp") == {"logs": [{"scans": 1}, {"scans": 49}]}
    with pytest.raises(ImpError, match="not a map"):
        archive.about(folder / "broken" / "map.imp")
    with pytest.raises(ImpError, match="no such file"):
        archive.about(folder / "nothing")
