"""Downloads of logs, maps and the picture: by browser, and by curl with resume."""

import dataclasses
import hashlib
import io
import os
import shutil
import subprocess
import threading
import zipfile

import pytest
from tests.platform.console.serving import DRIVE, PICTURE, WATCH, serving

from impslam.platform.console import downloads
from impslam.platform.console.downloads import FixedLengthFileResponse
from impslam.platform.console.throttle import RESET_TIME
from impslam.platform.station.log_store import StoredLog

CONTENT = os.urandom(300_000)


@pytest.fixture(scope="module")
def served(tmp_path_factory):
    folder = tmp_path_factory.mktemp("robot")
    with serving(folder) as running:
        logs = folder / "logs"
        (logs / "one.mcap").write_bytes(CONTENT)
        (logs / "with space & ä.mcap").write_bytes(b"odd")
        run = logs / "maps" / "map-20260101-120000"
        run.mkdir(parents=True)
        (run / "map.imp").write_bytes(b"a map")
        (run / "map.pgm").write_bytes(b"P5")
        (run / "report.html").write_text("<script>")
        (run / "secret").symlink_to("/etc/passwd")
        (logs / "maps" / "linked").symlink_to("/usr")
        running.logs = logs
        yield running


@pytest.fixture(autouse=True)
def calm(served):
    """Reset the throttle between tests."""
    served.clock.ahead += RESET_TIME


@pytest.fixture
def client(served):
    with served.logged_in(WATCH) as client:
        yield client


class TestLogs:
    def test_a_whole_log(self, client):
        answer = client.get("/logs/one.mcap")
        assert answer.content == CONTENT
        assert answer.headers["content-disposition"] == 'attachment; filename="one.mcap"'
        assert answer.headers["content-type"] == "application/octet-stream"
        assert answer.headers["accept-ranges"] == "bytes"

    def test_head_tells_the_size_and_sends_nothing(self, client):
        answer = client.head("/logs/one.mcap")
        assert answer.headers["content-length"] == str(len(CONTENT))
        assert answer.content == b""

    @pytest.mark.parametrize(
        ("requested", "part"),
        [
            ("bytes=100-199", slice(100, 200)),
            ("bytes=299990-", slice(299_990, None)),
            ("bytes=-5", slice(-5, None)),
            ("bytes=0-0", slice(1)),
            ("bytes=299999-999999", slice(-1, None)),
        ],
    )
    def test_a_part_of_it(self, client, requested, part):
        answer = client.get("/logs/one.mcap", headers={"range": requested})
        assert answer.status_code == 206
        assert answer.content == CONTENT[part]

    @pytest.mark.parametrize("requested", ["bytes=300000-", "bytes=999999-1000000"])
    def test_there_is_nothing_beyond_the_end(self, client, requested):
        answer = client.get("/logs/one.mcap", headers={"range": requested})
        assert answer.status_code == 416
        assert answer.headers["content-range"] == f"bytes */{len(CONTENT)}"

    @pytest.mark.parametrize("requested", ["bytes=x", "rows=1-2", "bytes=5-3", "bytes=", "="])
    def test_an_odd_range_harms_nobody(self, client, requested):
        answer = client.get("/logs/one.mcap", headers={"range": requested})
        assert answer.status_code in {200, 206, 400, 416}
        assert client.get("/logs/one.mcap").content == CONTENT

    def test_a_part_of_the_same_file_only(self, client):
        tag = client.head("/logs/one.mcap").headers["etag"]
        headers = {"range": "bytes=10-", "if-range": tag}
        assert client.get("/logs/one.mcap", headers=headers).content == CONTENT[10:]
        headers["if-range"] = '"another"'
        assert client.get("/logs/one.mcap", headers=headers).content == CONTENT

    def test_a_log_that_grows_while_it_is_sent(self, served, client):
        path = served.logs / "growing.mcap"
        path.write_bytes(CONTENT)
        done = threading.Event()

        def grow():  # by 2 MB/s, some ten times what the robot records
            while not done.wait(0.002):
                with path.open("ab") as file:
                    file.write(os.urandom(4096))

        writer = threading.Thread(target=grow)
        writer.start()
        try:
            got = b""
            for _ in range(20):
                answer = client.get("/logs/growing.mcap", headers={"range": f"bytes={len(got)}-"})
                got += answer.content
                whole = client.get("/logs/growing.mcap")
                assert int(whole.headers["content-length"]) == len(whole.content)
        finally:
            done.set()
            writer.join()
        got += client.get("/logs/growing.mcap", headers={"range": f"bytes={len(got)}-"}).content
        assert got == path.read_bytes()

    def test_the_digest_is_accepted_by_sha256sum(self, client):
        digest = client.get("/logs/one.mcap.sha256").text
        assert digest == f"{hashlib.sha256(CONTENT).hexdigest()}  one.mcap\n"
        assert client.head("/logs/one.mcap.sha256").status_code == 200

    def test_any_valid_file_name_is_accepted(self, client):
        assert client.get("/logs/with space & ä.mcap").content == b"odd"

    def test_the_list(self, client, monkeypatch):
        stored = [StoredLog("one.mcap", 3, 1.0, True, False, float("nan"))]
        monkeypatch.setattr("impslam.platform.station.log_store.LogStore.logs", lambda self: stored)
        assert client.get("/logs").json() == [dataclasses.asdict(stored[0]) | {"duration": None}]


