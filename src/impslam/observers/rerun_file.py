"""Writes a run as a recording for the Rerun viewer (extra `view`)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from impslam.errors import ConfigError, ImpError, in_a_line
from impslam.evaluation.colours import INK, PATH, POINT, SCAN, TRUTH, WALL
from impslam.extras import install
from impslam.geometry.se2 import transform
from impslam.health import Health, describe, state_of
from impslam.map import Map
from impslam.maps.files import MapImage, map_image
from impslam.observers.accuracy import align_truth
from impslam.observers.base import Outcome, require_placed
from impslam.observers.grid_picture import occupancy
from impslam.observers.history import History, health_of
from impslam.observers.map_picture import drawn_path, ellipse, pieces
from impslam.observers.recorder import TruthRecorder
from impslam.types import Array, Landmark

LEVELS = ("INFO", "WARN", "ERROR")
"""Log levels of the states TRACKING, DEGRADED and LOST."""
RADIUS = 0.03
"""Radius of lines and points, m."""


class RerunFile(TruthRecorder):
    """Writes the recording at the end of a run.

    The final grid, path, truth and landmarks are static; the timeline "log" has the robot's pose at each
    scan, the scans of the keyframes, and whether the pose can be trusted.

    Raises
    ------
    ConfigError
        If Rerun is not installed.
    """

    def __init__(self, path: Path) -> None:
        super().__init__()
        try:
            import rerun  # noqa: PLC0415  # an extra, which takes half a second to import
        except ImportError:
            raise ConfigError(
                f"--rerun needs the package rerun-sdk; install it with `{install('view')}`"
            ) from None
        self._path, self._rerun = path, rerun

    def finish(self, known: Map, outcome: Outcome) -> None:
        """Write the recording."""
        require_placed(self._path, known)
        recording = self._rerun.RecordingStream("impslam")
        try:
            recording.save(self._path)
        except (OSError, RuntimeError) as error:
            raise ImpError(f"{self._path}: cannot be written ({in_a_line(error)})") from None
        self._log_map(recording, known, map_image(known.grid(outcome.config["grid"]["resolution"])))
        self._log_truth(recording, History(known, self.path))
        self._log_drive(recording, known, health_of(known, outcome.health))
        recording.flush()
        recording.disconnect()

    def _log_map(self, recording: Any, known: Map, image: MapImage) -> None:
        rr = self._rerun
        rows, columns = image.pixels.shape
        shape = rr.components.ImageFormat(
            width=columns, height=rows, color_model="L", channel_datatype="U8"
        )
        grid = rr.GridMap(
            data=occupancy(image).tobytes(),
            format=shape,
            cell_size=image.resolution,
            translation=[*image.origin, -0.01],
            colormap=rr.components.Colormap.RvizMap,
        )
        recording.log("map/grid", grid, static=True)
        self._log_lines(recording, "map/path", list(pieces(drawn_path(known))), PATH)
        walls = [mark for mark in known.landmarks if mark.end_points is not None]
        points = [mark for mark in known.landmarks if mark.end_points is None]
        self._log_lines(recording, "map/walls", [mark.end_points for mark in walls], WALL, walls)
        self._log_lines(recording, "map/points", [ellipse(mark) for mark in points], POINT, points)

    def _log_truth(self, recording: Any, history: History) -> None:
        aligned = align_truth(history)
        if aligned is not None:
            self._log_lines(recording, "map/truth", [aligned.pairs.truth[:, :2]], TRUTH)

    def _log_lines(
        self,
        recording: Any,
        name: str,
        lines: Sequence[Array | None],
        code: str,
        marks: Sequence[Landmark] = (),
    ) -> None:
        """Log lines (n, 2) m on the ground, labelled with the kinds and numbers of landmarks, if given."""
        flat = [np.column_stack((line, np.zeros(len(line)))) for line in lines if line is not None]
        labels = [f"{mark.kind} {mark.id}" for mark in marks] or None
        style: dict[str, Any] = {
            "colors": [_rgb(code)],
            "radii": [RADIUS],
            "labels": labels,
            "show_labels": False,
        }
        recording.log(name, self._rerun.LineStrips3D(flat, **style), static=True)

    def _log_drive(self, recording: Any, known: Map, health: Health) -> None:
        """Log the robot at each scan, the scans of the keyframes, and changes of health."""
        rr, rows, keyframes = self._rerun, known.rows(), known.keyframes
        anchors, start = known.anchors[known.placed()], float(rows.stamps.min())
        style: dict[str, Any] = {"colors": [_rgb(INK)], "radii": [RADIUS]}
        recording.log("map/robot", rr.Arrows3D(vectors=[[0.4, 0.0, 0.0]], **style), static=True)
        shown = logged = -1
        for k, pose in enumerate(rows.poses):
            recording.set_time("log", duration=float(rows.stamps[k]) - start)
            turn = rr.RotationAxisAngle([0.0, 0.0, 1.0], float(pose[2]))
            place = [float(pose[0]), float(pose[1]), 0.0]
            recording.log("map/robot", rr.Transform3D(translation=place, rotation_axis_angle=turn))
            if anchors[k] != shown:
                shown = int(anchors[k])
                seen = keyframes.points[keyframes.starts[shown] : keyframes.starts[shown + 1]]
                at = transform(keyframes.poses[shown], seen.astype(np.float64))
                flat = np.column_stack((at, np.zeros(len(at))))
                recording.log("map/scan", rr.Points3D(flat, colors=[_rgb(SCAN)], radii=[RADIUS]))
            if health.reasons[k] != logged:
                logged = int(health.reasons[k])
                text = describe(logged, float(health.amounts[k])) or "TRACKING"
                level = LEVELS[state_of(logged)]
                recording.log("health", rr.TextLog(text, level=level))


def _rgb(code: str) -> list[int]:
    """Return "#rrggbb" as numbers from 0 to 255."""
    return list(bytes.fromhex(code.removeprefix("#")))
