"""How the body moves in one step: motors, skid steering, contact; and what passive wheels turn.

Skid steering. On the spot the wheels of one side move at w, the body turns at omega, and the four
driven wheels at (+-L/2, +-B/2) slide with w - omega B/2 along and omega L/2 across. Coulomb friction
points against the sliding, and its moment about the middle vanishes in a steady turn:
B (w - omega B/2) = L omega L/2, hence omega = (2 w / B) / (1 + (L/B)^2). The difference of the sides
takes the place of 2 w when the robot also drives, so that the share that is kept is a constant of
the robot. The two wheels in the middle lie on the axis of rotation and roll.
"""

from __future__ import annotations

import math

import numpy as np

from impslam.component import parameter
from impslam.geometry.kernels import kernel
from impslam.simulation.robot import Device
from impslam.types import Array

X, Y, HEADING, WAY, SPEED, TURN_RATE, LEFT, RIGHT = range(8)  # of the state (8,)
SHARE, TURNING, STUCK, ROLLED = 0, 1, 2, 4  # of the wheels' state (6,); the last two a side
_SLACK = 1e-9  # m, left between the outline and what it touches, above rounding


class Drivetrain(Device):
    """Four driven wheels, two a side, each side told one surface speed.

    The force is that of four motors at their rated 7.3 kgf cm (0.72 N m, thesis 3.2) on 5 in wheels:
    45 N, on a robot taken as 9 kg (chassis 2.2 kg, the rest motors, batteries and load).
    """

    time_constant: float = parameter(
        0.1, "s", "mass x top speed / stall force (twice the rated), of a linear motor", ge=0.0
    )
    acceleration: float = parameter(5.0, "m/s^2", "rated force / mass; the driver's limit", gt=0.0)
    top_speed: float = parameter(1.0, "m/s", "150 rpm of a 5 in wheel, usual for this gear", gt=0.0)
    load: float = parameter(
        0.0, "1", "share of the speed that load takes: a slope, a carpet, a low battery", ge=0, lt=1
    )
    track: float = parameter(0.40, "m", "distance of the sides, that of the passive wheels", gt=0.0)
    wheelbase: float = parameter(
        0.30, "m", "front to rear axle: three 5 in wheels in a row with gaps of 23 mm", ge=0.0
    )

    @property
    def kept(self) -> float:
        """Share of the commanded turn rate that the body turns at; the rest is slip."""
        return 1.0 / (1.0 + (self.wheelbase / self.track) ** 2)

    @property
    def effective_track(self) -> float:
        """Distance (m) of two wheels that would turn the body as these do without slip."""
        return self.track / self.kept


@kernel
def run(
    state: Array,
    history: Array,
    begin: int,
    steps: int,
    told: Array,
    motors: Array,
    things: tuple[Array, Array],
) -> Array:
    """Move by n steps; write `state` and rows of `history`, return way m and turn rad a step (n, 2).

    Parameters
    ----------
    state : (8,) x, y, heading (not wrapped), way driven, speed, turn rate, motors left and right
    history : (N, 8) ring of states: that after step k is row k mod N
    begin : steps done before
    told : (2,) m/s, left and right
    motors : step s, lag (share of the difference made up in a step), largest change m/s, effective
        track m, radius m of the outline
    things : segments (s, 4) and circles (c, 3) that the outline must not enter
    """
    driven = np.empty((steps, 2))
    for i in range(steps):
        way, heading = state[WAY], state[HEADING]
        left, right = state[LEFT], state[RIGHT]
        state[LEFT] += _toward(told[0] - left, motors[1], motors[2])
        state[RIGHT] += _toward(told[1] - right, motors[1], motors[2])
        # The mean over the step, so that a change of speed costs no accuracy.
        left, right = 0.5 * (left + state[LEFT]), 0.5 * (right + state[RIGHT])
        _move(state, 0.5 * (left + right), (right - left) / motors[3], motors, things)
        history[(begin + i + 1) % len(history)] = state
        driven[i, 0], driven[i, 1] = state[WAY] - way, state[HEADING] - heading
    return driven


@kernel
def _toward(difference: float, lag: float, most: float) -> float:
    return min(max(lag * difference, -most), most)


