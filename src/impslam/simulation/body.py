"""The robot's body in real time: from commanded wheel speeds to true motion and noisy readings.

Unlike the offline simulation, which plans the whole drive in advance, it is commanded step by step. A
single thread must move it and read it.
"""

from __future__ import annotations

import math

import numpy as np

from impslam.errors import ConfigError
from impslam.geometry.angles import wrap
from impslam.simulation.body_motion import (
    DISTANCE,
    HEADING,
    LEFT,
    SPEED,
    TURN_RATE,
    WHEEL_ANGLE,
    Drivetrain,
    clearance,
    roll,
    run,
)
from impslam.simulation.noise import build, quantise
from impslam.simulation.robot import InertialUnit, SimulatedRobot, WheelEncoders
from impslam.simulation.scene import Scene
from impslam.simulation.world import World
from impslam.types import Array

STEP = 1e-3  # s; the micro-controller reads its encoders at this period
MEMORY = 4.0  # s of the past that is stored: a sweep of 0.1 s may be requested 2 s later
_DOOR_INTERVAL = 0.1  # s between updates of the doors, which move by 0.1 rad meanwhile
_MAX_STEPS = 100  # steps between updates of the doors


class Body:
    """Six wheels, four of them driven, and the inertial unit, in a world with obstacles.

    The outline is a disc with the radius of the world's robot: walls, boxes, cylinders and doors stop it
    or make it slide along; people avoid it. Equal seeds, commands and times give equal readings, whatever
    the steps in which it is advanced.

    Parameters
    ----------
    world : the world; the robot starts at the start of its drive
    robot : its encoders and inertial unit; missing devices give perfect readings
    seed : seed of all random draws; each fault has its own stream
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
        self._commanded, self._stalled = np.zeros(2), np.zeros(2, np.bool_)
        self._motors = self._motor_constants()
        self.load = self.drivetrain.load  # may be changed during the drive
        self._doors_updated = -math.inf

    def _check(self) -> None:
        min_radius = 2.0 * self.drivetrain.top_speed * STEP
        if self.world.robot.radius <= min_radius:
            raise ConfigError(
                f"robot.radius = {self.world.robot.radius} m: too small to stop at walls; "
                f"it must be larger than {min_radius:g} m"
            )

    def _motor_constants(self) -> Array:
        train = self.drivetrain
        lag = -math.expm1(-STEP / train.time_constant) if train.time_constant else 1.0
        change = train.acceleration * STEP
        return np.array([STEP, lag, change, train.effective_track, self.world.robot.radius])

    # ------------------------------------------------------------------ commands

    def drive(self, left: float, right: float) -> None:
        """Command the surface speeds of the left and right wheels, m/s, clipped to the top speed."""
        if not (math.isfinite(left) and math.isfinite(right)):
            raise ValueError(f"wheel speeds of {left} and {right} m/s are not finite")
        top = self.drivetrain.top_speed
        self._commanded[:] = np.clip([left, right], -top, top)

    def stall(self, side: str, on: bool) -> None:
        """Block the motors of one side ("left" or "right"), or free them again."""
        self._stalled[("left", "right").index(side)] = on

    def put_down(self, x: float, y: float) -> None:
        """Move the robot to a position, m, without turning its wheels; it keeps its heading.

        Raises
        ------
        ConfigError
            If an obstacle is there.
        """
        self._update_doors()
        gap, _, _ = clearance(x, y, self._obstacles)
        if gap < self.world.robot.radius:
            raise ConfigError(
                f"the robot cannot stand at {x:g}, {y:g} m: an obstacle is {gap:.2f} m away; its radius "
                f"is {self.world.robot.radius:g} m"
            )
        self._state[:2] = x, y

    def advance(self, time: float) -> None:
        """Simulate up to a time in s since the start; do nothing if the time has passed."""
        end = math.floor(time / STEP + 1e-6)
        while self._steps < end:
            self._run(min(end - self._steps, _MAX_STEPS))

    def _run(self, steps: int) -> None:
        self._update_doors()
        command = np.where(self._stalled, 0.0, self._commanded * (1.0 - self.load))
        driven = run(
            self._state, self._history, self._steps, steps, command, self._motors, self._obstacles
        )
        self._steps += steps
        self._wheels.roll(driven)

    def _update_doors(self) -> None:
        if self.time - self._doors_updated >= _DOOR_INTERVAL:
            self._doors_updated = self.time if any(d.open for d in self.world.doors) else math.inf
            segments = np.vstack([self.scene.segments, self.scene.leaves(self.time)])
            self._obstacles = np.ascontiguousarray(segments), self.scene.circles

    # ------------------------------------------------------------------ state

    @property
    def time(self) -> float:
        """Time simulated so far, s since the start."""
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
    def commanded(self) -> Array:
        """Commanded surface speeds (2,) m/s, left first."""
        return self._commanded.copy()

    @property
    def motors(self) -> Array:
        """Actual surface speeds (2,) m/s of the driven wheels, left first."""
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
        """Return the poses (k, 3) at times (k,) s, clipped to the stored past."""
        x, y, heading = self._recall(np.asarray(times, dtype=np.float64))[:, :3].T
        return np.column_stack([x, y, wrap(heading)])

    def _recall(self, times: Array) -> Array:
        """Return the states (k, 8) at times (k,), interpolated between two steps."""
        oldest = max(0, self._steps - len(self._history) + 1)
        steps = np.clip(times / STEP, oldest, self._steps)
        first = np.minimum(steps.astype(np.int64), max(self._steps - 1, 0))
        part = (steps - first)[:, None]
        rows = self._history[first % len(self._history)]
        return np.asarray(rows + part * (self._history[(first + 1) % len(self._history)] - rows))

    # ------------------------------------------------------------------ sensor readings

    def wheel_angles(self) -> tuple[float, float]:
        """Return the accumulated angles of the passive wheels, rad, left first."""
        return self._wheels.angles()

    def inertial(self) -> tuple[Array, Array]:
        """Return angular velocity (3,) rad/s and specific force (3,) m/s^2 at base_link.

        Each is the mean over the unit's last period, with independent noise in every reading.
        """
        unit = self._imu
        before, now = self._recall(np.array([self.time - 1.0 / unit.rate, self.time]))
        speed, turn_rate, acceleration = (now - before)[[DISTANCE, HEADING, SPEED]] * unit.rate
        rates = np.array([0.0, 0.0, turn_rate])
        forces = np.array([acceleration, speed * turn_rate, unit.gravity])
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
        self._state[WHEEL_ANGLE:] = phase
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
        """Roll along steps of distance and turn (n, 2)."""
        n = len(driven)
        draws = (
            self._slip.standard_normal(n),
            self._skid.random((n, 4)),
            self._noise.standard_normal((n, 2)),
        )
        roll(self._state, driven, self._faults, self._radii, draws)

    def angles(self) -> tuple[float, float]:
        left, right = quantise(self._state[WHEEL_ANGLE:], self._counts).tolist()
        return left, right
