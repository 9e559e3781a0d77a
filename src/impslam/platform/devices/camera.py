"""The camera: JPEG pictures by OpenCV from V4L2 or a network camera, a few a second.

Cameras queue pictures, so that reading five times a second would return old ones. So all pictures are
grabbed as fast as they come, but only those that are due are decoded. A picture is stamped when it is
grabbed, which is 30 to 100 ms after its exposure, due to read-out and transfer.
"""

from __future__ import annotations

import os
from pathlib import Path

import cv2

from impslam import ffmpeg
from impslam.component import parameter, register
from impslam.platform.devices.base import Device, DeviceError, now
from impslam.types import Image

OPEN_TIMEOUT = 2.0  # s; a network camera on the same Wi-Fi answers within one
READ_TIMEOUT = 1.0  # s without a picture: 15 of a slow camera in the dark
MAX_EARLINESS = 0.25  # of a period, by which a picture may be taken early instead of the next one


@register("camera")
class Camera(Device):
    """A camera at /dev/video* or behind a URL."""

    source: str = parameter(
        "/dev/video0", "1", 'a V4L2 device, the number of a camera ("0"), or the URL of a stream'
    )
    rate: float = parameter(5.0, "Hz", "pictures recorded, as in the thesis (3.4)", gt=0, le=60)
    width: int = parameter(
        640, "px", "requested; the camera uses the nearest that it supports", gt=0
    )
    height: int = parameter(480, "px", "requested; ignored by network cameras", gt=0)
    quality: int = parameter(
        80, "1", "JPEG quality; 80: 40 kB a picture, 0.7 GB an hour", ge=1, le=100
    )

    def _serve(self) -> None:
        capture = self._open()
        try:
            self._ready(self._describe(capture))
            self._read_pictures(capture)
        finally:
            capture.release()

    def _open(self) -> cv2.VideoCapture:
        # In s, read by OpenCV at its first use; the default is 10. A setting of the user has priority.
        os.environ.setdefault("OPENCV_VIDEOIO_V4L_SELECT_TIMEOUT", f"{READ_TIMEOUT:.0f}")
        ffmpeg.silence()
        cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
        with ffmpeg.without_delay():
            capture = cv2.VideoCapture(self._address, self._backend, self._options)
        if not capture.isOpened():
            raise DeviceError(f"{self.source}: {self._reason()}")
        return capture

    @property
    def _is_local(self) -> bool:
        return "://" not in self.source

    @property
    def _address(self) -> str | int:
        return int(self.source) if self.source.isdigit() else self.source

    @property
    def _backend(self) -> int:
        if not self._is_local:
            return int(cv2.CAP_FFMPEG)
        return int(cv2.CAP_V4L2 if os.name == "posix" else cv2.CAP_ANY)

    @property
    def _options(self) -> list[int]:
        if not self._is_local:
            timeouts = (cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, cv2.CAP_PROP_READ_TIMEOUT_MSEC)
            values = (round(1e3 * OPEN_TIMEOUT), round(1e3 * READ_TIMEOUT))
            return [word for pair in zip(timeouts, values, strict=True) for word in pair]
        # Compressed by the camera: raw pictures of two cameras fill a USB 2 bus.
        compressed = cv2.VideoWriter.fourcc(*"MJPG")
        wanted = (cv2.CAP_PROP_FOURCC, compressed, cv2.CAP_PROP_FRAME_WIDTH, self.width)
        return [*wanted, cv2.CAP_PROP_FRAME_HEIGHT, self.height]

    def _reason(self) -> str:
        """Return why it could not be opened, and what to do."""
        if not self._is_local:
            return "does not answer; check the address and that the camera is on"
        path = Path(f"/dev/video{self.source}" if self.source.isdigit() else self.source)
        if not path.exists():
            return "no such camera; plug it in, and see `ls /dev/video*`"
        if not os.access(path, os.R_OK | os.W_OK):
            return "not allowed; add the user to the group video and log in again"
        return (
            "gives no pictures; another program may have it, or it is not the camera's first node"
        )

    def _describe(self, capture: cv2.VideoCapture) -> str:
        width, height = (
            round(capture.get(p)) for p in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT)
        )
        return f"{self.source}, {width} x {height} px"

    def _read_pictures(self, capture: cv2.VideoCapture) -> None:
        """Grab all pictures of the camera and deliver one per period."""
        period = 1.0 / self.rate
        due = float("-inf")
        while not self._stopping.is_set():
            if not capture.grab():
                raise DeviceError(
                    f"{self.source}: no picture for {READ_TIMEOUT:.0f} s; check its plug and supply"
                )
            stamp = now()
            if stamp >= due - MAX_EARLINESS * period:
                # Keep the rhythm, unless a period was missed.
                due = max(due, stamp - period) + period
                self._deliver_picture(capture, stamp)

    def _deliver_picture(self, capture: cv2.VideoCapture, stamp: float) -> None:
        good, picture = capture.retrieve()
        if good:
            good, data = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, self.quality])
        if not good:
            self._count("corrupt")
            return
        self._deliver(Image(stamp, "jpeg", data.tobytes()), now())
