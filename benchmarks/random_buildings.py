"""Random robots in random buildings: errors, lost scans and calibration of the covariances.

    python benchmarks/random_buildings.py --seeds 0 100               # 5 minutes on 2 cores
    python benchmarks/random_buildings.py --seeds 0 100 --lost 0.3    # 30 % of the beams lost
    python benchmarks/random_buildings.py --seeds 0 50 --cameras      # depth cameras instead of lidars
    python benchmarks/random_buildings.py --seeds 0 40 --turn-rate 2.5    # robots that turn fast

A building has 2 to 4 rows of 2 to 4 rooms or corridors, with doors, furniture and people who walk in the
rooms. The robot visits all of them, with one of six lidars, mounted anywhere and at any angle, and wheels
of any size, with noise of 1 or 2 cm per root metre, slip of up to 15 % in turns, and radii and a track that
are wrong by up to 1 and 6 %. The config states the nominal mount, radius and track, and nothing else. One
drive in four has no odometry.

For each lidar: the drives, the median and the worst RMS distance of the path from the truth after
alignment, the share of scans that are LOST and TRACKING, and the share of the TRACKING poses of the live
path that are inside their 99 % ellipse.
"""

from __future__ import annotations

import argparse
import math
import tempfile
from collections import defaultdict
from collections.abc import Iterator
from functools import partial
from itertools import pairwise
from multiprocessing import get_context
from pathlib import Path
from typing import NamedTuple

import numpy as np

from impslam.evaluation.trajectory import associate, ate
from impslam.geometry.angles import wrap
from impslam.geometry.chi_square import GATE_3D_99
from impslam.geometry.se2 import between, compose
from impslam.health import LOST, TRACKING, Health
from impslam.map import Keyframe, Map, PathRows, Revision, Track
from impslam.observers.base import Observer, Outcome
from impslam.run import run
from impslam.simulation.robot import Lidar, SimulatedRobot, WheelEncoders
from impslam.simulation.simulate import simulate
from impslam.simulation.world import World
from impslam.sources.recording import McapWriter
from impslam.types import Array, TruePose

TURN_ACCELERATION = 15.0  # rad/s^2, of robots that turn fast: a turn begins within a sweep
CLEARANCE = 0.55  # m from the middle of the robot's path to furniture
LIDARS = {
    "120 beams over 360°, 8 m, 7 Hz": Lidar(
        beams=120, angle_min=-math.pi, angle_step=math.tau / 120, beam_time=0.1 / 120, rate=7.0,
        range_max=8.0, sigma=0.02,
    ),
    "181 beams over 180°, 30 m, 5 Hz": Lidar(
        beams=181, angle_min=-math.pi / 2, angle_step=math.radians(1.0), beam_time=1e-5, rate=5.0,
        range_max=30.0, sigma=0.01,
    ),
    "360 beams over 360°, 3.5 m, 5 Hz": Lidar(
        beams=360, angle_min=0.0, angle_step=math.tau / 360, beam_time=0.2 / 360, rate=5.0,
        range_max=3.5, sigma=0.01, sigma_rate=0.01,
    ),
    "682 beams over 240°, 5.6 m, 10 Hz": Lidar(),
    "720 beams over 360°, 12 m, 10 Hz": Lidar(
        beams=720, angle_min=-math.pi, angle_step=math.tau / 720, beam_time=0.1 / 720,
        range_max=12.0, sigma=0.01, sigma_rate=0.01,
    ),
    "1081 beams over 270°, 30 m, 20 Hz": Lidar(
        beams=1081, angle_min=-math.radians(135.0), angle_step=math.radians(0.25), beam_time=1.7e-5,
        rate=20.0, range_max=30.0, sigma=0.01,
    ),
}  # fmt: skip
CAMERAS = {
    "depth camera, 57°, 5 m, 10 Hz": Lidar(
        beams=320, angle_min=-math.radians(28.5), angle_step=math.radians(57.0) / 319, beam_time=0.0,
        range_min=0.45, range_max=5.0, sigma=0.004, sigma_rate=0.008,
    ),
    "depth camera, 57°, 10 m, 15 Hz": Lidar(
        beams=640, angle_min=-math.radians(28.5), angle_step=math.radians(57.0) / 639, beam_time=0.0,
        rate=15.0, range_min=0.45, range_max=10.0, sigma=0.004, sigma_rate=0.01,
    ),
    "depth camera, 86°, 8 m, 15 Hz": Lidar(
        beams=424, angle_min=-math.radians(43.0), angle_step=math.radians(86.0) / 423, beam_time=0.0,
        rate=15.0, range_min=0.3, range_max=8.0, sigma=0.004, sigma_rate=0.01,
    ),
}  # fmt: skip


