"""A fake robot, and a server without a guard, to test the page by itself.

Run it to look at the page: `python tests/platform/console/fake_station.py --port 8090`;
`?as=watcher` in the address makes who opens it a watcher. What the robot was told is at `/fake/state`.
"""

from __future__ import annotations

import argparse
import json
import math
import tempfile
import threading
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast
from urllib.parse import parse_qs

import cv2
import numpy as np
import uvicorn
from fastapi import FastAPI, Request, Response
from nicegui import ui

from impslam.errors import ImpError
from impslam.geometry.se2 import compose
from impslam.observers.grid_picture import GridPicture
from impslam.observers.live_view import Snapshot
from impslam.platform.console import page
from impslam.platform.console.model import Model
from impslam.platform.console.session import Session
from impslam.platform.devices.base import DeviceHealth, now
from impslam.platform.station.drive_control import DriveControl
from impslam.platform.station.log_store import StoredLog
from impslam.platform.station.map_store import StoredMap
from impslam.platform.station.mapper_status import MapperStatus
from impslam.platform.station.player import PlayerStatus
from impslam.platform.station.recorder import RecordingStatus
from impslam.platform.station.station import StationHealth
from impslam.platform.station.store import DeletedEntry
from impslam.types import Array, Climate, Event, Image, Landmark

LIMITS = (0.6, 1.5)
CORNERS = np.array([[-1.5, -1.0], [7.0, -1.0], [7.0, 4.5], [-1.5, 4.5]])
POSTS = np.array([[1.2, 2.6], [3.4, 0.6], [5.3, 3.1]])
POST = 0.12
RESOLUTION = 0.05
ORIGIN = np.array([-2.5, -2.0])
COLUMNS, ROWS = 210, 150
BEAMS = np.linspace(-2.09, 2.09, 682)


def ranges(pose: Array) -> Array:
    """Return the ranges of a lidar of 4 m from a pose: distances to walls and posts."""
    directions = pose[2] + BEAMS
    d = np.stack((np.cos(directions), np.sin(directions)), 1)
    far = np.full(len(d), 5.6)
    for a, b in zip(CORNERS, np.roll(CORNERS, -1, 0), strict=True):
        n = np.array([b[1] - a[1], a[0] - b[0]])
        with np.errstate(divide="ignore", invalid="ignore"):
            t = (a - pose[:2]) @ n / (d @ n)
        far = np.where((t > 0) & (t < far), t, far)
    for post in POSTS:
        along = d @ (post - pose[:2])
        off = (post - pose[:2]) @ (post - pose[:2]) - along**2
        t = along - np.sqrt(np.maximum(POST**2 - off, 0))
        far = np.where((off < POST**2) & (t > 0) & (t < far), t, far)
    return far


