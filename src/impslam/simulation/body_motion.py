"""Motion of the body in one step: motors, skid steering and contact; and rotation of the passive wheels.

Skid steering. When turning on the spot, the wheels of one side move at w, the body turns at omega, and the
four driven wheels at (+-L/2, +-B/2) slide with w - omega B/2 along and omega L/2 across. Coulomb friction
opposes the sliding, and its moment about the centre vanishes in a steady turn:
B (w - omega B/2) = L omega L/2, hence omega = (2 w / B) / (1 + (L/B)^2). When the robot also drives, the
difference of the sides replaces 2 w, so that the share of the turn rate that is not lost to slip is a
constant of the robot. The two wheels in the middle are on the axis of rotation and roll.
"""

from __future__ import annotations

import math

import numpy as np

from impslam.component import parameter
from impslam.geometry.kernels import kernel
from impslam.simulation.robot import SimulatedDevice
from impslam.types import Array

X, Y, HEADING, DISTANCE, SPEED, TURN_RATE, LEFT, RIGHT = range(8)  # of the state (8,)
LOST_SHARE, TURNING, STUCK, WHEEL_ANGLE = 0, 1, 2, 4
"""Of the wheels' state (6,); the last two per side."""
_CONTACT_GAP = 1e-9  # m between the outline and a touched obstacle, above rounding errors


class Drivetrain(SimulatedDevice):
    """Four driven wheels, two per side, with one commanded surface speed per side.

    The force is that of four motors at their rated 7.3 kgf cm (0.72 N m, thesis 3.2) on 5 in wheels:
    45 N, on a robot of assumed 9 kg (chassis 2.2 kg, the rest motors, batteries and load).
    """

    time_constant: float = parameter(
        0.1, "s", "mass x top speed / stall force (twice the rated), of a linear motor", ge=0.0
    )
    acceleration: float = parameter(5.0, "m/s^2", "rated force / mass; the driver's limit", gt=0.0)
    top_speed: float = parameter(1.0, "m/s", "150 rpm of a 5 in wheel, usual for this gear", gt=0.0)
    load: float = parameter(
        0.0, "1", "share of the speed lost to load: a slope, a carpet, a low battery", ge=0, lt=1
    )
    track: float = parameter(
        0.40, "m", "distance between the sides, as of the passive wheels", gt=0.0
    )
    wheelbase: float = parameter(
        0.30, "m", "front to rear axle: three 5 in wheels in a row with gaps of 23 mm", ge=0.0
    )

    @property
    def turn_efficiency(self) -> float:
        """Share of the commanded turn rate that the body turns at; the rest is lost to slip."""
        return 1.0 / (1.0 + (self.wheelbase / self.track) ** 2)

    @property
    def effective_track(self) -> float:
        """Track (m) of two wheels without slip that would turn the body at the same rate."""
        return self.track / self.turn_efficiency


@kernel
def run(
    state: Array,
    history: Array,
    begin: int,
    steps: int,
    command: Array,
    motors: Array,
    obstacles: tuple[Array, Array],
) -> Array:
    """Move by n steps; write `state` and rows of `history`, return distance m and turn rad per step (n, 2).

    Parameters
    ----------
    state : (8,) x, y, heading (not wrapped), distance driven, speed, turn rate, motors left and right
    history : (N, 8) ring buffer of states: row k mod N is the state after step k
    begin : number of earlier steps
    command : (2,) m/s, left and right
    motors : step s, lag (share of the difference removed per step), maximum change m/s, effective track
        m, radius of the outline m
    obstacles : segments (s, 4) and circles (c, 3) that the outline must not enter
    """
    driven = np.empty((steps, 2))
    for i in range(steps):
        distance, heading = state[DISTANCE], state[HEADING]
        left, right = state[LEFT], state[RIGHT]
        state[LEFT] += _change(command[0] - left, motors[1], motors[2])
        state[RIGHT] += _change(command[1] - right, motors[1], motors[2])
        # The mean over the step, so that a change of speed costs no accuracy.
        left, right = 0.5 * (left + state[LEFT]), 0.5 * (right + state[RIGHT])
        _move(state, 0.5 * (left + right), (right - left) / motors[3], motors, obstacles)
        history[(begin + i + 1) % len(history)] = state
        driven[i, 0], driven[i, 1] = state[DISTANCE] - distance, state[HEADING] - heading
    return driven


@kernel
def _change(difference: float, lag: float, max_change: float) -> float:
    return min(max(lag * difference, -max_change), max_change)