class TestCurl:
    """As documented; skipped without curl."""

    @pytest.fixture(autouse=True)
    def curl(self):
        if shutil.which("curl") is None:
            pytest.skip("needs curl")

    def fetch(self, served, folder, *options):
        command = ["curl", "--fail", "--silent", "--show-error", "--noproxy", "*", *options]
        return subprocess.run(
            [*command, f"{served.origin}/logs/one.mcap"],
            cwd=folder,
            capture_output=True,
            check=False,
        )

    def test_an_interrupted_download_is_resumed(self, served, tmp_path):
        (tmp_path / "one.mcap").write_bytes(CONTENT[:123_456])
        done = self.fetch(served, tmp_path, "-u", f"watch:{WATCH}", "-C", "-", "-O")
        assert done.returncode == 0, done.stderr
        assert (tmp_path / "one.mcap").read_bytes() == CONTENT

    def test_a_wrong_password_fetches_nothing(self, served, tmp_path):
        done = self.fetch(served, tmp_path, "-u", "watch:wrong-password", "-O")
        assert done.returncode == 22
        assert b"401" in done.stderr


class TestChallenge:
    def test_a_script_is_asked_for_the_password_and_a_browser_is_not(self, served):
        with served.client() as client:
            requested = client.get("/logs").headers["www-authenticate"]
            assert requested == 'Basic realm="logs", charset="UTF-8"'
            browser = client.get("/logs", headers={"sec-fetch-mode": "cors"})
            assert "www-authenticate" not in browser.headers
            assert "www-authenticate" not in client.get("/camera.jpg").headers
            assert client.get("/logs/one.mcap", auth=("drive", DRIVE)).content == CONTENT


class TestMapsAndPicture:
    def test_the_maps_are_listed_without_links(self, client):
        name = "map-20260101-120000"
        assert client.get("/maps").json() == [{"name": name, "zip": f"/maps/{name}.zip"}]

    def test_a_map_comes_as_zip_without_links(self, client):
        answer = client.get("/maps/map-20260101-120000.zip")
        assert answer.headers["content-type"] == "application/zip"
        with zipfile.ZipFile(io.BytesIO(answer.content)) as archive:
            assert archive.testzip() is None
            folder = "map-20260101-120000"
            files = ["map.imp", "map.pgm", "report.html"]
            assert sorted(archive.namelist()) == [f"{folder}/{name}" for name in files]

    def test_files_of_a_save_under_way_are_not_in_the_zip(self, tmp_path):
        (tmp_path / "map.imp").write_bytes(b"map")
        (tmp_path / ".map.imp.4711.part").write_bytes(b"ma")
        with downloads._zipped(tmp_path) as file, zipfile.ZipFile(file) as archive:
            assert archive.namelist() == [f"{tmp_path.name}/map.imp"]

    @pytest.mark.parametrize("name", ["linked.zip", "none.zip", "map-20260101-120000", ".zip"])
    def test_nothing_else_is_a_map(self, client, name):
        assert client.get(f"/maps/{name}").status_code == 404

    def test_a_map_that_is_deleted_meanwhile_is_not_found(self, client, monkeypatch):
        def gone(folder):
            raise FileNotFoundError(folder)

        monkeypatch.setattr(downloads, "_zipped", gone)
        assert client.get("/maps/map-20260101-120000.zip").status_code == 404

    def test_the_picture(self, client):
        answer = client.get("/camera.jpg")
        assert answer.content == PICTURE
        assert answer.headers["content-type"] == "image/jpeg"


@pytest.mark.anyio
class TestAsOfNow:
    @pytest.fixture
    def anyio_backend(self):
        return "asyncio"

    @pytest.mark.parametrize("grown", [0, 1, 70_000])
    async def test_what_was_written_since_is_left_out(self, tmp_path, grown):
        path = tmp_path / "log"
        path.write_bytes(CONTENT)
        found = path.stat()
        with path.open("ab") as file:
            file.write(b"x" * grown)
        sent = []

        async def send(message):
            sent.append(message)

        async def receive():
            return {"type": "http.disconnect"}

        scope = {"type": "http", "method": "GET", "headers": [], "asgi": {"spec_version": "2.4"}}
        await FixedLengthFileResponse(path, stat_result=found)(scope, receive, send)
        assert b"".join(message.get("body", b"") for message in sent) == CONTENT
        assert [message.get("more_body") for message in sent][-1] is False
        assert all(message["more_body"] for message in sent[1:-1])
