"""Complete a config from a log: mounts of sensors, and whether the robot has odometry."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any

from impslam.config import Config, merge
from impslam.errors import SourceError
from impslam.robot import Robot
from impslam.sources.base import Mount, Source
from impslam.types import LaserScan, SatelliteFix, Velocity, WheelAngles

MAX_TILT = math.radians(5.0)
"""rad: beyond it, ranges to walls are more than 0.4 % too long, and beams from a height of 0.2 m hit the
floor within 2.3 m."""
MIN_REPORTED_TILT = math.radians(0.5)
UNKNOWN = Mount(None, origin="not in the log")


def fitted(config: Config, source: Source, *, odometry_is_free: bool) -> Config:
    """Return the config, completed with the mounts from the log.

    The source must be open, or have been open. If `odometry_is_free`, i.e. if the user has not chosen an
    odometry, velocities are used in a log that has no other, and one without any is mapped with the lidar
    alone.

    Raises
    ------
    SourceError
        If a laser is tilted by more than `MAX_TILT`.
    """
    sensors, fixed = dict(config.sensors), []
    for name, stream, mount in _lasers(config.make_robot(), source):
        table = sensors[name]
        is_given = "mount" in table or "upside_down" in table
        if mount.pose is None:
            if not is_given and stream in source.mounts():
                text = f"{source.path}: {mount.origin}; give it with --set sensors.{name}.mount=[x,y,yaw]"
                source.problems.add("unknown mount", text)
            continue
        if not is_given:
            _refuse_tilted(source, name, stream, mount)
            _report_rivals(source, name, stream, mount)
            table = merge(table, {"mount": mount.pose, "upside_down": mount.upside_down})
            sensors[name] = table
        if _matches(mount, table):
            fixed.append(stream)
    source.watch_mounts(fixed)
    changes: dict[str, Any] = {"sensors": sensors, "landmarks": _with_antenna(config, source)}
    if odometry_is_free and _lacks_odometry(config, source):
        kind = _other_odometry(source)
        changes["odometry"] = {"kind": kind}
        if kind == "lidar_only" and (hint := source.unknown_odometry() or _unread_wheels(source)):
            source.problems.add("unknown odometry", f"{source.path}: {hint}")
    return config.model_copy(update=changes)


def choices(config: Config, source: Source) -> str:
    """Describe in one line which streams of a log are read, as what, and how the lasers are mounted.

    The source must be open, or have been open.
    """
    robot = config.make_robot()
    if not source.describes_robot:
        return _by_config(config, robot)
    lasers = list(_lasers(robot, source))
    parts = [
        f"scan {stream} ({_describe_mount(name, mount, config)})" for name, stream, mount in lasers
    ]
    read = {stream for _, stream, _ in lasers}
    parts += [
        f"{other} ({_describe_pose(mount)}, {mount.origin}) "
        + _describe_other(other, mount, lasers)
        for other, mount in sorted(source.mounts().items())
        if other not in read and mount.pose is not None
    ]
    for name, sensor in robot.sensors.items():
        if sensor.consumes is not LaserScan:
            read_as = sensor.stream or source.defaults().get(sensor.consumes)
            is_gnss = sensor.consumes is SatelliteFix and read_as
            where = _describe_antenna(config, _antenna(robot, source)) if is_gnss else ""
            parts.append(f"{name} {read_as or 'finds nothing in the log'}{where}")
    stream = robot.odometry.stream or source.defaults().get(robot.odometry.consumes, "")
    if not robot.odometry.measures_motion:
        parts.append("no odometry: mapped by the lidar alone")
    elif stream:
        parts.append(f"odometry {stream}")
    return "; ".join(parts) or "nothing in this log"


def _describe_other(stream: str, mount: Mount, lasers: Sequence[tuple[str, str, Mount]]) -> str:
    """Describe what a stream of scans is that is not read; one frame is one laser, one base one robot."""
    same = [read for _, read, own in lasers if own.origin == mount.origin]
    if same:
        return f"is from the same laser as {same[0]}; --topic scan={stream} reads it instead"
    bases = {own.base for _, _, own in lasers if own.pose is not None}
    if bases and mount.base not in bases:  # no transform links it to the robot
        return f"is the lidar of another robot, which --topic scan={stream} maps instead"
    if mount.pose == (0.0, 0.0, 0.0):
        return f"is in the robot's own frame, as merged scans are; --topic scan={stream} reads it instead"
    return (
        "is another lidar, added by --set sensors.NAME.kind=lidar2d --set "
        f"sensors.NAME.stream={stream}"
    )


def _by_config(config: Config, robot: Robot) -> str:
    """Describe the streams of a log that does not describe its robot: all is from the config."""
    sensors = [
        f"{sensor.name} {name}"
        + (f" ({_describe_mount(name, UNKNOWN, config)})" if sensor.consumes is LaserScan else "")
        for name, sensor in robot.sensors.items()
    ]
    return "; ".join([*sensors, f"odometry {robot.odometry.name}"])


def _lasers(robot: Robot, source: Source) -> Iterator[tuple[str, str, Mount]]:
    """Yield the name of each lidar in the config, its stream, and its mount according to the log."""
    mounts = source.mounts()
    for name, sensor in robot.sensors.items():
        stream = sensor.stream or source.defaults().get(LaserScan, "")
        if sensor.consumes is LaserScan and stream:
            yield name, stream, mounts.get(stream, UNKNOWN)


def _antenna(robot: Robot, source: Source) -> Mount:
    """Return the mount of the GPS antenna according to the log."""
    for sensor in robot.sensors.values():
        if sensor.consumes is SatelliteFix:
            stream = sensor.stream or source.defaults().get(SatelliteFix, "")
            return source.antennas().get(stream, UNKNOWN)
    return Mount(None)


def _with_antenna(config: Config, source: Source) -> dict[str, dict[str, Any]]:
    """Return the parameters of landmark models, with the log's antenna unless the config has one."""
    found = _antenna(config.make_robot(), source).pose
    if found is None or "antenna" in config.landmarks.get("gps", {}):
        return config.landmarks
    return merge({"gps": {"antenna": found[:2]}}, config.landmarks)


