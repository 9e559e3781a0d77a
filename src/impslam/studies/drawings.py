"""Drawings of the thesis: system, motion model, wall, arena, corridor (Fig. 4, 9, 10, 20 to 28)."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Arc, Circle, FancyBboxPatch, Wedge
from mpl_toolkits.mplot3d.art3d import Poly3DCollection

from impslam.evaluation.colours import INK, PALE, PATH, TRUTH, WALL
from impslam.evaluation.plots import TIGHT, as_svg, new_figure, style
from impslam.simulation.drive import drive
from impslam.simulation.scene import Scene
from impslam.simulation.world import World, load_world
from impslam.studies.map_plot import WALKERS, draw_scene
from impslam.studies.report import Picture, Section, load_text
from impslam.sweeps.job import Job
from impslam.types import Array

HEIGHT = 0.6  # m, of the arena's walls
MAX_RANGE, FIELD = 5.6, 240.0  # m, deg, of the lidar
STAMP = 20.0  # s: time with some people in the drawn part of the corridor
Point = tuple[float, float]


def drawings(job: Job) -> Section:
    """Draw all figures; `job.seeds` is ignored."""
    text = load_text("drawings")
    made = replace(job, processes=1).map(_draw, list(DRAWINGS), "draw")
    pictures = [
        Picture(name, svg, text["captions"][name], "svg")
        for name, svg in zip(DRAWINGS, made, strict=True)
    ]
    return Section("drawings", text["title"], text["text"], pictures=pictures)


def _draw(name: str) -> bytes:
    return as_svg(DRAWINGS[name](), **TIGHT)


def _plain(width: float, height: float) -> tuple[Figure, Any]:
    """Return a figure with axes of equal scale that are not drawn."""
    figure = new_figure(width, height)
    axes = figure.subplots()
    axes.set_aspect("equal")
    axes.set_axis_off()
    return figure, axes


def _arrow(
    axes: Any, start: Point, end: Point, text: str = "", style: str = "->", **more: Any
) -> None:
    """Draw an arrow with a text beside its middle."""
    how = {"color": INK, "lw": 1.2, **more}
    shape = {"arrowstyle": style, "shrinkA": 0, "shrinkB": 0, **how}
    axes.annotate("", end, start, arrowprops=shape)
    if text:
        middle = (0.5 * (start[0] + end[0]), 0.5 * (start[1] + end[1]))
        box = {"fc": "white", "ec": "none", "pad": 1.0}
        axes.text(*middle, text, ha="center", va="center", fontsize=9, color=how["color"], bbox=box)


BOXES: dict[str, tuple[Point, str, bool]] = {
    "wheels": ((0.0, 3.0), "2 encoders MA3\n0 to 5 V per turn", True),
    "imu": ((0.0, 2.0), "IMU, magnetometer\nclimate", True),
    "motors": ((0.0, 1.0), "4 motors", True),
    "autopilot": ((3.0, 2.0), "autopilot\n(micro-controller)", True),
    "lidar": ((6.2, 3.2), "lidar\nURG-04LX", True),
    "camera": ((6.2, 0.8), "camera", True),
    "computer": ((6.2, 2.0), "on-board computer\nimp robot", True),
    "browser": ((9.6, 2.0), "browser: map, joystick", False),
    "desk": ((9.6, 0.8), "imp run: map of the log", False),
}
LINKS = (
    ("wheels", "autopilot", "1 ms"), ("imu", "autopilot", "5 ms"), ("autopilot", "motors", "PWM"),
    ("autopilot", "computer", "UART\n100 Hz"), ("lidar", "computer", "USB, SCIP 2.0, 10 Hz"),
    ("camera", "computer", "HTTP, 5 Hz"), ("computer", "browser", "Wi-Fi\nTLS"),
    ("computer", "desk", "logs"),
)  # fmt: skip
WIDE, HIGH = 2.1, 0.66


def system() -> Figure:
    """Draw the devices of the robot and their links."""
    figure, axes = _plain(9.0, 3.4)
    for (x, y), name, aboard in BOXES.values():
        line: dict[str, Any] = {
            "ec": INK if aboard else PALE,
            "ls": "-" if aboard else "--",
            "fc": "#f6f7f9",
        }
        shape = "round,pad=0.02,rounding_size=0.1"
        corner = (x - 0.5 * WIDE, y - 0.5 * HIGH)
        axes.add_patch(FancyBboxPatch(corner, WIDE, HIGH, boxstyle=shape, lw=1.2, **line))
        axes.text(x, y, name, ha="center", va="center", fontsize=8.5, color=INK)
    for a, b, text in LINKS:
        _arrow(axes, *_edges(BOXES[a][0], BOXES[b][0]), text)
    axes.set(xlim=(-1.2, 10.8), ylim=(0.3, 3.7))
    return figure


def _edges(a: Point, b: Point) -> tuple[Point, Point]:
    """Return the points where the line between the middles of two boxes crosses their edges."""
    dx, dy = b[0] - a[0], b[1] - a[1]
    share = min(
        0.5 * WIDE / abs(dx) if dx else math.inf, (0.5 * HIGH + 0.02) / abs(dy) if dy else math.inf
    )
    return (a[0] + share * dx, a[1] + share * dy), (b[0] - share * dx, b[1] - share * dy)


def motion() -> Figure:
    """Draw the arc of a differential drive."""
    figure, axes = _plain(5.0, 4.4)
    radius, width, turn = 2.2, 1.2, math.radians(50)
    for r, name in ((radius, "l"), (radius + width, "r")):
        axes.add_patch(Arc((0, 0), 2 * r, 2 * r, theta1=0, theta2=50, color=PATH, lw=1.8))
        middle = (r * math.cos(0.5 * turn), r * math.sin(0.5 * turn))
        axes.text(middle[0] + 0.1, middle[1] + 0.05, name, color=PATH, fontsize=12, style="italic")
    base = radius + 0.5 * width
    axes.add_patch(Arc((0, 0), 2 * base, 2 * base, theta1=0, theta2=50, color=PALE, ls="--"))
    for angle in (0.0, turn):
        _robot(axes, (base * math.cos(angle), base * math.sin(angle)), angle + math.pi / 2, width)
        axes.plot([0, base * math.cos(angle)], [0, base * math.sin(angle)], color=PALE, lw=0.8)
    axes.add_patch(Arc((0, 0), 1.4, 1.4, theta1=0, theta2=50, color=INK))
    axes.text(0.8, 0.3, "α", fontsize=12, color=INK)
    _arrow(axes, (0.0, -0.55), (radius, -0.55), "R", "<->")
    _arrow(axes, (radius, -0.85), (radius + width, -0.85), "w", "<->")
    axes.plot(0, 0, "o", ms=4, color=INK)
    axes.set(xlim=(-0.3, 4.1), ylim=(-1.2, 3.4))
    return figure


def _robot(axes: Any, position: Point, heading: float, width: float) -> None:
    """Draw a robot: its axle, two wheels and heading."""
    c, s = math.cos(heading), math.sin(heading)
    for side in (-0.5 * width, 0.5 * width):
        x, y = position[0] - side * s, position[1] + side * c
        axes.plot([x - 0.18 * c, x + 0.18 * c], [y - 0.18 * s, y + 0.18 * s], color=INK, lw=5)
    across = np.array([[-s, c]]) * np.array([[-0.5 * width], [0.5 * width]]) + np.array(position)
    axes.plot(*across.T, color=INK, lw=1.2)
    _arrow(axes, position, (position[0] + 0.5 * c, position[1] + 0.5 * s))


def arena() -> Figure:
    """Draw the arena in perspective and from above."""
    figure = new_figure(8.0, 6.0)
    world, scene = load_world("arena"), Scene(load_world("arena"))
    perspective = figure.add_subplot(1, 2, 1, projection="3d")
    _extrude(perspective, scene)
    above = figure.add_subplot(1, 2, 2)
    draw_scene(above, scene, scene.leaves(0.0), 4.0)
    x, y, heading = world.robot.start
    begin = math.degrees(heading) - 0.5 * FIELD
    reach = Wedge((x, y), MAX_RANGE, begin, begin + FIELD, fc=WALL, alpha=0.07, ec=WALL, lw=1)
    above.add_patch(reach)
    _robot(above, (x, y), heading, 0.4)
    above.set(xlim=(-2.1, 0.8), ylim=(-0.7, 6.5), aspect="equal")
    style(above)
    return figure


def _extrude(axes: Any, scene: Scene) -> None:
    """Draw walls and cylinders with a height."""
    faces = [_upright(row.reshape(2, 2)) for row in scene.segments]
    walls: dict[str, Any] = {"facecolor": "#bec5cd", "edgecolor": INK, "alpha": 0.35, "lw": 0.6}
    axes.add_collection3d(Poly3DCollection(faces, **walls))
    angles = np.linspace(0.0, 2.0 * math.pi, 25)
    for x, y, radius in scene.circles.tolist():
        rim = np.column_stack((x + radius * np.cos(angles), y + radius * np.sin(angles)))
        sides = [_upright(rim[k : k + 2]) for k in range(len(rim) - 1)]
        axes.add_collection3d(Poly3DCollection(sides, facecolor=TRUTH, edgecolor="none"))
    axes.set(xlim=(-3.5, 2.5), ylim=(-0.5, 6.5), zlim=(0.0, HEIGHT), zticks=[])
    axes.set_box_aspect((6.0, 7.0, HEIGHT), zoom=1.25)
    axes.view_init(elev=50.0, azim=-60.0)
    axes.set_axis_off()


def _upright(ends: Array) -> Array:
    """Return the upright rectangle (4, 3) above a line (2, 2)."""
    low, high = np.zeros((2, 1)), np.full((2, 1), HEIGHT)
    return np.vstack([np.hstack([ends, low]), np.hstack([ends, high])[::-1]])


def normal_form() -> Figure:
    """Draw a wall and the foot of its normal."""
    figure, axes = _plain(4.2, 3.6)
    _frame(axes, (0.0, 0.0), 0.0, "map", 3.2)
    alpha, r = math.radians(38), 2.3
    foot = np.array([r * math.cos(alpha), r * math.sin(alpha)])
    _wall(axes, foot, alpha, (-1.9, 2.1))
    axes.plot([0, foot[0]], [0, foot[1]], color=PATH, lw=1.5)
    axes.text(
        0.5 * foot[0] - 0.15, 0.5 * foot[1] + 0.15, "r", color=PATH, fontsize=12, style="italic"
    )
    axes.add_patch(Arc((0, 0), 1.3, 1.3, theta1=0, theta2=38, color=INK))
    axes.text(0.75, 0.22, "α", fontsize=12, color=INK)
    axes.plot(*foot, "o", color=PATH)
    axes.text(foot[0] + 0.12, foot[1] + 0.08, "D", color=PATH, fontsize=12)
    axes.set(xlim=(-0.3, 3.5), ylim=(-0.5, 3.5))
    return figure


def frames() -> Figure:
    """Draw a wall, the robot, and the feet of the normals from both."""
    figure, axes = _plain(5.4, 3.9)
    _frame(axes, (0.0, 0.0), 0.0, "map", 1.2)
    robot, heading = np.array([2.6, -1.0]), math.radians(25)
    _frame(axes, (2.6, -1.0), heading, "base_link", 1.2)
    alpha, r = math.radians(65), 2.6
    normal = np.array([math.cos(alpha), math.sin(alpha)])
    p2, p1 = r * normal, robot + (r - robot @ normal) * normal
    _wall(axes, p2, alpha, (-3.4, 1.2))
    for name, start, foot in (("P2", np.zeros(2), p2), ("P1", robot, p1)):
        axes.plot(*np.array([start, foot]).T, color=PATH, lw=1.5)
        axes.plot(*foot, "o", color=PATH)
        axes.text(foot[0] + 0.05, foot[1] + 0.15, name, color=PATH, fontsize=12)
    axes.text(*(0.5 * (robot + p1) + (0.1, 0.05)), "ρ", color=PATH, fontsize=12)
    axes.text(*(0.5 * p2 + (0.1, 0.0)), "r", color=PATH, fontsize=12, style="italic")
    axes.set(xlim=(-0.4, 4.4), ylim=(-1.5, 3.2))
    return figure


def _frame(axes: Any, origin: Point, heading: float, name: str, length: float) -> None:
    """Draw the axes of a frame."""
    for turn, label in ((0.0, "x"), (0.5 * math.pi, "y")):
        tip = length * math.cos(heading + turn), length * math.sin(heading + turn)
        end = (origin[0] + tip[0], origin[1] + tip[1])
        _arrow(axes, origin, end)
        axes.text(end[0] + 0.06, end[1] + 0.06, label, color=INK, fontsize=9)
    axes.text(origin[0] - 0.1, origin[1] - 0.3, name, color=INK, fontsize=9)


def _wall(axes: Any, foot: Array, alpha: float, extent: tuple[float, float]) -> None:
    """Draw a wall through a point, across a direction."""
    along = np.array([-math.sin(alpha), math.cos(alpha)])
    axes.plot(*(foot + np.outer(extent, along)).T, color=WALL, lw=3, solid_capstyle="round")


def arena_path() -> Figure:
    """Draw the arena and the robot's path in it."""
    figure = new_figure(3.6, 6.6)
    axes, world = figure.subplots(), load_world("arena")
    scene = Scene(world)
    draw_scene(axes, scene, scene.leaves(0.0), 5.0)
    _path(axes, world)
    for circle, mark in zip(scene.circles, world.cylinders, strict=True):
        axes.text(circle[0], circle[1] - 0.3, mark.name, fontsize=7, color=INK, ha="center")
    axes.set(xlim=(-2.0, 0.8), ylim=(-0.7, 6.5), aspect="equal")
    style(axes)
    return figure


