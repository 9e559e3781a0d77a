"""The virtual camera: what a camera on the robot would see of the world, served as MJPEG.

One ray a column meets the nearest wall and the nearest cylinder (`simulation.raycast.trace`); rows
follow from the pinhole: a point h above the floor at depth z is seen (h - h_camera) f / z above the
horizon. Network cameras speak the same protocol (JPEG parts of one endless HTTP answer), so that
the host reads this one like theirs.
"""

from __future__ import annotations

import contextlib
import math
import threading
import time
from collections.abc import Callable
from functools import cached_property
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from impslam.platform.virtual.paint import Pixels, paint
from impslam.simulation.raycast import trace
from impslam.simulation.scene import Scene, Thing
from impslam.types import Array

BOUNDARY = "impslam-frame"
REACH = 60.0  # m; beyond it the world is haze
HEIGHTS = {"cylinder": 0.7, "person": 0.8}  # m; a column shows one thing of each layer
HEIGHT = 0.9  # m, of all that is straight: boards in a hall
# Red, green, blue. Neighbouring walls differ, so that a picture tells where the robot looks.
WALLS = ((196, 176, 150), (150, 178, 190), (178, 190, 154), (192, 158, 158), (168, 160, 190))
COLOURS = {
    "cylinder": (232, 110, 40),
    "person": (60, 70, 110),
    "box": (170, 130, 80),
    "door": (140, 96, 60),
    "room": (120, 118, 112),
    "doorway": (110, 106, 100),
}


class Lens(NamedTuple):
    """Size of the picture in px, focal length in px, and where the camera is on the robot, in m."""

    width: int = 640
    height: int = 240
    focal: float = 440.4  # 640 px across 72 deg; 240 px are then 30.5 deg
    above_floor: float = 0.35
    forward: float = 0.15


class CameraEmulator:
    """A camera on the robot, and the small HTTP server that shows what it sees.

    Parameters
    ----------
    scene : the world
    pose : returns where the robot is now, `T_map_base` (3,); called from the server's threads
    clock : returns the world's time in s, which doors and people follow
    rate : Hz, pictures sent
    lens : the camera itself
    quality : of the JPEG, 1 to 100
    """

    def __init__(
        self,
        scene: Scene,
        pose: Callable[[], Array],
        clock: Callable[[], float] = lambda: 0.0,
        rate: float = 10.0,
        lens: Lens | None = None,
        quality: int = 85,
    ) -> None:
        self._scene, self._pose, self._clock = scene, pose, clock
        self._rate, self._lens, self._quality = rate, lens or Lens(), quality
        self._server: ThreadingHTTPServer | None = None
        self._closing = threading.Event()
        self._dead_until = self._frozen_until = 0.0

    def picture(self) -> Pixels:
        """Return what the camera sees now, (height, width, 3) in OpenCV's order blue, green, red."""
        lens, pose, time_ = self._lens, self._pose(), self._clock()
        heading = float(pose[2])
        eye = np.array(pose, dtype=np.float64)
        eye[:2] += lens.forward * np.array([math.cos(heading), math.sin(heading)])
        image = np.empty((lens.height, lens.width, 3), np.uint8)
        straight, round_ = self._straight(eye, time_), self._round(eye, time_)
        paint(image, eye, lens.focal, lens.above_floor, straight, round_)
        return image

    def jpeg(self) -> bytes:
        """Return what the camera sees now as a JPEG file."""
        _, data = cv2.imencode(".jpg", self.picture(), [cv2.IMWRITE_JPEG_QUALITY, self._quality])
        return data.tobytes()

    def serve(self, port: int = 0) -> str:
        """Begin to serve on loopback and return the URL; port 0 takes a free one."""
        self.picture()  # loads the kernels, which holds all threads up, before time matters
        server = ThreadingHTTPServer(("127.0.0.1", port), _handler(self))
        server.daemon_threads = True
        self._server = server
        threading.Thread(target=server.serve_forever, args=(0.05,), daemon=True).start()
        return f"http://127.0.0.1:{server.server_address[1]}/stream"

    def unplug(self, seconds: float) -> None:
        """Cut all connections and refuse new ones for this long."""
        self._dead_until = time.monotonic() + seconds

    def freeze(self, seconds: float) -> None:
        """Send nothing for this long without cutting the connection: a camera that hangs."""
        self._frozen_until = time.monotonic() + seconds

    def close(self) -> None:
        """End the server and all its connections."""
        self._closing.set()
        if self._server is not None:
            self._server.shutdown()
            self._server.server_close()
            self._server = None

    @property
    def plugged(self) -> bool:
        """Whether it is there at all."""
        return not self._closing.is_set() and time.monotonic() >= self._dead_until

    def pause(self) -> bool:
        """Wait for the next picture's turn; False once the connection is to end."""
        self._closing.wait(1.0 / self._rate)
        while self.plugged and time.monotonic() < self._frozen_until:
            self._closing.wait(0.02)
        return self.plugged

    @cached_property
    def _columns(self) -> Array:
        """Angle of each column's ray in the camera, (width,) rad; the left one is positive."""
        middle = 0.5 * (self._lens.width - 1)
        side = middle - np.arange(self._lens.width, dtype=np.float64)
        return np.asarray(np.arctan(side / self._lens.focal), dtype=np.float64)

    @cached_property
    def _looks(self) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
        """Heights (k,) and colours (k, 3) of what is straight and of what is round."""
        scene = self._scene
        standing, circles = len(scene.segments), len(scene.circles)
        leaves = len(scene.leaves(0.0))
        things = scene.things
        first, second = standing + circles, standing + circles + leaves
        straight = (*things[:standing], *things[first:second])
        return _looks(straight), _looks((*things[standing:first], *things[second:]))

    def _straight(self, eye: Array, time_: float) -> Array:
        segments = np.vstack([self._scene.segments, self._scene.leaves(time_)])
        depth, light, hits, points = self._cast(eye, segments, np.empty((0, 3)))
        chosen = segments[hits] if len(segments) else np.zeros((len(hits), 4))
        way = chosen[:, 2:] - chosen[:, :2]
        length = np.maximum(np.hypot(*way.T), np.finfo(float).tiny)
        along = ((points - chosen[:, :2]) * way).sum(1) / length
        return _layer(depth, along, light, self._looks[0], hits)

    def _round(self, eye: Array, time_: float) -> Array:
        circles = np.vstack([self._scene.circles, self._scene.legs(time_)])
        depth, light, hits, _ = self._cast(eye, np.empty((0, 4)), circles)
        return _layer(depth, np.full(len(hits), -1.0), light, self._looks[1], hits)

    def _cast(
        self, eye: Array, segments: Array, circles: Array
    ) -> tuple[Array, Array, npt.NDArray[np.int64], Array]:
        """Return depth, light, what was hit and where, for each column; depth is inf for nothing."""
        rays, nothing = self._columns, (np.empty((2, 0, 4)), np.empty((2, 0, 3)))
        lasers = np.tile(eye, (len(rays), 1))
        fractions = np.zeros(len(rays))
        ranges, cosines, hits = trace(lasers, rays, fractions, (segments, circles), nothing, REACH)
        near = np.where(hits >= 0, ranges, 0.0)
        directions = eye[2] + rays
        points = eye[:2] + near[:, None] * np.column_stack([np.cos(directions), np.sin(directions)])
        # Brightest where seen squarely, and dimmer with the way.
        light = (0.55 + 0.45 * cosines) / (1.0 + 0.06 * near)
        return ranges * np.cos(rays), light, hits, points


