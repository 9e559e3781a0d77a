"""The virtual camera: pictures of the world from the robot, served as MJPEG.

Network cameras use the same protocol (JPEG parts of one endless HTTP answer).
"""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

from impslam.simulation.camera import Lens, SceneCamera
from impslam.simulation.paint import Pixels
from impslam.simulation.scene import Scene
from impslam.types import Array

BOUNDARY = "impslam-frame"


class CameraEmulator:
    """A camera on the robot, and a small HTTP server for its pictures.

    Parameters
    ----------
    scene : the world
    pose : returns the present pose of the robot, `T_map_base` (3,); called from the server's threads
    clock : returns the time of the world, s, for moving doors and people
    rate : rate of pictures, Hz
    lens : the camera model
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
        self._camera = SceneCamera(scene, lens, quality)
        self._pose, self._clock, self._rate = pose, clock, rate
        self._server: ThreadingHTTPServer | None = None
        self._closing = threading.Event()
        self._dead_until = self._frozen_until = 0.0

    def picture(self) -> Pixels:
        """Return the present picture, (height, width, 3) in OpenCV's order blue, green, red."""
        return self._camera.picture(self._pose(), self._clock())

    def jpeg(self) -> bytes:
        """Return the present picture as a JPEG file."""
        return self._camera.jpeg(self._pose(), self._clock())

    def serve(self, port: int = 0) -> str:
        """Start to serve on loopback and return the URL; port 0 takes a free one."""
        self.picture()  # loads the kernels now, since that blocks all threads
        server = ThreadingHTTPServer(("127.0.0.1", port), _handler(self))
        server.daemon_threads = True
        self._server = server
        threading.Thread(target=server.serve_forever, args=(0.05,), daemon=True).start()
        return f"http://127.0.0.1:{server.server_address[1]}/stream"

    def unplug(self, seconds: float) -> None:
        """Close all connections and refuse new ones for this long."""
        self._dead_until = time.monotonic() + seconds

    def freeze(self, seconds: float) -> None:
        """Send nothing for this long, without closing connections: a camera that hangs."""
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
        """Whether the camera is connected."""
        return not self._closing.is_set() and time.monotonic() >= self._dead_until

    def pause(self) -> bool:
        """Wait until the next picture is due; return False if the connection must end."""
        self._closing.wait(1.0 / self._rate)
        while self.plugged and time.monotonic() < self._frozen_until:
            self._closing.wait(0.02)
        return self.plugged


def _handler(camera: CameraEmulator) -> type[BaseHTTPRequestHandler]:
    """Return the request handler of this camera."""

    class Handler(BaseHTTPRequestHandler):
        timeout = 5.0

        def do_GET(self) -> None:
            if self.path != "/stream":
                self.send_error(404)
            elif not camera.plugged:
                self.send_error(503)
            else:
                with contextlib.suppress(OSError):  # the client has gone
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
