"""`imp robot`: on the robot, or on a virtual one: drive, record and map from a page it serves."""

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
from impslam.cli.console import Common, Flag
from impslam.cli.replay import need_web
from impslam.errors import ConfigError, ImpError
from impslam.platform.station.service import unit
from impslam.platform.station.watchdog import Watchdog

if TYPE_CHECKING:
    from impslam.platform.console.model import Fault
    from impslam.platform.console.session import Right
    from impslam.platform.station.station import Station

app = App(name="robot")

Address = Annotated[str, Parameter(help="Address to listen on. Beyond loopback needs a password.")]
Port = Annotated[int, Parameter(help="TCP port of the page.")]
RobotPath = Annotated[Path, Parameter(name=["--config", "-c"], help="The robot file (TOML).")]


@Parameter(name="*")
@dataclass(frozen=True, slots=True)
class Serving:
    """Where the page is served.

    Parameters
    ----------
    names
        A further name that the robot is reached by, e.g. robot.example.org.
    certificate
        TLS certificate, PEM. Default: one is made.
    key
        Its key, PEM.
    """

    host: Address = "127.0.0.1"
    port: Port = 8080
    names: Annotated[
        tuple[str, ...], Parameter(name="--name", negative="", show_default=False)
    ] = ()
    certificate: Path | None = None
    key: Path | None = None


@Parameter(name="*")
@dataclass(frozen=True, slots=True)
class Simulated:
    """A robot that is not there.

    Parameters
    ----------
    virtual
        Use a virtual robot: emulators that speak the devices' own bytes, in a simulated world.
    world
        The virtual robot's world (arena, corridor, room) or a TOML file.
    seed
        Seed of the virtual robot's noise.
    gps
        The virtual robot has a GNSS receiver, as under open sky.
    speed_control
        The virtual autopilot controls the speed of the wheels; else the motors turn as they are told.
    """

    virtual: Flag = False
    world: str = "arena"
    seed: int = 0
    gps: Flag = False
    speed_control: Flag = False


@app.default
def robot(
    *,
    config: RobotPath | None = None,
    simulated: Simulated | None = None,
    folder: Path | None = None,
    record: Flag = False,
    map_: Annotated[bool, Parameter(name="--map", negative="", show_default=False)] = False,
    serving: Serving | None = None,
    common: Common | None = None,
) -> None:
    """Serve the robot's page: drive, record and map live.

    Parameters
    ----------
    folder
        Where logs and maps are kept. Default: the robot file's, or ./logs.
    record
        Begin to record at once.
    map_
        Begin to map at once.
    """
    need_web()
    from impslam.platform.console.model import Model  # needs the extra
    from impslam.platform.console.server import ServerSettings, allowed, listening, serve

    where = serving or Serving()
    settings = ServerSettings(
        where.host, where.port, where.certificate, where.key, names=where.names
    )
    say = ignore if common is not None and common.quiet else console.say
    allowed(settings)
    with (
        listening(settings) as listener,  # before anything moves: another robot may be on its port
        running_station(config, simulated or Simulated(), folder) as (station, title, fault),
    ):
        station.begin(record=record, map_=map_)
        pulse = Pulse()
        with Watchdog(lambda: pulse.alive() and station.helm.alive):
            model = Model(title, station.view, station=station, fault=fault)
            serve(model, settings, ready=say, beat=pulse.beat, listener=listener)
    say(f"stopped; logs are in {station.folder}")


@app.command(
    help=console.described(
        "Set the password for driving (or for watching), asked for twice, or read from stdin.",
        "robot password",
        "",
        "--watch",
    )
)
def password(*, watch: Flag = False, common: Common | None = None) -> None:
    """Set the password for driving, or for watching.

    Parameters
    ----------
    watch
        Set the password of those who may only watch.
    """
    from impslam.platform.console.accounts import Accounts  # not needed to serve

    right: Right = "watch" if watch else "drive"
    accounts = Accounts()
    accounts.set(right, _new_password(right))
    say = ignore if common is not None and common.quiet else console.say
    say(f"the password to {right} is set in {accounts.path}; all sessions end")


@app.command(
    help=console.described(
        "Print a systemd unit that starts the robot on boot.",
        "robot service",
        "-c robot.toml | sudo tee /etc/systemd/system/imp.service",
    )
)
def service(
    *,
    config: RobotPath,
    user: str | None = None,
    host: Address = "0.0.0.0",  # noqa: S104  # a robot is there to be reached; a password guards it
    port: Port = 8443,
    common: Common | None = None,
) -> None:
    """Print a systemd unit that starts the robot on boot.

    Parameters
    ----------
    user
        The user it runs as. Default: you.
    """
    del common
    from impslam.platform.station.robot_file import load_robot

    chosen = load_robot(config)
    program = Path(sys.executable).with_name("imp")
    arguments = ["robot", "-c", str(config.resolve()), "--host", host, "--port", str(port)]
    console.say(unit(program, user or getpass.getuser(), chosen.folder.resolve(), arguments))


class Pulse:
    """Whether the page's server still beats."""

    def __init__(self) -> None:
        self._last = time.monotonic()

    def beat(self) -> None:
        """Live."""
        self._last = time.monotonic()

    def alive(self) -> bool:
        """Tell whether it has beaten within 5 s: fifty beats."""
        return time.monotonic() - self._last < 5.0


def ignore(line: str) -> None:
    """Say nothing."""


@contextmanager
def running_station(
    config: Path | None, simulated: Simulated, folder: Path | None
) -> Iterator[tuple[Station, str, Fault | None]]:
    """Give a running station, the robot's name, and a virtual one's faults; at the end all stops."""
    from impslam.platform.station.station import Station  # numba takes a second to load

    if config is None and not simulated.virtual:
        raise ConfigError(
            "no robot: name its file with -c robot.toml (docs/robot-guide.md shows one), or try "
            "`imp robot --virtual`"
        )
    from impslam.platform.station.robot_file import RobotFile, load_robot

    chosen = RobotFile() if config is None else load_robot(config)
    fault: Fault | None = None
    with ExitStack() as stack:
        if simulated.virtual:
            from impslam.platform.virtual.process import VirtualRobot  # needs the extra
            from impslam.platform.virtual.truth import TruthFollower

            virtual = VirtualRobot(
                simulated.world,
                simulated.seed,
                gps=simulated.gps,
                speed_control=simulated.speed_control,
            )
            imp = stack.enter_context(virtual)
            chosen = chosen.model_copy(update={"devices": imp.devices()})
            fault = imp.fault
        station = Station(
            chosen.make_devices(),
            chosen.preset,
            folder or chosen.folder,
            (chosen.max_speed, chosen.max_turn_rate),
            chosen.disk_floor_mb * 1_000_000,
        )
        stack.callback(station.stop)
        station.start()
        if simulated.virtual:
            follower = TruthFollower(imp.truth, station.receive)
            stack.callback(follower.stop)
            follower.start()
        yield station, chosen.name, fault


def _new_password(right: str) -> str:
    if not sys.stdin.isatty():
        return sys.stdin.readline().rstrip("\n")
    first = getpass.getpass(f"new password to {right}: ")
    if first != getpass.getpass("again: "):
        raise ImpError("the two passwords differ; nothing was changed, try again")
    return first