def _looks(things: tuple[Thing, ...]) -> tuple[Array, Array]:
    heights = [HEIGHTS.get(thing.kind, HEIGHT) for thing in things]
    colours = [COLOURS.get(thing.kind, WALLS[thing.part % len(WALLS)]) for thing in things]
    return np.array(heights, dtype=np.float64), np.array(colours, dtype=np.float64).reshape(-1, 3)


def _layer(
    depth: Array,
    along: Array,
    light: Array,
    looks: tuple[Array, Array],
    hits: npt.NDArray[np.int64],
) -> Array:
    """Return [depth, height, place along it, light, blue, green, red] of the columns, (n, 7)."""
    heights, colours = looks
    if not len(heights):
        return np.full((len(depth), 7), np.inf)
    return np.column_stack([depth, heights[hits], along, light, colours[hits, ::-1]])


def _handler(camera: CameraEmulator) -> type[BaseHTTPRequestHandler]:
    """Return the class that answers requests for this camera."""

    class Handler(BaseHTTPRequestHandler):
        timeout = 5.0

        def do_GET(self) -> None:
            if self.path != "/stream":
                self.send_error(404)
            elif not camera.plugged:
                self.send_error(503)
            else:
                with contextlib.suppress(OSError):  # who watched has gone
                    self._stream()

        def _stream(self) -> None:
            self.send_response(200)
            self.send_header("Content-Type", f"multipart/x-mixed-replace; boundary={BOUNDARY}")
            self.end_headers()
            while camera.plugged:
                data = camera.jpeg()
                head = f"--{BOUNDARY}\r\nContent-Type: image/jpeg\r\nContent-Length: {len(data)}"
                self.wfile.write(head.encode() + b"\r\n\r\n" + data + b"\r\n")
                if not camera.pause():
                    break

        def log_message(self, format: str, *args: object) -> None:  # noqa: A002  # its own name
            pass

    return Handler
