"""The logs on the disk: nothing outside the folder, nothing overwritten, and a recycle bin."""

import os
import threading
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from impslam.errors import ImpError
from impslam.platform.station.log_store import LogStore, StoreError
from impslam.sources.live_recording import LiveMcapWriter
from impslam.types import WheelAngles


def record(path: Path, seconds: float = 2.5) -> Path:
    with LiveMcapWriter(path, "imp", 100.0) as writer:
        writer.write(WheelAngles(100.0 + seconds, 1.0, 2.0))
    return path


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder with two logs, a cut one, and other files."""
    folder = tmp_path / "logs"
    folder.mkdir()
    for i, name in enumerate(("a.mcap", "b.mcap")):
        os.utime(record(folder / name), (1000.0 + i, 1000.0 + i))
    content = (folder / "a.mcap").read_bytes()
    (folder / "cut.mcap").write_bytes(content[:-20])
    os.utime(folder / "cut.mcap", (1002.0, 1002.0))
    (folder / "maps").mkdir()
    (folder / "folder.mcap").mkdir()
    (folder / "notes.txt").write_text("mine")
    (folder / ".hidden.mcap").write_text("mine")
    (folder / "li\nne.mcap").write_text("mine")
    (tmp_path / "outside.mcap").write_text("secret")
    (folder / "link.mcap").symlink_to(tmp_path / "outside.mcap")
    (folder / "dangling.mcap").symlink_to(tmp_path / "nothing")
    (folder / "elsewhere").symlink_to(tmp_path)
    return folder


def names(store: LogStore) -> list[str]:
    return [log.name for log in store.logs()]


def test_logs_are_listed_newest_first_with_their_facts(folder: Path) -> None:
    cut, b, a = LogStore(folder).logs()
    assert [log.name for log in (cut, b, a)] == ["cut.mcap", "b.mcap", "a.mcap"]
    assert a.size == (folder / "a.mcap").stat().st_size
    assert (a.modified, a.recording, a.cut) == (1000.0, False, False)
    assert a.duration == pytest.approx(2.5, abs=1e-6)
    assert cut.cut
    assert cut.duration != cut.duration


def test_a_log_that_grew_is_read_again(folder: Path) -> None:
    store = LogStore(folder)
    assert store.logs()[0].cut
    (folder / "cut.mcap").write_bytes((folder / "a.mcap").read_bytes())
    again = {log.name: log for log in store.logs()}["cut.mcap"]
    assert not again.cut
    assert again.duration == pytest.approx(2.5, abs=1e-6)


def test_a_file_that_is_not_a_log_is_listed_as_cut(tmp_path: Path) -> None:
    magic = b"\x89MCAP0\r\n"
    contents = {"empty": b"", "short": b"abc", "noise": os.urandom(500), "ends": b"xxxx" + magic}
    for name, content in contents.items():
        (tmp_path / f"{name}.mcap").write_bytes(content)
    found = {log.name: log.cut for log in LogStore(tmp_path).logs()}
    assert found == {"empty.mcap": True, "short.mcap": True, "noise.mcap": True, "ends.mcap": False}


def test_the_log_being_recorded_cannot_be_deleted(folder: Path) -> None:
    store = LogStore(folder)
    with LiveMcapWriter(folder / "now.mcap", "imp", 100.0):
        (now,) = (log for log in store.logs() if log.recording)
        assert (now.name, now.cut) == ("now.mcap", False)
        with pytest.raises(StoreError, match="is being recorded; stop"):
            store.delete("now.mcap")
    assert not any(log.recording for log in store.logs())
    store.delete("now.mcap")
    assert "now.mcap" not in names(store)


STRANGE = [
    "",
    ".",
    "..",
    ".mcap",
    "a",
    "notes.txt",
    ".hidden.mcap",
    "missing.mcap",
    "link.mcap",
    "dangling.mcap",
    "folder.mcap",
    "li\nne.mcap",
    "../outside.mcap",
    "elsewhere/outside.mcap",
    "maps/../a.mcap",
    "./a.mcap",
    "..\\outside.mcap",
    "a.mcap\0",
    "a.mcap/",
    "\udcff.mcap",
    "x" * 5000 + ".mcap",
    "%2e%2e%2foutside.mcap",
    "/etc/passwd",
    "//a.mcap",
]


@pytest.mark.parametrize("name", STRANGE)
def test_only_listed_logs_are_accessible(folder: Path, name: str) -> None:
    store = LogStore(folder)
    for names_of in (name, str(folder.parent / "outside.mcap"), str(folder / "a.mcap")):
        for act in (store.path, store.delete, store.restore):
            with pytest.raises(StoreError) as raised:
                act(names_of)
            assert "\n" not in str(raised.value)
            assert len(str(raised.value)) < 300
    assert (folder.parent / "outside.mcap").read_text() == "secret"


@given(st.text(max_size=40) | st.text("./\\a~%\0-", max_size=12).map(lambda s: s + ".mcap"))
def test_a_path_is_within_or_an_error(tmp_path_factory: pytest.TempPathFactory, name: str) -> None:
    folder = tmp_path_factory.getbasetemp()
    try:
        path = LogStore(folder).path(name)
    except ImpError:
        return
    assert path.parent == folder


def test_deleted_logs_can_be_restored(folder: Path) -> None:
    store = LogStore(folder)
    content = store.path("a.mcap").read_bytes()
    store.delete("a.mcap")
    assert names(store) == ["cut.mcap", "b.mcap"]
    (binned,) = store.bin()
    assert (binned.original, binned.size) == ("a.mcap", len(content))
    assert abs(binned.deleted - (folder / ".bin").stat().st_mtime) < 60.0
    assert store.restore(binned.name) == folder / "a.mcap"
    assert store.path("a.mcap").read_bytes() == content
    assert store.logs()[-1].modified == 1000.0  # not the time of restoring
    assert store.bin() == []


def test_restoring_never_overwrites(folder: Path) -> None:
    store = LogStore(folder)
    store.delete("a.mcap")
    (folder / "a.mcap").write_text("new")
    (binned,) = store.bin()
    with pytest.raises(StoreError, match="a log of this name exists"):
        store.restore(binned.name)
    assert (folder / "a.mcap").read_text() == "new"
    assert store.bin() == [binned]


def test_several_of_one_name_in_the_bin(folder: Path) -> None:
    store = LogStore(folder)
    for text in ("one", "two", "three"):
        (folder / "same.mcap").write_text(text)
        store.delete("same.mcap")
    assert [log.original for log in store.bin()] == ["same.mcap"] * 3
    assert len({log.name for log in store.bin()}) == 3
    texts = {(folder / ".bin" / log.name).read_text() for log in store.bin()}
    assert texts == {"one", "two", "three"}


def test_purging_leaves_foreign_files(folder: Path) -> None:
    store = LogStore(folder)
    for name in ("a.mcap", "b.mcap", "cut.mcap"):
        store.delete(name)
    (folder / ".bin" / "keep.txt").write_text("mine")
    (folder / ".bin" / "99999999T999999Z_x.mcap").write_text("mine")
    assert len(store.bin()) == 3
    store.purge()
    assert store.bin() == []
    assert {p.name for p in (folder / ".bin").iterdir()} == {"keep.txt", "99999999T999999Z_x.mcap"}


def test_a_bin_that_is_a_link_is_not_used(folder: Path) -> None:
    (folder.parent / "20260101T000000Z_a.mcap").write_text("secret")
    (folder / ".bin").symlink_to(folder.parent)
    store = LogStore(folder)
    assert store.bin() == []
    with pytest.raises(StoreError):
        store.restore("20260101T000000Z_a.mcap")
    with pytest.raises(StoreError, match="is a link"):
        store.delete("a.mcap")
    store.purge()
    assert (folder.parent / "20260101T000000Z_a.mcap").read_text() == "secret"
    assert "a.mcap" in names(store)


def test_a_missing_folder_has_no_logs(tmp_path: Path) -> None:
    store = LogStore(tmp_path / "no")
    assert store.logs() == []
    assert store.bin() == []
    store.purge()
    with pytest.raises(StoreError):
        store.delete("a.mcap")


def test_a_disk_error_is_reported(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(path: Path, target: Path) -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "replace", refuse)
    store = LogStore(folder)
    with pytest.raises(StoreError, match=r"a\.mcap: the disk refuses \(Permission denied\)"):
        store.delete("a.mcap")
    assert store.bin() == []  # no empty file stays behind
    assert "a.mcap" in names(store)


def test_many_threads_delete_and_restore_and_nothing_is_lost(folder: Path) -> None:
    store, trouble = LogStore(folder), []
    contents = {name: (folder / name).read_bytes() for name in names(store)}

    def act(number: int) -> None:
        for _ in range(20):
            try:
                for log in store.logs()[number % 2 :: 2]:
                    store.delete(log.name)
                for binned in store.bin():
                    store.restore(binned.name)
            except StoreError:
                pass  # another thread was quicker
            except Exception as error:  # any error is a failure
                trouble.append(error)

    threads = [threading.Thread(target=act, args=(i,)) for i in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not trouble
    for binned in store.bin():
        store.restore(binned.name)
    assert {name: store.path(name).read_bytes() for name in names(store)} == contents


def test_files_that_vanish_while_they_are_listed(folder: Path) -> None:
    store, over = LogStore(folder), threading.Event()

    def churn() -> None:
        while not over.is_set():
            path = folder / "gone.mcap"
            path.write_text("x")
            path.unlink()

    thread = threading.Thread(target=churn)
    thread.start()
    try:
        for _ in range(200):
            assert {"a.mcap", "b.mcap", "cut.mcap"} <= set(names(store))
    finally:
        over.set()
        thread.join()