class Room(NamedTuple):
    """A free rectangle, from low to high x and y."""

    low: tuple[float, float]
    high: tuple[float, float]

    @property
    def middle(self) -> tuple[float, float]:
        return 0.5 * (self.low[0] + self.high[0]), 0.5 * (self.low[1] + self.high[1])

    def inside(self, rng: np.random.Generator) -> tuple[float, float]:
        """Return a random point with some distance from the walls."""
        x, y = rng.uniform(np.array(self.low) + 0.4, np.array(self.high) - 0.4).tolist()
        return x, y


def random_world(rng: np.random.Generator) -> World:
    """Return a building with a drive through all of its rooms."""
    columns, rows = rng.integers(2, 5, 2).tolist()
    xs, ys = (np.cumsum([0.0, *rng.uniform(3.0, 8.0, n)]) for n in (columns, rows))
    if rng.random() < 0.5:  # one row is a corridor
        row = int(rng.integers(rows))
        ys[row + 1 :] -= ys[row + 1] - ys[row] - rng.uniform(1.6, 2.4)
    cells = [(i, j) for i in range(columns) for j in range(rows)]
    rooms = {
        (i, j): Room((float(xs[i]), float(ys[j])), (float(xs[i + 1]), float(ys[j + 1])))
        for i, j in cells
    }
    tour = list(_visit(cells[0], set(cells), rng))
    joined = {frozenset(pair) for pair in pairwise(tour)}
    joined |= {frozenset((a, b)) for a in cells for b in _beside(a, cells) if rng.random() < 0.2}
    walls, doors = _walls(rooms, joined, rng)
    for _ in range(int(rng.integers(10))):
        near = [cell for cell in _beside(tour[-1], cells) if frozenset((tour[-1], cell)) in joined]
        tour.append(near[int(rng.integers(len(near)))])
    way = [point for a, b in pairwise(tour) for point in _through(rooms, doors, a, b)]
    start = *rooms[tour[0]].middle, rng.uniform(-math.pi, math.pi)
    path = np.array([start[:2], *way])
    boxes, people = [], []
    for _ in range(int(len(cells) * rng.uniform(0.0, 4.0))):
        centre, size = (
            rooms[cells[int(rng.integers(len(cells)))]].inside(rng),
            rng.uniform(0.2, 1.2, 2),
        )
        if _distance(np.array(centre), path) > 0.5 * math.hypot(*size) + CLEARANCE:
            angle = rng.choice([0.0, rng.uniform(0.0, math.pi)])
            boxes.append({"centre": centre, "size": tuple(size.tolist()), "angle": float(angle)})
    for _ in range(int(rng.integers(4)) if rng.random() < 0.6 else 0):
        room = rooms[cells[int(rng.integers(len(cells)))]]
        points = tuple(room.inside(rng) for _ in range(3))
        people.append({"waypoints": points, "start": rng.uniform(0.0, 60.0), "returns": True})
    speeds = {"speed": rng.uniform(0.25, 1.0), "turn_rate": rng.uniform(0.5, 1.5), "lookahead": 0.3}
    drive = {"start": start, "waypoints": way, **speeds}
    return World(name="random", robot=drive, walls=walls, boxes=boxes, people=people)


Cell = tuple[int, int]


def _beside(cell: Cell, cells: list[Cell]) -> list[Cell]:
    steps = ((1, 0), (-1, 0), (0, 1), (0, -1))
    near = [(cell[0] + i, cell[1] + j) for i, j in steps]
    return [one for one in near if one in cells]


def _visit(cell: Cell, left: set[Cell], rng: np.random.Generator) -> Iterator[Cell]:
    """Yield a tour that visits the cells that are left, and returns after each."""
    left.discard(cell)
    yield cell
    near = _beside(cell, [(i, j) for i in range(9) for j in range(9)])
    for k in rng.permutation(len(near)).tolist():
        if near[k] in left:
            yield from _visit(near[k], left, rng)
            yield cell


