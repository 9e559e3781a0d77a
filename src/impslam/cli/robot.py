"""`imp robot`: serve a page to drive a robot, real or virtual, and to record and map."""

from __future__ import annotations

import getpass
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import App, Parameter

from impslam.cli import console
from impslam.cli.console import Common, Flag, Repeatable, SimulationSeed, Whole
from impslam.cli.replay import need_web
from impslam.errors import ConfigError, ImpError
from impslam.platform.station.service import unit
from impslam.platform.station.watchdog import Watchdog

if TYPE_CHECKING:
    from impslam.platform.console.session import Right
    from impslam.platform.station.station import Station
    from impslam.platform.virtual.process import VirtualRobot

app = App(name="robot")

Address = Annotated[
    str, Parameter(help="Address to listen on. Other than loopback requires a password.")
]
Port = Annotated[Whole, Parameter(help="TCP port of the page.")]
RobotPath = Annotated[Path, Parameter(name=["--config", "-c"], help="The robot file (TOML).")]


@Parameter(name="*")
@dataclass(frozen=True, slots=True)
class PageOptions:
    """Where the page is served.

    Parameters
    ----------
    names
        Another host name of the robot, e.g. robot.example.org.
    certificate
        TLS certificate (PEM). Default: a generated one.
    key
        Private key of the certificate (PEM).
    """

    host: Address = "127.0.0.1"
    port: Port = 8080
    names: Annotated[Repeatable, Parameter(name="--name")] = ()
    certificate: Path | None = None
    key: Path | None = None


@Parameter(name="*")
@dataclass(frozen=True, slots=True)
class VirtualOptions:
    """Options of the virtual robot.

    Parameters
    ----------
    virtual
        Use a virtual robot: emulated devices, with their real protocols, in a simulated world.
    world
        The virtual robot's world (see `imp list worlds`) or a TOML file.
    seed
        Seed of the virtual robot's noise.
    gps
        Give the virtual robot a GNSS receiver under open sky.
    speed_control
        Let the virtual autopilot control the wheel speeds. Default: commands set the motors directly.
    """

    virtual: Flag = False
    world: str = "arena"
    seed: SimulationSeed = 0
    gps: Flag = False
    speed_control: Flag = False


@app.default
def robot(
    *,
    config: RobotPath | None = None,
    virtual: VirtualOptions | None = None,
    folder: Path | None = None,
    record: Flag = False,
    map_: Annotated[Flag, Parameter(name="--map")] = False,
    page: PageOptions | None = None,
    common: Common | None = None,
) -> None:
    """Serve the robot's page: drive, record and map live.

    Parameters
    ----------
    folder
        Folder for logs and maps. Default: that of the robot file, or ./logs.
    record
        Start recording at once.
    map_
        Start mapping at once.
    """
    need_web()
    from impslam.platform.console.model import Model  # needs the extra
    from impslam.platform.console.server import ServerSettings, allowed, listening, serve

    page = page or PageOptions()
    settings = ServerSettings(page.host, page.port, page.certificate, page.key, names=page.names)
    echo = discard if common is not None and common.quiet else console.echo
    allowed(settings)
    with (
        listening(settings) as listener,  # before anything moves, in case the port is taken
        running_station(config, virtual or VirtualOptions(), folder) as (station, title, imp),
    ):
        station.begin(record=record, map_=map_)
        heartbeat = Heartbeat()
        with Watchdog(lambda: heartbeat.alive() and station.drive_control.alive):
            model = Model(title, station.view, station=station, virtual=imp)
            serve(model, settings, ready=echo, beat=heartbeat.beat, listener=listener)
    echo(f"stopped; logs are in {station.folder}")


@app.command(
    help=console.help_text(
        "Set the drive password, or with --watch the watch password. Type it twice, or pipe it to stdin.",
        "robot password",
        "",
        "--watch",
    )
)
def password(*, watch: Flag = False, common: Common | None = None) -> None:
    """Set the drive password, or with --watch the watch password.

    Parameters
    ----------
    watch
        Set the password of users who may only watch.
    """
    from impslam.platform.console.accounts import Accounts  # not needed to serve

    right: Right = "watch" if watch else "drive"
    accounts = Accounts()
    accounts.set(right, _new_password(right))
    echo = discard if common is not None and common.quiet else console.echo
    echo(f"{accounts.path}: set the password to {right}; all sessions are logged out")


@app.command(
    help=console.help_text(
        "Print a systemd unit that starts the robot on boot.",
        "robot service",
        "-c robot.toml | sudo tee /etc/systemd/system/imp.service",
    )
)
def service(
    *,
    config: RobotPath,
    user: str | None = None,
    host: Address = "0.0.0.0",  # noqa: S104  # must be reachable; a password protects it
    port: Port = 8443,
    common: Common | None = None,
) -> None:
    """Print a systemd unit that starts the robot on boot.

    Parameters
    ----------
    user
        The user to run it as. Default: the current user.
    """
    del common
    from impslam.platform.station.robot_file import load_robot

    chosen = load_robot(config)
    program, folder = Path(sys.executable).with_name("imp"), chosen.folder.resolve()
    # The folder of the robot file may be relative to this folder; the service runs in another one.
    arguments = ["robot", "-c", str(config.resolve()), "--folder", str(folder)]
    arguments += ["--host", host, "--port", str(port)]
    console.echo(unit(program, user or getpass.getuser(), folder, arguments))


class Heartbeat:
    """The heartbeat of the page's server."""

    def __init__(self) -> None:
        self._last = time.monotonic()

    def beat(self) -> None:
        """Record a beat."""
        self._last = time.monotonic()

    def alive(self) -> bool:
        """Return whether there was a beat within the last 5 s (50 periods)."""
        return time.monotonic() - self._last < 5.0


def discard(line: str) -> None:
    """Print nothing."""


@contextmanager
def running_station(
    config: Path | None, options: VirtualOptions, folder: Path | None
) -> Iterator[tuple[Station, str, VirtualRobot | None]]:
    """Yield a running station, the robot's name, and the virtual robot; stop all on exit."""
    from impslam.platform.station.station import Station  # numba takes a second to load

    if config is None and not options.virtual:
        raise ConfigError(
            "no robot given; name its file with -c robot.toml (see docs/robot-guide.md), or try "
            "`imp robot --virtual`"
        )
    from impslam.platform.station.robot_file import RobotFile, load_robot

    chosen = RobotFile() if config is None else load_robot(config, virtual=options.virtual)
    imp: VirtualRobot | None = None
    with ExitStack() as stack:
        if options.virtual:
            from impslam.platform.virtual import process  # needs the extra
            from impslam.platform.virtual.truth import TruthFollower

            virtual = process.VirtualRobot(
                options.world,
                options.seed,
                gps=options.gps,
                speed_control=options.speed_control,
            )
            imp = stack.enter_context(virtual)
            chosen = chosen.model_copy(update={"devices": imp.devices()})
        station = Station(
            chosen.make_devices(),
            chosen.preset,
            folder or chosen.folder,
            (chosen.max_speed, chosen.max_turn_rate),
            chosen.min_free_disk_mb * 1_000_000,
        )
        stack.callback(station.stop)
        station.start()
        if imp is not None:
            follower = TruthFollower(imp.truth, station.receive)
            stack.callback(follower.stop)
            follower.start()
        yield station, chosen.name, imp


def _new_password(right: str) -> str:
    if not sys.stdin.isatty():
        return sys.stdin.readline().rstrip("\n")
    first = getpass.getpass(f"new password to {right}: ")
    if first != getpass.getpass("again: "):
        raise ImpError("the passwords differ; nothing was changed, try again")
    return first
