"""The map on the disk: saved every minute, at its end, and on request, atomically."""

import errno
import threading
import time

import pytest
from tests.platform.station.test_mapper import drain, hand, live
from tests.recorded import perfect
from tests.waiting import wait_until

from impslam.config import load
from impslam.errors import ImpError
from impslam.map import Map
from impslam.platform.station import map_keeper as module
from impslam.platform.station.map_keeper import MapKeeper
from impslam.platform.station.map_store import MapStore
from impslam.platform.station.mapper_status import MapperStatus
from impslam.simulation.world import load_world


def full_disk(*_):
    raise OSError(errno.ENOSPC, "No space left on device")


class Toy:
    """A mapper that counts."""

    def __init__(self):
        self.steps, self.saved, self.full, self.error, self.pause = 0, [], [], "", 0.0
        self.state = "running"

    kind = ImpError

    def start(self, continued=None):
        self.steps = 0

    def stop(self):
        self.state = "off"

    def status(self):
        return MapperStatus(self.state, self.steps, 0, 0, 0.0, 0.0, "")

    def save_map(self, folder):
        time.sleep(self.pause)
        if self.error:
            (folder / "trajectory.tum").write_text("0 0 0")
            raise self.kind(self.error)
        (folder / "map.imp").write_text("a map")
        self.saved.append((folder.name, self.steps))
        return folder / "map.imp"

    def save(self, folder):
        self.save_map(folder)
        self.full.append(folder.name)
        return folder


@pytest.fixture
def toy(tmp_path, monkeypatch):
    monkeypatch.setattr(module, "SAVE_INTERVAL", 0.02)
    monkeypatch.setattr(module.time, "strftime", lambda form: "map-1")
    return Toy()


@pytest.fixture
def notices():
    return []


@pytest.fixture
def keeper(toy, tmp_path, notices):
    keeper = MapKeeper(toy, tmp_path / "maps", lambda level, text: notices.append((level, text)))
    yield keeper
    keeper.stop()


def test_only_a_grown_map_is_saved_automatically(keeper, toy, tmp_path):
    keeper.start()
    time.sleep(0.1)
    assert toy.saved == []
    assert not (tmp_path / "maps").exists()
    toy.steps = 5
    wait_until(lambda: toy.saved)
    time.sleep(0.1)
    assert toy.saved == [("map-1", 5)]
    toy.steps = 9
    wait_until(lambda: len(toy.saved) > 1)
    assert toy.saved[-1] == ("map-1", 9)
    assert keeper.name == "map-1"


def test_stopping_saves_the_map(keeper, toy, monkeypatch):
    monkeypatch.setattr(module, "SAVE_INTERVAL", 60.0)
    keeper.start()
    toy.steps = 3
    keeper.stop()
    assert toy.saved == [("map-1", 3)]


def test_a_new_map_saves_the_present_one_and_has_a_folder_of_its_own(keeper, toy):
    for steps in (3, 4):
        toy.steps = steps
        keeper.begin()
        assert keeper.name == ""
    assert toy.saved == [("map-1", 3), ("map-1-2", 4)]


def test_an_ended_map_is_saved_and_is_not_being_made(keeper, toy):
    toy.steps = 3
    keeper.end()
    assert (toy.state, toy.saved, keeper.name) == ("off", [("map-1", 3)], "")
    keeper.save()
    assert toy.saved == [("map-1", 3), ("map-1", 3)]
    with pytest.raises(ImpError, match="mapping has ended"):
        keeper.hint(0.0, 0.0)


def test_a_deleted_map_is_saved_to_another_folder_but_only_on_request(
    keeper, toy, tmp_path, monkeypatch
):
    monkeypatch.undo()  # the bin needs the time
    store = MapStore(tmp_path / "maps", lambda: keeper.name, keeper.forget)
    toy.steps = 3
    assert keeper.folder is None
    folder = keeper.save()
    assert keeper.folder == folder
    keeper.end()
    store.delete(folder.name)
    assert keeper.folder is None
    keeper._try_to_save()
    assert not folder.exists()
    with monkeypatch.context() as patch:
        patch.setattr(module.time, "strftime", lambda form: "map-2")
        assert keeper.save().name == "map-2"
    store.restore(store.bin()[0].name)
    store.delete(folder.name)
    assert keeper.folder == folder.with_name("map-2")
    keeper.begin()
    assert keeper.folder is None