def _walls(
    rooms: dict[Cell, Room], joined: set[frozenset[Cell]], rng: np.random.Generator
) -> tuple[list[dict], dict[frozenset[Cell], tuple[float, float]]]:
    """Return the walls of all rooms, and the middles of the doors between those that are joined."""
    walls: list[dict] = []
    doors: dict[frozenset[Cell], tuple[float, float]] = {}
    for (i, j), room in rooms.items():
        (x0, y0), (x1, y1) = room
        sides = {(i + 1, j): ((x1, y0), (x1, y1)), (i, j + 1): ((x0, y1), (x1, y1))}
        if i == 0:
            sides[-1, j] = (x0, y0), (x0, y1)
        if j == 0:
            sides[i, -1] = (x0, y0), (x1, y0)
        for other, (a, b) in sides.items():
            pair, ends = frozenset(((i, j), other)), [a, b]
            if other in rooms and pair in joined:
                width, length = rng.uniform(0.9, 1.2), math.dist(a, b)
                at = rng.uniform(0.15 + 0.5 * width, length - 0.15 - 0.5 * width)
                ends = [a, *(_along(a, b, at + half * width) for half in (-0.5, 0.5)), b]
                doors[pair] = _along(a, b, at)
            pieces = zip(ends[::2], ends[1::2], strict=True)
            walls += [{"start": start, "end": end} for start, end in pieces]
    return walls, doors


def _along(a: tuple[float, float], b: tuple[float, float], at: float) -> tuple[float, float]:
    share = at / math.dist(a, b)
    return a[0] + share * (b[0] - a[0]), a[1] + share * (b[1] - a[1])


def _through(
    rooms: dict[Cell, Room], doors: dict[frozenset[Cell], tuple[float, float]], a: Cell, b: Cell
) -> list[tuple[float, float]]:
    """Return the waypoints from room a through the door to the middle of room b."""
    (x, y), (i, j) = doors[frozenset((a, b))], (0.6 * (b[0] - a[0]), 0.6 * (b[1] - a[1]))
    return [(x - i, y - j), (x + i, y + j), rooms[b].middle]


def _distance(point: Array, path: Array) -> float:
    """Return the distance of a point (2,) from a path (n, 2)."""
    begin, along = path[:-1], np.diff(path, axis=0)
    share = ((point - begin) * along).sum(axis=1) / np.maximum((along**2).sum(axis=1), 1e-9)
    nearest = begin + np.clip(share, 0.0, 1.0)[:, None] * along
    return float(np.linalg.norm(nearest - point, axis=1).min())


def random_robot(
    rng: np.random.Generator, lidars: dict[str, Lidar] = LIDARS, lost: float | None = None
) -> tuple[str, SimulatedRobot]:
    """Return the name of a lidar, and a robot with it that loses a share of its beams."""
    name = list(lidars)[int(rng.integers(len(lidars)))]
    yaw = rng.choice([0.0, 0.0, math.pi / 2, math.pi, rng.uniform(-math.pi, math.pi)])
    mount = rng.uniform(-0.3, 0.4), rng.uniform(-0.15, 0.15), float(yaw)
    wheels = WheelEncoders(
        wheel_radius=rng.uniform(0.03, 0.12),
        track=rng.uniform(0.15, 0.6),
        radius_sigma=float(rng.choice([0.001, 0.005, 0.01])),
        track_sigma=float(rng.choice([0.01, 0.03, 0.06])),
        slip_sigma=float(rng.choice([0.0, 0.06, 0.15])),
        noise=float(rng.choice([1e-4, 4e-4])),
    )
    dropout = lidars[name].dropout if lost is None else lost
    lidar = lidars[name].model_copy(update={"mount": mount, "dropout": dropout})
    return name, SimulatedRobot(lidar=lidar, encoders=wheels, imu=None)


def nominal(robot: SimulatedRobot) -> str:
    """Return the text of a config with the nominal mount, radius and track of a robot."""
    return (
        'base = "default"\n[odometry]\nkind = "encoders"\n'
        f"wheel_radius = {robot.encoders.wheel_radius}\ntrack = {robot.encoders.track}\n"
        f"[sensors.lidar]\nmount = {list(robot.lidar.mount)}\n"
    )


class Live(Observer):
    """Stores the pose of each scan as it was when it came, and the health."""

    def __init__(self) -> None:
        self.rows: list[tuple[float, Array, Array]] = []
        self.health: Health | None = None

    def follow(self, track: Track, path: PathRows) -> None:
        columns = path.stamps, path.poses, path.covariances
        self.rows += list(zip(*(column[-len(track.stamps) :] for column in columns), strict=True))

    def revise(self, keyframe: Keyframe, revision: Revision, path: PathRows) -> None:
        if len(path.stamps):
            self.rows.append((path.stamps[-1], path.poses[-1], path.covariances[-1]))

    def finish(self, known: Map, outcome: Outcome) -> None:
        self.health = outcome.health