class FakeView:
    """A map that grows while a fake robot drives."""

    def __init__(self) -> None:
        self.generator = np.random.default_rng(1)
        self.seen = np.zeros((ROWS, COLUMNS), np.uint8)
        self.path: list[Array] = []
        self.count, self.placed = 0, True
        self.begins_at = 0.0  # monotonic
        self.now: Snapshot = Snapshot(
            0, 1, math.nan, 0, np.zeros(3), np.zeros((3, 3)), np.zeros(3), np.zeros((0, 2), np.float32),
            (), np.zeros((0, 2), np.float32), None, "TRACKING", "", math.nan, None, False,
        )  # fmt: skip

    def snapshot(self) -> Snapshot:
        return self.now

    def begin(self) -> None:
        """Begin a new map, whose first scan comes half a second later."""
        self.seen = np.zeros((ROWS, COLUMNS), np.uint8)
        self.path, self.count, self.begins_at = [], 0, time.monotonic() + 0.5
        empty = FakeView().now
        self.now = replace(empty, version=self.now.version + 1, run=self.now.run + 1)

    def move(self, pose: Array, odometry: Array, arrived: float) -> None:
        """Show one more scan."""
        if time.monotonic() < self.begins_at:
            return
        self.count += 1
        far = ranges(pose)
        valid = far < 5.6
        far += self.generator.normal(0, 0.012, len(BEAMS))
        angles = pose[2] + BEAMS
        ends = pose[:2] + far[:, None] * np.stack((np.cos(angles), np.sin(angles)), 1)
        self._paint(pose, ends, valid)
        if not self.path or np.hypot(*(pose[:2] - self.path[-1])) > 0.04:
            self.path.append(pose[:2].copy())
        grown = 0.004 + 0.0004 * math.hypot(pose[0], pose[1])
        covariance = np.diag([4 * grown**2, grown**2, 0.006**2])
        self.now = Snapshot(
            self.now.version + 1, self.now.run, arrived, self.count,
            pose.copy(), covariance, odometry.copy(),
            np.array([*self.path, pose[:2]], np.float32), self._landmarks(arrived),
            ends[valid].astype(np.float32),
            self._grid() if self.count % 10 == 1 else self.now.grid, "TRACKING", "",
            arrived, None, False, self.placed,
        )  # fmt: skip

    def _paint(self, pose: Array, ends: Array, valid: Any) -> None:
        def cell(points: Array) -> Any:
            xy = (points - ORIGIN) / RESOLUTION
            return np.stack((xy[..., 0], ROWS - 1 - xy[..., 1]), -1).astype(np.int32)

        shape = np.vstack((cell(pose[:2])[None], cell(ends)))
        free = np.zeros_like(self.seen)
        cv2.fillPoly(free, [shape], 1)
        self.seen[(free == 1) & (self.seen == 0)] = 1
        x, y = np.clip(cell(ends[valid]), 0, [COLUMNS - 1, ROWS - 1]).T
        self.seen[y, x] = 2

    def _grid(self) -> GridPicture:
        grey = np.where(self.seen == 2, 0, 255).astype(np.uint8)
        picture = np.dstack((grey, grey, grey, np.where(self.seen > 0, 255, 0).astype(np.uint8)))
        png = cv2.imencode(".png", picture)[1].tobytes()
        version = 1 if self.now.grid is None else self.now.grid.version + 1
        return GridPicture(png, version, ORIGIN, RESOLUTION, (COLUMNS, ROWS))

    def _landmarks(self, stamp: float) -> tuple[Landmark, ...]:
        if self.count % 5 and self.now.landmarks:
            return self.now.landmarks
        sigma = 0.02 + 0.06 / (1 + 0.02 * self.count)
        points = [
            Landmark(i, "cylinder", post, {"radius": POST}, np.diag([sigma**2, 4 * sigma**2]) / 4,
                     None, self.count, 0.0, stamp)
            for i, post in enumerate(POSTS)
        ]  # fmt: skip
        walls = [
            Landmark(3 + i, "wall", a, {"r": 1.0, "alpha": 0.0}, np.eye(2) * 1e-4,
                     np.array([a, b]), self.count, 0.0, stamp)
            for i, (a, b) in enumerate(zip(CORNERS, np.roll(CORNERS, -1, 0), strict=True))
        ]  # fmt: skip
        return (*points, *walls)


class FakeDrive:
    """Records its commands."""

    stopped = False
    title, blockage = "drive", ""

    def __init__(self) -> None:
        self.told: list[tuple[float, float, float]] = []
        self.speed = self.turn_rate = 0.0
        self.stops = self.releases = 0

    def drive(self, speed: float, turn_rate: float) -> None:
        if (speed, turn_rate) != (self.speed, self.turn_rate):
            self.told.append((now(), speed, turn_rate))
        self.speed, self.turn_rate = speed, turn_rate

    def emergency_stop(self) -> None:
        self.stops += 1
        self.speed = self.turn_rate = 0.0

    def release(self) -> None:
        self.releases += 1


class FakeStore:
    def __init__(self) -> None:
        t = time.time()
        self.kept = [
            StoredLog("20261120-141503-arena.mcap", 48_213_554, t - 3600, False, False, 912.0),
            StoredLog("20261119-093012.mcap", 7_213_554, t - 90_000, False, True, 131.0),
            StoredLog(
                "20261118-170455-corridor.mcap", 412_213_554, t - 190_000, False, False, 7812.0
            ),
        ]
        self.binned: list[DeletedEntry] = []

    def logs(self) -> list[StoredLog]:
        return list(self.kept)

    def bin(self) -> list[DeletedEntry]:
        return list(self.binned)

    def delete(self, name: str) -> None:
        log = next(log for log in self.kept if log.name == name)
        self.kept.remove(log)
        self.binned.insert(0, DeletedEntry("1-" + name, name, log.size, time.time()))

    def restore(self, name: str) -> Path:
        one = next(one for one in self.binned if one.name == name)
        self.binned.remove(one)
        self.kept.append(StoredLog(one.original, one.size, time.time(), False, False, math.nan))
        return Path(one.original)

    def purge(self) -> None:
        self.binned = []


