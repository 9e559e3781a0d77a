"""The robot's body in real time: told wheel speeds in, true motion and spoilt readings out.

The offline simulation knows the whole way in advance; this one is told what to do as it goes, by
whoever drives. One thread moves it and reads it.
"""

from __future__ import annotations

import math

import numpy as np

from impslam.errors import ConfigError
from impslam.geometry.angles import wrap
from impslam.simulation.body_motion import (
    HEADING,
    LEFT,
    ROLLED,
    SPEED,
    TURN_RATE,
    WAY,
    Drivetrain,
    roll,
    run,
)
from impslam.simulation.noise import build, quantise
from impslam.simulation.robot import InertialUnit, SimulatedRobot, WheelEncoders
from impslam.simulation.scene import Scene
from impslam.simulation.world import World
from impslam.types import Array

STEP = 1e-3  # s; the micro-controller reads its encoders as often
MEMORY = 4.0  # s of the past that are kept: a sweep of 0.1 s may be asked for 2 s later
_DOORS = 0.1  # s between looks at the doors' leaves, which move 0.1 rad meanwhile
_MOST = 100  # steps at once: doors are looked at in between


class Body:
    """Six wheels, four of them driven, and the inertial unit, in a world that stops it.

    It is a disc of the radius that the world's robot has: walls, boxes, cylinders and doors stop it
    or make it slide along; people walk round it. The same seed, commands and times give the same
    readings, in however many steps it is advanced.

    Parameters
    ----------
    world : where it stands; it begins at the start of the world's way
    robot : its encoders and inertial unit; what is left out reads without faults
    seed : of every random draw; each fault has a stream of its own
    drivetrain : motors and driven wheels

    Raises
    ------
    ConfigError
        If the robot is so small that it could pass through a wall within one step.
    """

    def __init__(
        self,
        world: World,
        robot: SimulatedRobot | None = None,
        seed: int = 0,
        drivetrain: Drivetrain | None = None,
    ) -> None:
        robot = robot or SimulatedRobot()
        self.world, self.robot, self.scene = world, robot, Scene(world)
        self.drivetrain = drivetrain or Drivetrain()
        self._check()
        self._imu = robot.imu or InertialUnit.perfect()
        wheels, inertia = (np.random.default_rng(s) for s in np.random.SeedSequence(seed).spawn(2))
        self._wheels = _PassiveWheels(robot.encoders or WheelEncoders.perfect(), wheels)
        self._noise = inertia
        self._bias = inertia.standard_normal((2, 3))
        self._steps = 0
        self._state = np.zeros(8)
        self._state[:3] = world.robot.start
        self._history = np.tile(self._state, (round(MEMORY / STEP), 1))
        self._told, self._stalled = np.zeros(2), np.zeros(2, np.bool_)
        self._motors = self._motor_constants()
        self.load = self.drivetrain.load  # may change as it drives
        self._doors_seen = -math.inf

    def _check(self) -> None:
        reach = self.drivetrain.top_speed * STEP
        if self.world.robot.radius <= 2.0 * reach:
            raise ConfigError(
                f"robot.radius = {self.world.robot.radius} m: too small to stop at walls; "
                f"give it more than {2.0 * reach:g} m"
            )

    def _motor_constants(self) -> Array:
        train = self.drivetrain
        lag = -math.expm1(-STEP / train.time_constant) if train.time_constant else 1.0
        change = train.acceleration * STEP
        return np.array([STEP, lag, change, train.effective_track, self.world.robot.radius])

    # ------------------------------------------------------------------ what is done to it

    def drive(self, left: float, right: float) -> None:
        """Tell the motors the surface speeds of both wheels a side, in m/s, cut to the top speed."""
        if not (math.isfinite(left) and math.isfinite(right)):
            raise ValueError(f"wheel speeds of {left} and {right} m/s are no motion")
        top = self.drivetrain.top_speed
        self._told[:] = np.clip([left, right], -top, top)

    def stall(self, side: str, on: bool) -> None:
        """Block the motors of one side ("left" or "right"), or free them again."""
        self._stalled[("left", "right").index(side)] = on

    def advance(self, time: float) -> None:
        """Move on until a time in s since the beginning; does nothing for a time that has passed."""
        end = math.floor(time / STEP + 1e-6)
        while self._steps < end:
            self._run(min(end - self._steps, _MOST))

    def _run(self, steps: int) -> None:
        self._look_at_doors()
        told = np.where(self._stalled, 0.0, self._told * (1.0 - self.load))
        driven = run(
            self._state, self._history, self._steps, steps, told, self._motors, self._things
        )
        self._steps += steps
        self._wheels.roll(driven)

    def _look_at_doors(self) -> None:
        if self.time - self._doors_seen >= _DOORS:
            self._doors_seen = self.time if any(d.open for d in self.world.doors) else math.inf
            segments = np.vstack([self.scene.segments, self.scene.leaves(self.time)])
            self._things = np.ascontiguousarray(segments), self.scene.circles

    # ------------------------------------------------------------------ how it is

    @property
    def time(self) -> float:
        """Until when it has moved, in s since the beginning."""
        return self._steps * STEP

    @property
    def pose(self) -> Array:
        """True pose (3,) in map."""
        x, y, heading = self._state[:3]
        return np.array([x, y, wrap(heading)])

    @property
    def twist(self) -> Array:
        """True speed forward (m/s) and turn rate (rad/s), (2,)."""
        return np.array([self._state[SPEED], self._state[TURN_RATE]])

    @property
    def told(self) -> Array:
        """Surface speeds (2,) m/s that the motors are told, left first."""
        return self._told.copy()

    @property
    def motors(self) -> Array:
        """Surface speeds (2,) m/s at which the driven wheels turn, left first."""
        return self._state[LEFT : LEFT + 2].copy()

    @property
    def stalled(self) -> tuple[bool, bool]:
        """Whether the motors of a side are blocked, left first."""
        left, right = self._stalled.tolist()
        return left, right

    def heading(self) -> float:
        """Return the true heading in rad."""
        return float(wrap(self._state[HEADING]))

    def at(self, times: Array) -> Array:
        """Return the poses (k, 3) at times (k,) s within the memory; at its ends beyond."""
        x, y, heading = self._recall(np.asarray(times, dtype=np.float64))[:, :3].T
        return np.column_stack([x, y, wrap(heading)])

    def _recall(self, times: Array) -> Array:
        """Return the states (k, 8) at times (k,), by interpolation between two steps."""
        oldest = max(0, self._steps - len(self._history) + 1)
        place = np.clip(times / STEP, oldest, self._steps)
        first = np.minimum(place.astype(np.int64), max(self._steps - 1, 0))
        part = (place - first)[:, None]
        rows = self._history[first % len(self._history)]
        return np.asarray(rows + part * (self._history[(first + 1) % len(self._history)] - rows))

    # ------------------------------------------------------------------ what its sensors read

    def wheel_angles(self) -> tuple[float, float]:
        """Return how far the passive wheels have turned, in rad, accumulated, left first."""
        return self._wheels.angles()

    def inertial(self) -> tuple[Array, Array]:
        """Return angular velocity (3,) rad/s and specific force (3,) m/s^2 at base_link.

        Each is the mean over the unit's period until now, with noise of its own in every reading.
        """
        unit = self._imu
        then, present = self._recall(np.array([self.time - 1.0 / unit.rate, self.time]))
        way, turn, gain = (present - then)[[WAY, HEADING, SPEED]] * unit.rate
        rates = np.array([0.0, 0.0, turn])
        forces = np.array([gain, way * turn, unit.gravity])
        noise = self._noise.standard_normal((2, 3))
        return (
            rates + unit.gyro_bias_sigma * self._bias[0] + unit.gyro_sigma * noise[0],
            forces + unit.accel_bias_sigma * self._bias[1] + unit.accel_sigma * noise[1],
        )


class _PassiveWheels:
    """The two middle wheels and their encoders."""

    def __init__(self, encoders: WheelEncoders, rng: np.random.Generator) -> None:
        building, self._slip, self._skid, self._noise = rng.spawn(4)
        self._counts = encoders.counts
        self._radii, track, phase = build(encoders, building)
        self._state = np.zeros(6)
        self._state[ROLLED:] = phase
        self._faults = np.array(
            [
                0.5 * track,
                encoders.turn_rate * STEP,
                encoders.slip_sigma,
                encoders.skid_rate,
                encoders.skid_length,
                encoders.noise,
            ]
        )

    def roll(self, driven: Array) -> None:
        """Roll along steps of way and turn (n, 2)."""
        n = len(driven)
        draws = (
            self._slip.standard_normal(n),
            self._skid.random((n, 4)),
            self._noise.standard_normal((n, 2)),
        )
        roll(self._state, driven, self._faults, self._radii, draws)

    def angles(self) -> tuple[float, float]:
        left, right = quantise(self._state[ROLLED:], self._counts).tolist()
        return left, right
