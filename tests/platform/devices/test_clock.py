"""A device's clock from delayed arrivals: accurate, and never backwards."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from impslam.platform.devices.clock import STALL_DELAY, DeviceClock, Unwrapper

HOST = 1.79e9  # s
LEAST = 0.5e-3  # s, the delay that is unobservable from one side


def arrivals(rng, sampled, tail=1e-3, stalls=()):
    """Return host times: minimum delay, exponential tail, USB polled every 1 to 4 ms, stalls of 0.5 s."""
    polled = rng.uniform(1e-3, 4e-3, len(sampled)) * rng.uniform(0.0, 1.0, len(sampled))
    host = sampled + LEAST + rng.exponential(tail, len(sampled)) + polled
    for begin in stalls:
        host[(host > begin) & (host < begin + 0.5)] = begin + 0.5
    return np.maximum.accumulate(host)


def follow(clock, device, host):
    stamps = np.empty(len(device))
    for i, (own, arrived) in enumerate(zip(device.tolist(), host.tolist(), strict=True)):
        clock.observe(own, HOST + arrived)
        stamps[i] = clock.to_host(own) - HOST
    return stamps


def test_without_delays_and_drift_the_stamps_are_exact():
    clock, sampled = DeviceClock(), np.arange(500) / 100
    stamps = follow(clock, sampled + 3.0, sampled)
    np.testing.assert_allclose(stamps, sampled, atol=1e-6)  # floats of 1.8e9 s resolve 0.24 us
    assert clock.drift == pytest.approx(0.0, abs=1e-6)
    assert clock.offset == pytest.approx(HOST - 3.0, abs=1e-6)
    assert (clock.restarts, clock.stalls) == (0, 0)


@pytest.mark.parametrize("drift", [-100e-6, 50e-6, 100e-6])
@pytest.mark.parametrize("seed", [1, 2])
def test_stamps_are_right_to_a_millisecond_after_a_few_seconds(drift, seed):
    rng = np.random.default_rng(seed)
    sampled = np.arange(3500) / 100
    clock = DeviceClock()
    host = arrivals(rng, sampled, stalls=(3.0, 11.0, 25.0))
    stamps = follow(clock, (sampled + 70.0) * (1.0 + drift), host)
    late = stamps - sampled - LEAST
    assert np.all(np.diff(stamps) > 0.0)
    assert np.max(np.abs(late[300:])) < 1e-3
    assert np.max(np.abs(late[1000:])) < 0.5e-3
    assert clock.drift == pytest.approx(-drift, abs=20e-6)
    assert clock.stalls == 3
    assert clock.restarts == 0


@pytest.mark.parametrize("change", [0.1e-6, -0.1e-6])
def test_a_changing_drift_is_tracked(change):
    """A crystal that warms by 0.1 ppm/s for five minutes."""
    rng = np.random.default_rng(4)
    sampled = np.arange(12000) / 40
    device = sampled * (1.0 + 20e-6) + 0.5 * change * sampled**2
    clock = DeviceClock()
    stamps = follow(clock, device, arrivals(rng, sampled))
    assert np.max(np.abs(stamps - sampled - LEAST)[400:]) < 1e-3
    assert clock.drift == pytest.approx(-20e-6 - 300 * change, abs=20e-6)
    assert clock.restarts == 0


def test_ten_readings_a_second_are_enough():
    rng = np.random.default_rng(3)
    sampled = np.arange(600) / 10
    stamps = follow(DeviceClock(), sampled * (1.0 + 50e-6), arrivals(rng, sampled))
    assert np.max(np.abs(stamps - sampled - LEAST)[300:]) < 1e-3


def test_the_mean_would_be_wrong_by_the_tail():
    """Reason for the lower edge: a line through the middle is late by the mean delay."""
    rng = np.random.default_rng(5)
    sampled = np.arange(3000) / 100
    host = arrivals(rng, sampled, tail=20e-3)
    stamps = follow(DeviceClock(), sampled, host)
    assert np.mean(host - sampled) > 20e-3
    assert np.max(np.abs(stamps - sampled - LEAST)[1000:]) < 4e-3


def test_a_restart_of_the_device_is_detected_and_stamps_increase():
    rng = np.random.default_rng(6)
    sampled = np.arange(4000) / 100
    device = np.where(sampled < 20.0, sampled + 5.0, sampled - 19.9) * (1.0 + 50e-6)
    clock = DeviceClock()
    stamps = follow(clock, device, arrivals(rng, sampled))
    assert clock.restarts == 1
    assert np.all(np.diff(stamps) > 0.0)
    late = np.abs(stamps - sampled - LEAST)
    assert np.max(late[2300:]) < 1e-3
    assert np.max(late[2000:]) < 10e-3


@pytest.mark.parametrize("jump", [0.5, 30.0, -0.6, -30.0])
def test_a_jump_of_the_hosts_clock_is_detected_and_tracked(jump):
    """A computer that slept (its clock stood still), or a device's clock that stood still."""
    rng = np.random.default_rng(7)
    sampled = np.arange(4000) / 100
    host = arrivals(rng, sampled)
    host[2000:] += jump
    clock = DeviceClock()
    stamps = follow(clock, sampled, host)
    assert clock.restarts == 1
    assert np.all(np.diff(stamps) > 0.0)
    if jump > 0.0:
        assert np.max(np.abs(stamps - sampled - LEAST - jump)[3000:]) < 1e-3