class FakeMaps:
    def __init__(self) -> None:
        t = time.time()
        self.kept = [
            StoredMap("map-20261121-101500", 184_000, t - 20, 412, True, False),
            StoredMap("map-20261120-141503", 1_912_000, t - 3600, 8512, False, True),
            StoredMap("map-20261118-170455", 93_000, t - 190_000, 0, False, False, "not a map"),
        ]
        self.binned: list[tuple[DeletedEntry, StoredMap]] = []

    def maps(self) -> list[StoredMap]:
        return sorted(self.kept, key=lambda one: -one.modified)

    def bin(self) -> list[DeletedEntry]:
        return [binned for binned, _ in self.binned]

    def delete(self, name: str) -> None:
        one = next(one for one in self.kept if one.name == name)
        self.kept.remove(one)
        self.binned.insert(0, (DeletedEntry("1_" + name, name, one.size, time.time()), one))

    def restore(self, name: str) -> Path:
        found = next(pair for pair in self.binned if pair[0].name == name)
        self.binned.remove(found)
        self.kept.append(found[1])
        return Path(found[1].name)

    def purge(self) -> None:
        self.binned = []


class FakeRecorder:
    def __init__(self, store: FakeStore) -> None:
        self.store, self.begun, self.name = store, 0.0, ""

    def start(self, name: str | None = None) -> Path:
        if name == "full":
            raise ImpError("the disk is full; delete logs or empty the recycle bin")
        self.begun = time.time()
        self.name = f"{time.strftime('%Y%m%d-%H%M%S')}{'-' + name if name else ''}.mcap"
        self.store.kept.insert(0, StoredLog(self.name, 1, self.begun, True, True, math.nan))
        return Path(self.name)

    def stop(self) -> Path | None:
        log = self.store.kept.pop(0)
        seconds = time.time() - self.begun
        size = int(52_000 * seconds)
        done = replace(log, recording=False, cut=False, size=size, duration=seconds)
        self.store.kept.insert(0, done)
        self.begun = 0.0
        return Path(log.name)

    def status(self) -> RecordingStatus:
        seconds = time.time() - self.begun if self.begun else 0.0
        path = Path(self.name) if self.name else None
        size = int(52_000 * seconds)
        return RecordingStatus(bool(self.begun), path, seconds, size, 23_400_000_000)


class FakeMapper:
    def __init__(self) -> None:
        self.state, self.steps, self.starts = "off", 0, 0
        self.name, self.frozen, self.placed = "", False, True

    def status(self) -> MapperStatus:
        known = self.name, self.frozen, self.placed
        return MapperStatus(cast("Any", self.state), self.steps, 0, 0, 0.08, 0.012, "", 0, *known)


