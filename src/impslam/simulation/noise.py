"""Simulates the readings of the wheel encoders and the inertial unit along a trajectory."""

from __future__ import annotations

import math

import numpy as np

from impslam.simulation.drive import Trajectory
from impslam.simulation.robot import InertialUnit, WheelEncoders
from impslam.types import Array


def wheel_angles(
    encoders: WheelEncoders, trajectory: Trajectory, times: Array, rng: np.random.Generator
) -> Array:
    """Return accumulated left and right wheel angles (k, 2) rad at times (k,) s, starting at 0.

    Each fault has its own random stream, so that switching one off does not change the others.
    """
    building, slipping, skidding, noise = rng.spawn(4)
    radii, track, phase = build(encoders, building)
    distance, turn = (np.diff(driven) for driven in trajectory.travel(times))
    kept = 1.0 - _slip(encoders, turn / np.diff(times), slipping)
    travel = distance[:, None] + 0.5 * track * (kept * turn)[:, None] * np.array([-1.0, 1.0])
    travel = np.column_stack([_skid(encoders, travel[:, side], skidding) for side in (0, 1)])
    travel += np.sqrt(encoders.noise * np.abs(travel)) * noise.standard_normal(travel.shape)
    angles = phase + np.vstack([np.zeros(2), np.cumsum(travel / radii, axis=0)])
    return quantise(angles, encoders.counts)


def build(encoders: WheelEncoders, rng: np.random.Generator) -> tuple[Array, float, Array]:
    """Draw a robot's true radii (2,), true track and initial encoder angles (2,)."""
    error = rng.standard_normal(3)
    phase = rng.uniform(0.0, 2 * math.pi, 2) if encoders.counts else np.zeros(2)
    radii = encoders.wheel_radius * (1.0 + encoders.radius_sigma * error[:2])
    return radii, encoders.track * (1.0 + encoders.track_sigma * float(error[2])), phase


def _slip(encoders: WheelEncoders, rates: Array, rng: np.random.Generator) -> Array:
    """Return the share of rotation (k,) that the wheels lose, drawn once per turn."""
    turning = np.abs(rates) > encoders.turn_rate
    begins = turning & ~np.concatenate([[False], turning[:-1]])
    number = np.cumsum(begins)
    shares = encoders.slip_sigma * np.abs(rng.standard_normal(int(begins.sum()) + 1))
    return np.where(turning, shares[number], 0.0)


def _skid(encoders: WheelEncoders, travel: Array, rng: np.random.Generator) -> Array:
    """Return a wheel's travel (k,) without the distances over which the wheel stuck."""
    ends = np.cumsum(np.abs(travel))
    total = float(ends[-1]) if len(ends) else 0.0
    number = int(rng.poisson(encoders.skid_rate * total))
    lost = np.zeros_like(ends)
    starts, lengths = rng.uniform(0.0, total, number), rng.exponential(1.0, number)
    for start, length in zip(starts, lengths * encoders.skid_length, strict=True):
        lost += np.clip(ends - start, 0.0, length)
    lost = np.diff(lost, prepend=0.0)
    return np.asarray(np.sign(travel) * np.maximum(np.abs(travel) - lost, 0.0))


def quantise(angles: Array, counts: int) -> Array:
    """Return angles in rad as read by an encoder with `counts` per turn; 0: continuous."""
    if not counts:
        return angles
    step = 2 * math.pi / counts
    return np.floor(angles / step) * step


def inertial(
    unit: InertialUnit, trajectory: Trajectory, times: Array, rng: np.random.Generator
) -> tuple[Array, Array]:
    """Return angular velocities (k, 3) and specific forces (k, 3) at times (k,) s, starting at 0.

    Each reading is the mean over the period that it ends, so that the gyro's readings add up to the angle
    turned; the first one repeats the second, or is that of a standing robot if it is the only one.
    """
    period = np.diff(times)
    means = (np.diff(driven) / period for driven in trajectory.travel(times))
    v, omega = (np.append(mean[:1] if len(mean) else 0.0, mean) for mean in means)
    still = np.zeros_like(v)
    acceleration = np.append(0.0, np.diff(v) / period)
    rates = np.column_stack([still, still, omega])
    forces = np.column_stack([acceleration, v * omega, still + unit.gravity])
    bias = rng.standard_normal((2, 3))
    noise = rng.standard_normal((2, len(times), 3))
    return (
        rates + unit.gyro_bias_sigma * bias[0] + unit.gyro_sigma * noise[0],
        forces + unit.accel_bias_sigma * bias[1] + unit.accel_sigma * noise[1],
    )
