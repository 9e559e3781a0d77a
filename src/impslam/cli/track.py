"""`imp track`: the robot's true path from an overhead camera's video."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from impslam.cli import console
from impslam.cli.console import Common, RequiredOutput
from impslam.cli.progress import StageBars, display
from impslam.errors import ConfigError

if TYPE_CHECKING:
    from impslam.overhead.setup import Setup
    from impslam.overhead.track import Tracked
    from impslam.types import Array


def track(
    video: Path,
    /,
    *,
    output: RequiredOutput,
    setup: Path | None = None,
    start: float | None = None,
    common: Common | None = None,
) -> None:
    """Track the marker on a robot in a video, and write its path with covariances.

    Beside TRUTH.tum it writes TRUTH.csv (poses with covariances), TRUTH.landmarks.csv (cylinders with
    discs) and TRUTH.png (the track over the scene). Frames without the marker have no pose.

    Parameters
    ----------
    video
        Video of the overhead camera, in any format that ffmpeg reads.
    output
        TUM file to write the path to.
    setup
        TOML file of measurements: board, floor, marker, discs. Default: the one beside the video.
    start
        Time of the first frame on the robot's clock, s. Default: that of the setup.
    """
    from impslam.evaluation.landmark_files import landmarks_path
    from impslam.overhead.setup import load_setup
    from impslam.overhead.track import track as track_marker
    from impslam.paths import keep_inputs

    quiet = common is not None and common.quiet
    if output.suffix.lower() != ".tum":
        raise ConfigError(f"{output}: the path is written as a TUM file; give -o NAME.tum")
    if not video.is_file():
        raise ConfigError(f"{video}: no such video; check the path")
    setup_file = setup or video.with_suffix(".toml")
    beside = [output.with_suffix(".csv"), output.with_suffix(".png"), landmarks_path(output)]
    keep_inputs([video, setup_file], [output, *beside])
    loaded = load_setup(setup_file)
    if start is not None:
        loaded = loaded.model_copy(update={"start": start})
    with display(quiet) as progress:
        tracked = track_marker(video, loaded, setup_file.parent, StageBars(progress, "track"))
    _write(output, tracked, loaded)
    if not quiet:
        _show(tracked, loaded)
        console.echo(f"truth: {output}, {output.with_suffix('.csv')}")
        console.echo(f"picture: {output.with_suffix('.png')}")


def _write(output: Path, tracked: Tracked, setup: Setup) -> None:
    import numpy as np

    from impslam.evaluation.landmark_files import landmarks_path, write_true_landmarks
    from impslam.evaluation.overhead_plot import draw_track
    from impslam.evaluation.tum import write_tum
    from impslam.observers.map_files import write_path_table
    from impslam.types import TrueLandmark

    output.parent.mkdir(parents=True, exist_ok=True)
    poses, covariances = tracked.found.poses, tracked.found.covariances
    write_tum(output, np.column_stack((tracked.stamps, poses)))
    write_path_table(output.with_suffix(".csv"), tracked.stamps, poses, covariances)
    marks = [
        TrueLandmark(f"cylinder {n}", "cylinder", found.centre, {"radius": found.radius})
        for n, found in enumerate(tracked.cylinders, 1)
    ]
    if marks:
        write_true_landmarks(landmarks_path(output), marks)
    picture = draw_track(tracked, setup)
    picture.savefig(output.with_suffix(".png"), dpi=130, metadata={"Software": None})


def _show(tracked: Tracked, setup: Setup) -> None:
    """Print what was found, its uncertainty, and what was not found."""
    import numpy as np

    calibration, found = tracked.calibration, tracked.found
    position, shared = (
        1e3 * float(np.sqrt(np.median(np.trace(c[:, :2, :2], axis1=1, axis2=2))))
        for c in (found.covariances, found.shared)
    )
    heading = np.degrees(np.sqrt(np.median(found.covariances[:, 2, 2])))
    points = len(setup.floor.points) - len(tracked.unseen)
    lens = f"{calibration.board_rms:.2f} px from {calibration.views} views of the board"
    facts = {
        "poses": f"{len(tracked.stamps)}",
        "hidden": _times(tracked.hidden),
        "unfit": _times(tracked.unfit),
        "lens": lens if calibration.views else "from the measured points only",
        "floor": f"{calibration.ground_rms:.2f} px from {points} points",
        "corners": f"{found.sigma:.2f} px",
        "position error": f"{position:.1f} mm, of which calibration and height {shared:.1f} mm",
        "heading error": f"{heading:.2f} deg",
    }
    if tracked.unseen:
        facts["floor"] += f"; not seen: {', '.join(map(str, tracked.unseen))}"
    console.show_facts(facts)
    if (odd := calibration.odd_point) is not None:
        text = (
            "they deviate from the video by more than floor.sigma explains, so the stated errors are too "
            f"small; most at x {odd[0]:g} m, y {odd[1]:g} m: correct what is wrong, or increase floor.sigma"
        )
        console.show_finding("floor.points", text, harmful=True)
    for number, cylinder in enumerate(tracked.cylinders, 1):
        x, y = cylinder.centre
        sigma = 1e3 * float(np.sqrt(np.trace(cylinder.covariance)))
        console.echo(
            f"cylinder {number}: x {x:.3f}  y {y:.3f}  radius {cylinder.radius:.3f} m, ± {sigma:.1f} mm"
        )


def _times(stamps: Array) -> str:
    """Describe in how many frames, and when."""
    if not len(stamps):
        return "none"
    return f"{len(stamps)} frames: {', '.join(_spans(stamps.tolist()))}"


def _spans(stamps: Sequence[float]) -> list[str]:
    """Return stamps as time spans, joined over gaps of up to a second."""
    spans = [[stamps[0], stamps[0]]]
    for stamp in stamps[1:]:
        if stamp - spans[-1][1] > 1.0:
            spans.append([stamp, stamp])
        spans[-1][1] = stamp
    texts = [f"{a:.2f} s" if a == b else f"{a:.2f} to {b:.2f} s" for a, b in spans]
    return texts if len(texts) <= 5 else [*texts[:4], "..."]