def _describe_antenna(config: Config, in_log: Mount) -> str:
    given = config.landmarks.get("gps", {}).get("antenna")
    if given is None:
        return f" (antenna assumed to be at base_link: {in_log.origin}; set landmarks.gps.antenna)"
    (x, y), origin = given, " from the config"
    if in_log.pose is not None and (x, y) == in_log.pose[:2]:
        origin = f", {in_log.origin}"
    return f" (antenna [{x:.3f} m, {y:.3f} m]{origin})"


def _matches(mount: Mount, table: dict[str, object]) -> bool:
    given = table.get("mount", (0.0, 0.0, 0.0))
    is_same = isinstance(given, list | tuple) and tuple(given) == mount.pose
    return is_same and bool(table.get("upside_down", False)) == mount.upside_down


def _lacks_odometry(config: Config, source: Source) -> bool:
    """Return whether the log lacks odometry of the config's kind, and the tracker can do without."""
    kinds = source.kinds()
    if kinds is None or LaserScan not in kinds or config.tracker["kind"] == "odometry":
        return False
    wanted = config.make_robot().odometry.consumes
    return not any(issubclass(kind, wanted) for kind in kinds)


def _other_odometry(source: Source) -> str:
    """Return the kind of odometry for a log without poses: velocities need no parameter, wheels do."""
    return "velocity" if Velocity in (source.kinds() or ()) else "lidar_only"


def _unread_wheels(source: Source) -> str:
    """Say how wheels are read, which need parameters; "" if the log has none."""
    wheels = source.defaults().get(WheelAngles, "")
    return wheels and (
        f"wheel angles {wheels} are not read: for them set odometry.kind=encoders, "
        "odometry.wheel_radius and odometry.track"
    )


def _refuse_tilted(source: Source, name: str, stream: str, mount: Mount) -> None:
    assert mount.pose is not None
    if mount.tilt > MAX_TILT:
        raise SourceError(
            f"{source.path}: the laser of {stream} is tilted by {math.degrees(mount.tilt):.1f} degrees "
            f"({mount.origin}), and sees the floor or the ceiling; name a level one with --topic "
            "scan=TOPIC, or if the log is wrong, give its mount with "
            f"{_mount_settings(name, mount)}"
        )


def _report_rivals(source: Source, name: str, stream: str, mount: Mount) -> None:
    """Report a mount that the log contradicts, with the settings for the other one."""
    for rival in mount.rivals:
        source.problems.add(
            "contradictory mounts",
            f"{source.path}: the static transform {rival.origin} has different values: by the one that "
            f"is used, the laser of {stream} is at {_describe_pose(mount)}, by another one at "
            f"{_describe_pose(rival)}; if that is right, map with "
            f"{_mount_settings(name, rival)}; let one program publish it",
        )


def _mount_settings(name: str, mount: Mount) -> str:
    """Return the settings for a mount; without the second one, the laser would be upright."""
    assert mount.pose is not None
    x, y, yaw = mount.pose
    pose = f"--set 'sensors.{name}.mount=[{x:.3f},{y:.3f},{yaw:.4f}]'"
    return f"{pose} --set sensors.{name}.upside_down=true" if mount.upside_down else pose


def _describe_mount(name: str, mount: Mount, config: Config) -> str:
    table = config.sensors[name]
    if mount.pose is not None and _matches(mount, table):
        tilted = f", tilted by {math.degrees(mount.tilt):.1f} deg and treated as level"
        note = tilted if mount.tilt > MIN_REPORTED_TILT else ""
        return f"mount {_describe_pose(mount)}{note}, {mount.origin}"
    if "mount" in table or "upside_down" in table:
        own = Mount(tuple(table.get("mount", (0.0, 0.0, 0.0))), table.get("upside_down", False))
        log = "" if mount.pose is None else f"; not {_describe_pose(mount)}, {mount.origin}"
        return f"mount {_describe_pose(own)} from the config{log}"
    return f"mount unknown, assumed to be at base_link: {mount.origin}; set sensors.{name}.mount"


def _describe_pose(mount: Mount) -> str:
    assert mount.pose is not None
    x, y, yaw = mount.pose
    down = ", upside down" if mount.upside_down else ""
    return f"[{x:.3f} m, {y:.3f} m, {math.degrees(yaw):.1f} deg]{down}"