class Drive(NamedTuple):
    """Results of a drive; `tracking`, `inside` and `lost` are numbers of scans."""

    seed: int
    lidar: str
    rms: float
    scans: int
    tracking: int
    inside: int
    lost: int


def drive(
    seed: int,
    lidars: dict[str, Lidar] = LIDARS,
    lost: float | None = None,
    turn_rate: float | None = None,
) -> Drive:
    """Simulate a drive and map it; see `random_robot`. `turn_rate` in rad/s replaces the robot's own."""
    rng = np.random.default_rng(seed)
    world, (name, robot) = random_world(rng), random_robot(rng, lidars, lost)
    if turn_rate is not None:
        plan = world.robot.model_copy(
            update={"turn_rate": turn_rate, "turn_acceleration": TURN_ACCELERATION}
        )
        world = world.model_copy(update={"robot": plan})
    is_alone, true = rng.random() < 0.25, []
    with tempfile.TemporaryDirectory() as folder:
        log, config = Path(folder) / "log.mcap", Path(folder) / "robot.toml"
        with McapWriter(log) as writer:
            for message in simulate(world, robot, seed):
                if isinstance(message, TruePose):
                    true.append((message.stamp, *message.pose))
                else:
                    writer.write(message)
        config.write_text(nominal(robot))
        live = Live()
        settings = ["odometry.kind=lidar_only"] if is_alone else []
        known = run(log, config, settings, observers=[live])
    truth = np.array(true)
    states = dict(zip(live.health.stamps.tolist(), live.health.states.tolist(), strict=True))
    tracking, inside = _calibration(live, states, truth)
    return Drive(
        seed,
        name + (", alone" if is_alone else ""),
        ate(associate(known.path(), truth)).rmse,
        len(states),
        tracking,
        inside,
        sum(state == LOST for state in states.values()),
    )


def _calibration(live: Live, states: dict[float, int], truth: Array) -> tuple[int, int]:
    """Return the number of live poses that are TRACKING, and of those inside their 99 % ellipse."""
    rows = [row for row in live.rows if states.get(float(row[0])) == TRACKING]
    if not rows:
        return 0, 0
    stamps, poses, covariances = (np.array(column) for column in zip(*rows, strict=True))
    at = np.searchsorted(truth[:, 0], stamps - 1e-9)
    first = np.searchsorted(truth[:, 0], float(live.rows[0][0]) - 1e-9)
    start = np.tile(truth[first, 1:], (len(at), 1))
    expected = compose(np.tile(live.rows[0][1], (len(at), 1)), between(start, truth[at, 1:]))
    error = poses - expected
    error[:, 2] = wrap(error[:, 2])
    chi2 = np.einsum("ki,kij,kj->k", error, np.linalg.inv(covariances), error)
    return len(rows), int((chi2 <= GATE_3D_99).sum())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, nargs=2, default=(0, 100), help="from, to (excluded)")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--lost", type=float, help="share of the beams lost at random")
    parser.add_argument("--cameras", action="store_true", help="depth cameras instead of lidars")
    parser.add_argument("--turn-rate", type=float, help="of all robots, rad/s")
    asked = parser.parse_args()
    lidars = CAMERAS if asked.cameras else LIDARS
    one_drive = partial(drive, lidars=lidars, lost=asked.lost, turn_rate=asked.turn_rate)
    found: dict[str, list[Drive]] = defaultdict(list)
    with get_context("spawn").Pool(asked.jobs) as pool:
        for one in pool.imap_unordered(one_drive, range(*asked.seeds)):
            found[one.lidar].append(one)
            if one.rms > 0.1 or one.lost:
                print(one, flush=True)
    print("\n| lidar | drives | RMS: median, worst | LOST | TRACKING | of these inside 99 % |")
    print("|---|---|---|---|---|---|")
    names = list(CAMERAS if asked.cameras else LIDARS)
    for name in [n for n in (*names, *(f"{n}, alone" for n in names)) if n in found]:
        drives = found[name]
        rms = [one.rms for one in drives]
        scans, tracking, inside, lost = (
            sum(column) for column in zip(*(one[3:] for one in drives), strict=True)
        )
        print(
            f"| {name} | {len(drives)} | {np.median(rms):.3f}, {max(rms):.3f} m | {lost / scans:.1%} | "
            f"{tracking / scans:.1%} | {inside / max(tracking, 1):.1%} |"
        )


if __name__ == "__main__":
    main()