def test_delayed_first_arrivals_do_not_count_as_a_restart():
    sampled = np.arange(1000) / 100
    host = np.maximum(sampled, 0.4) + LEAST
    clock = DeviceClock()
    stamps = follow(clock, sampled, host)
    assert clock.restarts == 0
    assert np.all(np.diff(stamps) > 0.0)
    assert np.max(np.abs(stamps - sampled - LEAST)[200:]) < 1e-3


def test_a_stall_is_detected_by_the_delay():
    clock = DeviceClock()
    follow(clock, np.arange(300) / 100, np.arange(300) / 100)
    clock.observe(3.0, HOST + 3.4)
    assert clock.delay == pytest.approx(0.4, abs=1e-5)
    assert clock.delay > STALL_DELAY
    assert clock.stalls == 1


@given(
    st.lists(
        st.tuples(st.floats(0.0, 30.0), st.floats(-5.0, 40.0)).map(
            lambda pair: (round(pair[0], 4), round(pair[1], 4))
        ),
        min_size=2,
        max_size=60,
    )
)
def test_stamps_always_increase_with_the_device_clock(steps):
    """Any gaps of the device's clock, any jumps of the host's."""
    clock, device, before = DeviceClock(), 0.0, -math.inf
    for gap, jump in steps:
        device += gap + 1e-3
        clock.observe(device, HOST + device + jump)
        stamp = clock.to_host(device)
        assert stamp > before
        before = stamp


def test_earlier_moments_get_earlier_stamps():
    clock = DeviceClock()
    follow(clock, np.arange(1000) / 100, arrivals(np.random.default_rng(1), np.arange(1000) / 100))
    stamps = [clock.to_host(device) for device in (9.99, 9.9, 9.5, 5.0)]
    assert stamps == sorted(stamps, reverse=True)
    assert clock.to_host(9.99) == stamps[0]


def test_the_clock_is_unknown_before_the_first_arrival():
    clock = DeviceClock()
    assert math.isnan(clock.offset)
    with pytest.raises(RuntimeError, match="before something arrived"):
        clock.to_host(1.0)


def test_a_counter_is_unwrapped():
    unwrap = Unwrapper(24, 1e-3)  # the URG's: it wraps every 4 h 39 min
    ticks = np.cumsum(np.full(2000, 40_000)).tolist()
    seconds = [unwrap(tick % (1 << 24)) for tick in ticks]
    np.testing.assert_allclose(seconds, np.array(ticks) * 1e-3, rtol=1e-12)
    unwrap.restart()
    assert unwrap(5) == 0.005
