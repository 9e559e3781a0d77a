"""Streams in step stay in step, whatever is done to their clocks."""

import numpy as np
import pytest

from impslam.odometry.clocks import JITTER, Clocks

STEPS = [-3600.0, -30.0, -2.0, 3.0, 30.0, 3600.0]
WHO = [("wheels",), ("scans",), ("wheels", "scans")]


def arrivals(seconds=20.0):
    """Wheels at 50 Hz; scans at 10 Hz, stamped 0.07 s before they arrive. (arrival, name, stamp)."""
    wheels = [(t, "wheels", t) for t in np.arange(0.0, seconds, 0.02).tolist()]
    scans = [(t + 0.07, "scans", t) for t in np.arange(0.005, seconds - 0.1, 0.1).tolist()]
    return sorted(wheels + scans)


def stepped(by, who, at=10.0):
    """Return (name, stamp, true time) with the clocks of some streams set at a moment."""
    return [(n, t + by * (n in who and t >= at), t) for _, n, t in arrivals()]


def placed(messages, cut=1):
    """Return names, times on the one time line, true times, and the steps; `cut` rows at a time."""
    clocks, numbers, times, steps = Clocks(), {}, [], []
    for k in range(0, len(messages), cut):
        part = messages[k : k + cut]
        streams = np.array([numbers.setdefault(name, len(numbers)) for name, _, _ in part])
        stamps = np.array([stamp for _, stamp, _ in part])
        rows, found = clocks.place(streams, stamps)
        times += rows.times.tolist()
        steps += [step._replace(row=step.row + k) for step in found]
    return [m[0] for m in messages], np.array(times), np.array([m[2] for m in messages]), steps


@pytest.mark.parametrize("by", STEPS)
@pytest.mark.parametrize("who", WHO)
def test_streams_stay_in_step(by, who):
    """One clock's error at most a few messages long; from then on within a period of the truth."""
    names, times, true, _ = placed(stepped(by, who))
    later = true > 10.3
    shift = {
        n: times[later & (np.array(names) == n)] - true[later & (np.array(names) == n)]
        for n in WHO[2]
    }
    for values in shift.values():
        assert np.ptp(values) < 1e-6
    assert abs(shift["wheels"][0] - shift["scans"][0]) < 0.01


@pytest.mark.parametrize("by", STEPS[:3])
@pytest.mark.parametrize("who", WHO)
def test_a_step_back_leaves_the_time_line_as_it_was(by, who):
    messages = stepped(by, who)
    _, times, true, steps = placed(messages)
    np.testing.assert_allclose(times, true, atol=1e-6)
    assert f"stepped back by {-by:g} s" in str(steps[0])
    assert messages[steps[0].row][1] == steps[0].stamp


def test_clocks_that_were_equal_are_equal_to_the_last_digit():
    """Records whose scan carries the odometry's own stamp are told by it."""
    stamps = (100.0, 100.1, 100.2, 7.3, 7.4, 7.5)
    _, times, _, _ = placed([(name, t, t) for t in stamps for name in ("odometry", "scan")])
    np.testing.assert_array_equal(times[::2], times[1::2])


def test_a_pause_of_all_is_no_step():
    _, times, _, steps = placed(stepped(300.0, WHO[2]))
    np.testing.assert_array_equal(times, [stamp for _, stamp, _ in stepped(300.0, WHO[2])])
    assert not steps


def test_the_silence_of_one_stream_is_no_step():
    messages = [m for m in stepped(0.0, ()) if not (m[0] == "wheels" and 5.0 < m[2] < 15.0)]
    _, times, true, steps = placed(messages)
    np.testing.assert_array_equal(times, true)
    assert not steps


@pytest.mark.parametrize("late", WHO[:2])
def test_rows_that_a_network_holds_up_are_no_step(late):
    """The rows of one stream wait for 13 s, then they come at once; the other is silent for 5 s."""
    (name,), rest = late, ({"wheels", "scans"} - set(late)).pop()
    arriving = [(max(t, 18.0 if n == name and t > 5.0 else t), n, s) for t, n, s in arrivals(30.0)]
    silent = [m for m in arriving if not (m[1] == rest and 8.0 < m[2] < 13.0)]
    messages = [(n, s, s) for _, n, s in sorted(silent, key=lambda m: m[0])]
    _, times, true, steps = placed(messages)
    np.testing.assert_array_equal(times, true)
    assert not steps


def test_jitter_is_no_step():
    rng = np.random.default_rng(1)
    messages = [
        (n, t - rng.uniform(0.0, 0.95 * JITTER) * (n == "scans"), t) for n, _, t in stepped(0.0, ())
    ]
    _, times, _, steps = placed(messages)
    np.testing.assert_array_equal(times, [stamp for _, stamp, _ in messages])
    assert not steps


def test_a_single_wrong_stamp_changes_nothing_after_it():
    messages = stepped(0.0, ())
    at = len(messages) // 2
    for wrong in (-500.0, 500.0):
        spoiled = [(n, s + wrong * (i == at), t) for i, (n, s, t) in enumerate(messages)]
        _, times, true, _ = placed(spoiled)
        offsets = (times - true)[at + 30 :]
        assert np.ptp(offsets) < 0.01


def test_a_clock_set_back_and_right_again():
    messages = [(n, t - 100.0 * (5.0 <= t < 12.0), t) for n, _, t in stepped(0.0, ())]
    _, times, true, steps = placed(messages)
    np.testing.assert_allclose(times, true, atol=1e-6)
    assert len(steps) == 2


@pytest.mark.parametrize("cut", [2, 7, 10**6])
@pytest.mark.parametrize("by", STEPS)
def test_any_cutting_gives_the_same_bytes(by, cut):
    messages = stepped(by, WHO[2])
    (_, one, _, steps), (_, other, _, again) = placed(messages), placed(messages, cut)
    np.testing.assert_array_equal(one, other)
    assert steps == again