class FakeStation:
    """A station for the page."""

    def __init__(self, folder: Path, *, tour: bool) -> None:
        self.folder, self.limits, self.tour = folder, LIMITS, tour
        self.drive = FakeDrive()
        self.events: list[Event] = []
        self.drive_control = DriveControl(cast("Any", self.drive), LIMITS, self._announce)
        self.devices = {"autopilot": self.drive, "lidar": object(), "camera": object()}
        self.store, self.mapper, self.view = FakeStore(), FakeMapper(), FakeView()
        self.recorder, self.maps = FakeRecorder(self.store), FakeMaps()
        self.picture: Image | None = None
        self.lost: str = ""
        self.pose, self.odometry = np.zeros(3), np.zeros(3)
        self.faults: list[dict[str, Any]] = []
        self.hints: list[tuple[float, float]] = []
        self.map_folder: Path | None = None

    def fault(self, fault: str, **what: Any) -> None:
        if fault == "malfunction":
            raise ImpError("fault malfunction: only a URG tells statuses; choose another fault")
        self.faults.append({"fault": fault, **what})

    def start(self) -> None:
        self._announce("info", "the robot is ready")
        self.drive_control.start()
        threading.Thread(target=self._live, daemon=True).start()

    def health(self) -> StationHealth:
        autopilot = DeviceHealth(
            "ok", "IMP autopilot, protocol 1, firmware 1.4",
            {"WheelAngles": 100.0, "Imu": 100.0, "EncoderVoltages": 100.0, "Climate": 1.0},
            {"frames": 91_234, "lost": 2, "corrupt": 1}, now(),
        )  # fmt: skip
        if self.lost:
            autopilot = DeviceHealth("lost", self.lost, {}, {"lost connection": 1}, now())
        lidar = DeviceHealth(
            "ok", "URG-04LX UTM-30, serial H0508486", {"LaserScan": 10.0}, {}, now()
        )
        camera = DeviceHealth("silent", "video0, 640 x 480", {"Image": 0.0}, {}, now() - 4)
        if self.picture is not None:
            camera = DeviceHealth("ok", "video0, 640 x 480", {"Image": 5.0}, {}, now())
        devices = {"autopilot": autopilot, "lidar": lidar, "camera": camera}
        climate = Climate(now(), 23.14, 0.448)
        return StationHealth(devices, self.recorder.status(), self.mapper.status(), climate)

    def start_mapping(self) -> None:
        self.mapper.state = "running"
        self.mapper.starts += 1
        self.map_folder = None

    def end_mapping(self) -> None:
        self.mapper.state = "off"

    def continue_map(self, name: str, *, frozen: bool = False) -> None:
        self.start_mapping()
        self.mapper.name, self.mapper.frozen, self.mapper.placed = name, frozen, False
        self.view.placed = False

    def hint(self, x: float, y: float) -> None:
        self.hints.append((x, y))
        self.mapper.placed = self.view.placed = True

    def save_map(self) -> Path:
        self.map_folder = self.folder / "maps" / "map-20261121-101500"
        return self.map_folder

    def _announce(self, level: str, text: str) -> None:
        self.events.append(Event(now(), level, "robot", text))

    def _live(self) -> None:
        if self.tour:
            self.start_mapping()
            for angle in np.linspace(-2.6, 3.2, 420):
                self.pose = np.array(
                    [2.6 + 2.9 * math.cos(angle), 1.75 + 1.5 * math.sin(angle), 0.0]
                )
                self.pose[2] = math.atan2(1.5 * math.cos(angle), -2.9 * math.sin(angle))
                self.odometry = compose(np.array([0.1, -0.1, 0.05 * (angle + 2.6)]), self.pose)
                self._advance(0.0, 0.0, now())
        while True:
            time.sleep(0.1)
            self._advance(self.drive.speed, self.drive.turn_rate, now())
            if self.view.count % 2:
                self._look()

    def _advance(self, speed: float, turn_rate: float, arrived: float) -> None:
        step = np.array([0.1 * speed, 0.0, 0.1 * turn_rate])
        self.pose = compose(self.pose, step)
        self.odometry = compose(self.odometry, step * np.array([1.01, 1, 0.97]))
        if self.mapper.state == "running":
            self.mapper.steps += 1
            self.view.move(self.pose, self.odometry, arrived)

    def _look(self) -> None:
        far = np.interp(np.linspace(0.5, -0.5, 640), BEAMS, ranges(self.pose))
        picture = np.full((480, 640, 3), (90, 110, 120), np.uint8)
        picture[:240] = (150, 140, 130)
        for column, distance in enumerate(far):
            high = int(min(200 / max(distance, 0.3), 230))
            shade = int(np.clip(240 - 38 * distance, 40, 240))
            picture[240 - high : 240 + high, column] = (shade, shade, int(shade * 0.9))
        cv2.putText(picture, time.strftime("%H:%M:%S"), (16, 460), 0, 0.8, (255, 255, 255), 2)
        data = cv2.imencode(".jpg", picture)[1].tobytes()
        self.picture = Image(now(), "jpeg", data)


class FakePlayer:
    def __init__(self) -> None:
        self.state, self.speed, self.steps = "paused", 1.0, 120

    def start(self) -> None:
        self.state = "playing"

    resume = start

    def pause(self) -> None:
        self.state = "paused"

    def step(self) -> None:
        self.steps += 1

    def set_speed(self, speed: float) -> None:
        self.speed = speed

    def status(self) -> PlayerStatus:
        state = cast("Any", self.state)
        return PlayerStatus(state, self.steps, 400, 12.0, 12.0, self.speed, self.steps, 0.0, "")