@kernel
def _move(
    state: Array, v: float, omega: float, motors: Array, obstacles: tuple[Array, Array]
) -> None:
    """Drive an arc for one step, as far as obstacles allow."""
    step, radius = motors[0], motors[4]
    turn = omega * step
    middle = state[HEADING] + 0.5 * turn
    half = 0.5 * turn
    chord = v * step * (1.0 - half * half / 6.0)  # sin(h)/h; the next term is below 1e-16 m
    c, s = math.cos(middle), math.sin(middle)
    x, y = state[X] + chord * c, state[Y] + chord * s
    distance = v * step
    gap, _, _ = clearance(x, y, obstacles)
    if gap < radius:
        x, y = _resolve_contact(state[X], state[Y], x, y, radius, obstacles)
        distance = (x - state[X]) * c + (y - state[Y]) * s
    state[X], state[Y] = x, y
    state[HEADING] += turn
    state[DISTANCE] += distance
    state[SPEED], state[TURN_RATE] = distance / step, omega


@kernel
def _resolve_contact(
    x0: float, y0: float, x: float, y: float, radius: float, obstacles: tuple[Array, Array]
) -> tuple[float, float]:
    """Return the final position of a disc that moves from (x0, y0) towards (x, y): it slides or stops.

    It never gets nearer to an obstacle than its radius, or than before if it already was too near.
    """
    before, _, _ = clearance(x0, y0, obstacles)
    min_gap = min(radius, before)
    for _ in range(8):
        gap, nx, ny = clearance(x, y, obstacles)
        if gap >= min_gap:
            return x, y
        x += (min_gap - gap + _CONTACT_GAP) * nx
        y += (min_gap - gap + _CONTACT_GAP) * ny
    return x0, y0


@kernel
def clearance(x: float, y: float, obstacles: tuple[Array, Array]) -> tuple[float, float, float]:
    """Return the distance (m) of a point from the nearest obstacle and the unit vector away from it.

    The distance is negative inside a circle, and inf without obstacles.
    """
    best, nx, ny = math.inf, 1.0, 0.0
    segments, circles = obstacles
    for i in range(len(segments)):
        px, py = _foot(x, y, segments[i])
        gap = math.hypot(x - px, y - py)
        if gap < best:
            best = gap
            if gap > 0.0:
                nx, ny = (x - px) / gap, (y - py) / gap
    for i in range(len(circles)):
        dx, dy = x - circles[i, 0], y - circles[i, 1]
        distance = math.hypot(dx, dy)
        if distance - circles[i, 2] < best:
            best = distance - circles[i, 2]
            if distance > 0.0:
                nx, ny = dx / distance, dy / distance
    return best, nx, ny


@kernel
def _foot(x: float, y: float, segment: Array) -> tuple[float, float]:
    """Return the point of a segment [x0, y0, x1, y1] nearest to (x, y)."""
    ex, ey = segment[2] - segment[0], segment[3] - segment[1]
    square = ex * ex + ey * ey
    part = 0.0
    if square > 0.0:
        part = ((x - segment[0]) * ex + (y - segment[1]) * ey) / square
        part = min(max(part, 0.0), 1.0)
    return segment[0] + part * ex, segment[1] + part * ey


@kernel
def roll(
    wheels: Array, driven: Array, faults: Array, radii: Array, draws: tuple[Array, Array, Array]
) -> None:
    """Turn the passive wheels along n steps, with the faults of `noise.wheel_angles`.

    It does per step what that function does for a whole run: a share of the rotation is lost, drawn at the
    start of a turn; a wheel sticks after an exponentially distributed distance, here with the probability
    of that in one step; the noise of the ground has a variance proportional to the distance.

    Parameters
    ----------
    wheels : (6,) share lost, whether in a turn, remaining distance stuck (2,), angles rad (2,); written
    driven : (n, 2) distance m and turn rad per step
    faults : half the track m, minimum turn per step rad that counts as a turn, slip sigma, skid rate 1/m,
        mean length of a skid m, noise m^2/m
    radii : (2,) m
    draws : slip (n,) normal, skid (n, 4) uniform, noise (n, 2) normal
    """
    slip, skid, noise = draws
    for i in range(len(driven)):
        distance, turn = driven[i, 0], driven[i, 1]
        turning = abs(turn) > faults[1]
        if turning and wheels[TURNING] == 0.0:
            wheels[LOST_SHARE] = faults[2] * abs(slip[i])
        wheels[TURNING] = 1.0 if turning else 0.0
        rotation = (1.0 - wheels[LOST_SHARE]) * turn if turning else turn
        for side in range(2):
            travel = distance + (2 * side - 1) * faults[0] * rotation
            length = abs(travel)
            if skid[i, 2 * side] < faults[3] * length:
                wheels[STUCK + side] -= faults[4] * math.log1p(-skid[i, 2 * side + 1])
            lost = min(wheels[STUCK + side], length)
            wheels[STUCK + side] -= lost
            travel = math.copysign(length - lost, travel)
            travel += math.sqrt(faults[5] * abs(travel)) * noise[i, side]
            wheels[WHEEL_ANGLE + side] += travel / radii[side]