def test_manual_saving_writes_all_files_to_the_same_folder(keeper, toy, tmp_path):
    toy.steps = 3
    threads = [threading.Thread(target=keeper.save) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(5.0)
    assert toy.full == ["map-1"] * 4
    assert [path.name for path in (tmp_path / "maps").iterdir()] == ["map-1"]


def test_a_disk_error_is_notified_once_and_leaves_no_partial_map(keeper, toy, notices, tmp_path):
    toy.error, toy.steps = "the disk is full", 3
    keeper.start()
    wait_until(lambda: notices)
    time.sleep(0.1)
    assert notices == [("error", "the map is not saved: the disk is full")]
    with keeper._saving:  # not while it tries once more
        assert list((tmp_path / "maps").iterdir()) == []
    with pytest.raises(ImpError, match="full"):
        keeper.save()
    with pytest.raises(ImpError, match="full"):  # the present map is kept
        keeper.begin()
    assert toy.steps == 3
    toy.error = ""
    wait_until(lambda: toy.saved)
    assert toy.saved == [("map-1", 3)]


def test_a_map_that_takes_long_to_save_is_saved_less_often(keeper, toy):
    toy.pause = 0.05
    keeper.start()
    begin = time.monotonic()
    while time.monotonic() - begin < 0.6:
        toy.steps += 1
        time.sleep(0.01)
    assert len(toy.saved) == 1  # the next one is due after a second


def test_partial_files_of_a_killed_program_are_removed(keeper, tmp_path):
    folder = tmp_path / "maps" / "map-0"
    folder.mkdir(parents=True)
    (folder / "map.imp").write_text("a map")
    (folder / ".map.imp.123.part").write_text("half a map")
    (folder / ".abc.part").mkdir()
    (folder / ".abc.part" / "report.html").write_text("half a report")
    keeper.start()
    assert [path.name for path in folder.iterdir()] == ["map.imp"]


def test_a_live_map_can_be_loaded_from_its_file_which_a_full_disk_does_not_change(
    tmp_path, notices, monkeypatch
):
    mapper = live(load("imp"))
    keeper = MapKeeper(mapper, tmp_path, lambda *event: notices.append(event))
    keeper.begin()
    hand(mapper, perfect(load_world("room"))[:600])
    drain(mapper)
    mapper.stop()
    keeper.stop()
    (path,) = tmp_path.glob("map-*/map.imp")
    known = Map.load(path)
    assert len(known.stamps) == mapper.status().steps > 10
    assert known.about["counts"]["steps"] == len(known.stamps)
    assert notices == []
    saved = {file: file.read_bytes() for file in keeper.save().iterdir()}
    monkeypatch.setattr("impslam.maps.archive._write", full_disk)
    with pytest.raises(ImpError, match=r"map\.imp could not be written"):
        keeper.save()
    assert {file: file.read_bytes() for file in path.parent.iterdir()} == saved
    assert len(saved) > 5


@pytest.mark.parametrize("full", [False, True])
def test_a_map_contains_the_scans_until_the_next_one_begins(tmp_path, notices, monkeypatch, full):
    mapper, drive, steps = live(load("imp")), list(perfect(load_world("room"))), []
    keeper = MapKeeper(mapper, tmp_path, lambda *event: notices.append(event))
    save = mapper.save_map

    def save_slowly(folder):
        save(folder)
        steps.append(mapper.status().steps)
        hand(mapper, drive[200:400])
        drain(mapper)
        steps.append(mapper.status().steps)
        if full:
            monkeypatch.setattr("impslam.maps.archive._write", full_disk)

    monkeypatch.setattr(mapper, "save_map", save_slowly)
    keeper.begin()
    hand(mapper, drive[:200])
    drain(mapper)
    keeper.begin()
    assert mapper.status().state in {"compiling", "running"}
    assert (mapper.status().steps, keeper.name) == (0, "")
    mapper.stop()
    first, last = steps
    (path,) = tmp_path.glob("map-*/map.imp")
    assert len(Map.load(path).stamps) == (first if full else last)
    assert last > first + 5
    text = f"{path.parent.name}: the last scans are not saved: {path}: cannot be written"
    assert [(level, text) for level, said in notices if said.startswith(text)] == [
        ("error", text)
    ] * full
    assert len(notices) == full


def test_an_error_of_the_estimator_does_not_end_the_saving(keeper, toy, notices):
    toy.kind, toy.error, toy.steps = ZeroDivisionError, "oops", 3
    keeper.start()
    wait_until(lambda: notices)
    assert notices == [("error", "the map is not saved: ZeroDivisionError: oops")]
    toy.error = ""
    wait_until(lambda: toy.saved)