class Sessions:
    """Stands for the guard: gives each request a session, by a cookie that the address sets."""

    def __init__(self, app: Any) -> None:
        self.app = app
        self.reset()

    def reset(self) -> None:
        self.sessions = {
            "driver": Session("1", "driver 1", may_drive=True),
            "second": Session("2", "driver 2", may_drive=True),
            "watcher": Session("3", "watcher 3", may_drive=False),
        }

    async def __call__(self, scope: Any, receive: Any, send: Any) -> None:
        if scope["type"] in {"http", "websocket"}:
            cookie = dict(scope["headers"]).get(b"cookie", b"").decode()
            asked = parse_qs(scope["query_string"].decode()).get("as", [None])[0]
            who = asked or next(
                (name for name in self.sessions if f"as={name}" in cookie), "driver"
            )
            scope.setdefault("state", {})["session"] = self.sessions[who]
            if scope["path"] == "/fake/end":
                self.sessions[who].end()
            if scope["type"] == "http" and scope["path"] == "/" and not self.sessions[who].alive():
                await Response("log in again", 401)(scope, receive, send)
                return
        await self.app(scope, receive, send)


def _serve_troubles(api: FastAPI, station: FakeStation) -> None:
    """Serve paths at which a test says what happens to the robot."""

    @api.get("/fake/lose")
    def lose(why: str = "") -> None:
        station.lost = why

    @api.get("/fake/compile")
    def compiling(on: bool) -> None:
        station.mapper.state = "compiling" if on else "running"

    @api.get("/fake/hinder")
    def hinder(why: str = "") -> None:
        station.drive.blockage = why

    @api.get("/fake/begin")
    def begin() -> None:
        station.view.begin()


def serve(port: int, *, tour: bool, replay: bool) -> None:
    """Serve the page until the process is ended."""
    api = FastAPI()
    station = FakeStation(Path(tempfile.mkdtemp()), tour=tour)
    station.start()
    player = FakePlayer()
    sessions = Sessions(api)

    @api.get("/fake/state")
    def state() -> dict[str, Any]:
        drive_control, drive = station.drive_control.state(), station.drive
        return {
            "told": drive.told, "faults": station.faults, "stops": drive.stops, "releases": drive.releases,
            "driver": drive_control.name, "stopped": drive_control.stopped, "speed": drive_control.speed,
            "turn_rate": drive_control.turn_rate, "latencies": page.latencies().tolist(),
            "player": [player.state, player.speed, player.steps], "starts": station.mapper.starts,
            "hints": station.hints,
            "recording": station.recorder.status().active, "logs": [log.name for log in station.store.kept],
            "pose": station.pose.tolist(), "cpu": time.process_time(), "time": time.time(),
        }  # fmt: skip

    @api.get("/camera.jpg")
    def camera() -> Response:
        picture = station.picture
        return Response(
            picture.data if picture else b"", 200 if picture else 404, media_type="image/jpeg"
        )

    @api.post("/logout")
    def logout(request: Request) -> Response:
        request.state.session.end()
        return Response("logged out", media_type="text/plain")

    _serve_troubles(api, station)

    @api.get("/fake/reset")
    def reset() -> None:
        """Reset everything but the map."""
        sessions.reset()
        station.drive_control.leave(station.drive_control.state().driver or "")
        station.drive_control.take("reset", "reset")
        station.drive_control.release("reset")
        station.drive_control.leave("reset")
        station.events[:] = [Event(now(), "info", "robot", "the robot is ready")]
        station.drive.told.clear()
        station.drive.stops = station.drive.releases = station.mapper.starts = 0
        station.hints.clear()
        station.mapper.name, station.mapper.frozen = "", False
        station.mapper.placed = station.view.placed = True

    @api.get("/fake/demote")
    def demote() -> None:
        sessions.sessions["driver"].may_drive = False

    @api.get("/fake/end")
    def end() -> None:
        """The session in the cookie is over; its page is served no more, as the guard does."""

    view = cast("Any", station.view)
    virtual = SimpleNamespace(fault=station.fault, failure="") if station.tour else None
    model = Model("IMP", view, cast("Any", station), virtual=cast("Any", virtual))
    if replay:
        model = Model("20261120-141503-arena.mcap", view, player=cast("Any", player))
    page.build(model)
    ui.run_with(api, title="IMP", show_welcome_message=False, tailwind=False)
    print(json.dumps({"port": port}), flush=True)
    uvicorn.run(sessions, host="127.0.0.1", port=port, log_level="warning")


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--port", type=int, default=8090)
    parser.add_argument("--tour", action="store_true", help="begin with a map of a long drive")
    parser.add_argument("--replay", action="store_true", help="a player instead of a robot")
    asked = parser.parse_args()
    serve(asked.port, tour=asked.tour, replay=asked.replay)