def _path(axes: Any, world: World) -> None:
    """Draw the robot's path, with its start and end."""
    driven = drive(world.robot)
    path = driven.at(np.arange(0.0, driven.duration, 0.2))
    axes.plot(*path[:, :2].T, color=TRUTH, lw=1.2)
    axes.plot(*path[0, :2], "o", color=TRUTH, ms=7)
    axes.plot(*path[-1, :2], "s", color=TRUTH, ms=6)


def passages() -> Figure:
    """Draw the corridor with its doors and the paths of people."""
    figure = new_figure(10.0, 4.6)
    axes, world = figure.subplots(), load_world("corridor")
    scene = Scene(world)
    draw_scene(axes, scene, scene.leaves(0.0), 2.4)
    for person in world.people:
        axes.plot(*np.array(person.waypoints).T, color=WALKERS, lw=1.0, ls=(0, (1, 1.5)))
    _path(axes, world)
    axes.set(xlim=(-6.0, 56.0), ylim=(-8.0, 19.0), aspect="equal")
    style(axes)
    return figure


def obstacles() -> Figure:
    """Draw a part of the corridor with its obstacles and people."""
    figure = new_figure(9.0, 3.6)
    axes, world = figure.subplots(), load_world("corridor")
    scene = Scene(world)
    draw_scene(axes, scene, scene.leaves(STAMP), 3.0)
    for x, y, radius in _legs(scene):
        axes.add_patch(Circle((x, y), radius, fc=WALKERS, ec=WALKERS))
    for box in world.boxes:
        axes.annotate("box", box.centre, color=INK, fontsize=7, ha="center", va="center")
    axes.set(xlim=(-2.0, 20.0), ylim=(-3.5, 4.0), aspect="equal")
    style(axes)
    return figure


def _legs(scene: Scene) -> Iterable[list[float]]:
    legs: list[list[float]] = scene.legs(STAMP).tolist()
    return legs


DRAWINGS: dict[str, Callable[[], Figure]] = {
    "fig04-system": system,
    "fig09-motion": motion,
    "fig10-arena": arena,
    "fig20-normal-form": normal_form,
    "fig21-frames": frames,
    "fig23-arena": arena_path,
    "fig27-passages": passages,
    "fig28-obstacles": obstacles,
}
"""Each drawing by the stem of its file."""