@kernel
def _move(state: Array, v: float, omega: float, motors: Array, things: tuple[Array, Array]) -> None:
    """Drive an arc for one step, as far as nothing is in the way."""
    step, radius = motors[0], motors[4]
    turn = omega * step
    middle = state[HEADING] + 0.5 * turn
    half = 0.5 * turn
    chord = v * step * (1.0 - half * half / 6.0)  # sin(h)/h; the next term is below 1e-16 m
    c, s = math.cos(middle), math.sin(middle)
    x, y = state[X] + chord * c, state[Y] + chord * s
    way = v * step
    free, _, _ = clearance(x, y, things)
    if free < radius:
        x, y = _yield(state[X], state[Y], x, y, radius, things)
        way = (x - state[X]) * c + (y - state[Y]) * s
    state[X], state[Y] = x, y
    state[HEADING] += turn
    state[WAY] += way
    state[SPEED], state[TURN_RATE] = way / step, omega


@kernel
def _yield(
    x0: float, y0: float, x: float, y: float, radius: float, things: tuple[Array, Array]
) -> tuple[float, float]:
    """Return where a disc ends up that wants from (x0, y0) to (x, y): it slides, or stands.

    It never comes nearer to anything than its radius, or than it was before where it was too near.
    """
    before, _, _ = clearance(x0, y0, things)
    wanted = min(radius, before)
    for _ in range(8):
        gap, nx, ny = clearance(x, y, things)
        if gap >= wanted:
            return x, y
        x += (wanted - gap + _SLACK) * nx
        y += (wanted - gap + _SLACK) * ny
    return x0, y0


@kernel
def clearance(x: float, y: float, things: tuple[Array, Array]) -> tuple[float, float, float]:
    """Return the distance (m) of a point from the nearest thing and the unit vector away from it.

    Inside a circle the distance is negative; inf if there is nothing.
    """
    best, nx, ny = math.inf, 1.0, 0.0
    segments, circles = things
    for i in range(len(segments)):
        px, py = _foot(x, y, segments[i])
        gap = math.hypot(x - px, y - py)
        if gap < best:
            best = gap
            if gap > 0.0:
                nx, ny = (x - px) / gap, (y - py) / gap
    for i in range(len(circles)):
        dx, dy = x - circles[i, 0], y - circles[i, 1]
        reach = math.hypot(dx, dy)
        if reach - circles[i, 2] < best:
            best = reach - circles[i, 2]
            if reach > 0.0:
                nx, ny = dx / reach, dy / reach
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

    Per step what that function does for a whole run: a share of the rotation is lost, drawn as a
    turn begins; a wheel sticks after an exponential way, here with the probability of that in one
    step; the ground's noise has a variance in proportion to the way.

    Parameters
    ----------
    wheels : (6,) share lost, whether in a turn, way left to stick (2,), angles rad (2,); written
    driven : (n, 2) way m and turn rad per step
    faults : half the track m, turn per step rad that is a turn, slip sigma, skid rate 1/m, mean
        length m of a skid, noise m^2/m
    radii : (2,) m
    draws : slip (n,) normal, skid (n, 4) uniform, noise (n, 2) normal
    """
    slip, skid, noise = draws
    for i in range(len(driven)):
        way, turn = driven[i, 0], driven[i, 1]
        turning = abs(turn) > faults[1]
        if turning and wheels[TURNING] == 0.0:
            wheels[SHARE] = faults[2] * abs(slip[i])
        wheels[TURNING] = 1.0 if turning else 0.0
        rotation = (1.0 - wheels[SHARE]) * turn if turning else turn
        for side in range(2):
            travel = way + (2 * side - 1) * faults[0] * rotation
            length = abs(travel)
            if skid[i, 2 * side] < faults[3] * length:
                wheels[STUCK + side] -= faults[4] * math.log1p(-skid[i, 2 * side + 1])
            lost = min(wheels[STUCK + side], length)
            wheels[STUCK + side] -= lost
            travel = math.copysign(length - lost, travel)
            travel += math.sqrt(faults[5] * abs(travel)) * noise[i, side]
            wheels[ROLLED + side] += travel / radii[side]
