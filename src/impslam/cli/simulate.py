"""`imp simulate`: write the log and the ground truth of a simulated drive."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

from impslam.cli import console
from impslam.cli.console import Common, Repeatable, RequiredOutput, SimulationSeed
from impslam.cli.progress import display, ticker
from impslam.errors import ConfigError

if TYPE_CHECKING:
    from impslam.simulation.robot import SimulatedRobot
    from impslam.simulation.world import World
    from impslam.types import Message, TruePose


def simulate(
    world: str,
    /,
    *,
    output: RequiredOutput,
    seed: SimulationSeed = 0,
    robot: Path | None = None,
    settings: Annotated[Repeatable, Parameter(name="--set")] = (),
    camera: Path | None = None,
    common: Common | None = None,
) -> None:
    """Drive a simulated robot through a world and write the log with its ground truth.

    Beside LOG.mcap it writes LOG.truth.tum (true poses at the scans' stamps) and LOG.landmarks.csv;
    with --camera NAME.mp4 also an overhead camera's video, its setup NAME.toml and pictures of a
    calibration board in NAME.board, for `imp track`.

    Parameters
    ----------
    world
        A built-in world (see `imp list worlds`) or a TOML file.
    output
        MCAP file to write the log to.
    seed
        Random seed; the same seed gives identical files.
    robot
        A TOML file with differences from the thesis's robot: tables encoders, lidar, imu, camera,
        overhead.
    settings
        Override a parameter of the robot: --set lidar.rate=5. `imp list simulated-robot` lists them.
    camera
        Also film the drive with an overhead camera, to this video file (.mp4, .avi, .mkv).
    """
    from impslam.evaluation.landmark_files import landmarks_path
    from impslam.paths import keep_inputs
    from impslam.simulation.world import load_world

    if output.suffix != ".mcap":
        raise ConfigError(f"{output}: the file name must end in .mcap")
    beside = [truth_path(output), landmarks_path(output)]
    filmed = [] if camera is None else [camera, camera.with_suffix(".toml")]
    keep_inputs([Path(world), robot], [output, *beside, *filmed])
    if output.exists() and not beside[0].exists():
        raise ConfigError(
            f"{output}: exists and is not a simulated log ({beside[0].name} is not beside it); "
            "give another -o"
        )
    quiet = common is not None and common.quiet
    chosen = load_world(world)
    driven = load_robot(robot, settings)
    with display(quiet) as progress:
        if camera is not None:  # first, because it rejects worlds that it cannot film
            film(chosen, driven, camera, seed, progress)
        scans = write_log(chosen, output, seed, progress, driven)
    if not quiet:
        console.echo(f"{output}: {scans} scans in world {chosen.name!r}, seed {seed}")
        console.echo(f"truth: {truth_path(output)}, {landmarks_path(output)}")
        if camera is not None:
            console.echo(f"video: {camera}; camera setup: {camera.with_suffix('.toml')}")


def film(world: World, robot: SimulatedRobot, path: Path, seed: int, progress: Any = None) -> None:
    """Write the video of an overhead camera and its setup for `imp track`."""
    from impslam.simulation.drive import drive
    from impslam.simulation.overhead_files import write_film
    from impslam.simulation.scene import Scene

    driven = drive(world.robot)
    tick = ticker(progress, "filming", driven.duration)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_film(path, robot.overhead, Scene(world), driven, robot.start_time, seed, tick)


def load_robot(file: Path | None = None, settings: Sequence[str] = ()) -> SimulatedRobot:
    """Return the robot of a TOML file, or the thesis's robot, with settings "key=value" applied.

    The value "none" removes a device.

    Raises
    ------
    ConfigError
        If a parameter is not valid, or the file cannot be read.
    """
    from pydantic import ValidationError

    from impslam.component import explain
    from impslam.config import merge
    from impslam.settings import parse_setting
    from impslam.simulation.robot import SimulatedRobot

    table = {} if file is None else _read_table(file)
    for setting in settings:
        table = merge(table, parse_setting(setting))
    devices = {name: None if part == "none" else part for name, part in table.items()}
    try:
        return SimulatedRobot(**devices)
    except ValidationError as error:
        where = "" if file is None else f"{file}: "
        raise ConfigError(where + explain(error, "", SimulatedRobot.model_fields)) from None


def _read_table(file: Path) -> dict[str, Any]:
    from impslam import toml
    from impslam.paths import read_text

    return toml.parse(read_text(file, "check --robot", ConfigError), str(file))


def truth_path(log: Path) -> Path:
    """Return the path of a log's true poses."""
    return log.with_name(f"{log.stem}.truth.tum")


def write_log(
    world: World, log: Path, seed: int, progress: Any = None, robot: SimulatedRobot | None = None
) -> int:
    """Write a simulated log and its truth; return the number of scans."""
    import numpy as np

    from impslam.cli.simulated_config import config_of
    from impslam.evaluation.landmark_files import landmarks_path, write_true_landmarks
    from impslam.evaluation.tum import write_tum
    from impslam.paths import written
    from impslam.simulation.drive import drive
    from impslam.simulation.robot import SimulatedRobot
    from impslam.simulation.simulate import simulate as messages
    from impslam.sources.recording import McapWriter

    # Planning the drive takes time, so its duration is computed only if the progress is shown.
    duration = 0.0 if progress is None else drive(world.robot).duration
    tick = ticker(progress, "simulating", duration)
    with written(log, "free disk space or give another -o"):
        log.parent.mkdir(parents=True, exist_ok=True)
        with McapWriter(log, config_of(robot or SimulatedRobot())) as writer:
            truth = list(_recorded(messages(world, robot, seed), writer.write, tick))
    with written(truth_path(log), "free disk space or give another -o"):
        write_tum(truth_path(log), np.array([[true.stamp, *true.pose] for true in truth]))
    with written(landmarks_path(log), "free disk space or give another -o"):
        write_true_landmarks(landmarks_path(log), world.landmarks())
    return len(truth)


def _recorded(
    messages: Iterable[Message], write: Callable[[Message], None], tick: Callable[[float], None]
) -> Iterator[TruePose]:
    """Write every message; yield the true pose at each scan's stamp."""
    from impslam.types import LaserScan, TruePose

    latest: dict[float, TruePose] = {}
    for message in messages:
        write(message)
        if isinstance(message, TruePose):
            latest[message.stamp] = message
        elif isinstance(message, LaserScan):
            yield latest[message.stamp]
            latest = {stamp: pose for stamp, pose in latest.items() if stamp > message.stamp}
            tick(message.stamp)
