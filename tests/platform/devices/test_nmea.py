"""Fixes from NMEA 0183, in any pieces, and with corrupt bytes."""

import math
from collections import Counter

import numpy as np
import pytest
from tests.platform.devices.inbox import Inbox
from tests.platform.devices.test_rplidar import Line

from impslam.platform.devices.base import now
from impslam.platform.devices.gps import NmeaReceiver
from impslam.platform.devices.nmea import GROUND, RANGE_ERROR, SATELLITES, Epochs, Sentences
from impslam.platform.virtual.gps import ORIGIN, SHARED, WHITE, GpsEmulator
from impslam.types import Event, SatelliteFix

pynmeagps = pytest.importorskip("pynmeagps")

# GGA and GST as in the manuals of u-blox and Trimble.
UBLOX = b"$GNGGA,092725.00,4717.11399,N,00833.91590,E,1,08,1.01,499.6,M,48.0,M,,*45\r\n"
TRIMBLE = b"$GPGST,172814.0,0.006,0.023,0.020,273.6,0.023,0.020,0.031*6A\r\n"


def sentence(text):
    check = 0
    for byte in text.encode():
        check ^= byte
    return f"${text}*{check:02X}\r\n".encode()


def gga(
    clock="120000.00", lat="5200.00000,N", lon="01300.00000,E", quality=1, hdop="1.0", talker="GN"
):
    return sentence(f"{talker}GGA,{clock},{lat},{lon},{quality},09,{hdop},12.0,M,40.0,M,,")


def rmc(clock="120000.00", status="A", talker="GN"):
    return sentence(f"{talker}RMC,{clock},{status},5200.00000,N,01300.00000,E,,,010126,,,A")


def gst(clock="120000.00", errors="3.0,2.0,90.0,2.0,3.0,4.0", talker="GN"):
    return sentence(f"{talker}GST,{clock},2.2,{errors}")


def epochs(*pieces):
    """Return the epochs of pieces of bytes a tenth of a second apart, and the counts."""
    counts = Counter()
    reader, found = Epochs(), []
    lines = Sentences(pynmeagps, lambda what, n: counts.update({what: n}))
    for k, piece in enumerate(pieces):
        for parsed, began in lines.feed(piece, 0.1 * k):
            found += reader.add(parsed, began)
    return found, counts


def test_an_example_of_a_manufacturer_is_read():
    (fix, *_), _ = epochs(UBLOX, gga("092726.00"))
    assert fix.latitude == pytest.approx(47 + 17.11399 / 60, abs=1e-9)
    assert fix.longitude == pytest.approx(8 + 33.91590 / 60, abs=1e-9)
    assert fix.altitude == pytest.approx(499.6 + 48.0)  # over the ellipsoid
    assert fix.seconds == pytest.approx(9 * 3600 + 27 * 60 + 25)
    side = 1.01 * RANGE_ERROR["1"] / math.sqrt(2.0)
    np.testing.assert_allclose(np.diag(fix.covariance)[:2], side**2)


def test_the_ellipse_of_gst_has_the_right_orientation():
    """Trimble's: 23 mm along 273.6 degrees from north, nearly west, and 20 mm across."""
    place = gga("172814.0", quality=4)
    (fix, *_), _ = epochs(place + TRIMBLE + gga("172815.0"))
    assert fix.status == GROUND
    values, axes = np.linalg.eigh(fix.covariance[:2, :2])
    np.testing.assert_allclose(np.sqrt(values), [0.020, 0.023])
    assert math.degrees(math.atan2(axes[0, 1], axes[1, 1])) % 180 == pytest.approx(93.6)
    assert fix.covariance[2, 2] == pytest.approx(0.031**2)


def test_without_an_ellipse_north_and_east_are_used():
    (fix, *_), _ = epochs(gga() + gst(errors=",,,2.0,3.0,4.0") + gga("120001.00"))
    np.testing.assert_allclose(fix.covariance, np.diag([9.0, 4.0, 16.0]))


def test_south_and_west_are_negative_and_talkers_do_not_matter():
    for talker in ("GP", "GL", "GA", "GB", "GQ", "GN"):
        place = gga(lat="3352.00000,S", lon="07000.00000,W", talker=talker)
        (fix, *_), _ = epochs(place + rmc(talker=talker) + rmc("120001.00", talker=talker))
        assert (fix.latitude, fix.longitude) == pytest.approx((-33 - 52 / 60, -70.0))


@pytest.mark.parametrize("size", [1, 7, 50, 1000])
def test_any_cutting_of_the_bytes_gives_the_same_fixes(size):
    stream = b"".join(
        rmc(f"12000{k}.00") + gga(f"12000{k}.00") + gst(f"12000{k}.00") for k in range(8)
    )
    pieces = [stream[i : i + size] for i in range(0, len(stream), size)]
    found, counts = epochs(*pieces)
    assert [fix.seconds - 43200 for fix in found] == list(range(8))
    assert all(np.isfinite(fix.covariance).all() for fix in found)
    assert not counts


def test_an_epoch_is_returned_once_complete_and_begins_with_its_first_sentence():
    found, _ = epochs(rmc(), gga(), gst(), rmc("120001.00"), gga("120001.00"), gst("120001.00"))
    assert len(found) == 2  # the second without waiting for a third
    assert [fix.arrived for fix in found] == pytest.approx([0.0, 0.3])


def test_no_fix_is_reported_without_a_position():
    empty = sentence("GNGGA,120000.00,,,,,0,00,99.99,,,,,,")
    for text in (empty, gga(quality=0), gga(quality=6), gga(quality=8), gga() + rmc(status="V")):
        (fix, *_), _ = epochs(text + gga("120001.00"))
        assert fix.status == -1
        assert math.isnan(fix.latitude)
        assert np.isnan(fix.covariance).all()


def test_a_receiver_that_does_not_know_the_time_has_no_fix():
    found, _ = epochs(
        *[sentence("GPGGA,,,,,,0,00,99.99,,,,,,"), sentence("GPRMC,,V,,,,,,,,,,N")] * 3
    )
    assert found
    assert all(fix.status == -1 and math.isnan(fix.seconds) for fix in found)


def test_rmc_alone_gives_a_fix_without_a_covariance():
    (fix, *_), _ = epochs(rmc() + rmc("120001.00"))
    assert fix.status == 0
    assert np.isnan(fix.covariance).all()


def test_quality_2_is_a_corrected_fix():
    (fix, *_), _ = epochs(gga(quality=2) + gga("120001.00"))
    assert fix.status == SATELLITES


def test_corrupt_bytes_are_dropped_and_counted(rng):
    stream = bytearray(
        b"".join(
            rmc(f"12{k // 60:02}{k % 60:02}.00") + gga(f"12{k // 60:02}{k % 60:02}.00")
            for k in range(600)
        )
    )
    for place in rng.integers(0, len(stream), 150):
        stream[place] ^= 1 << rng.integers(0, 8)
    found, counts = epochs(b"\x00\xff13*2A\r\n", bytes(stream))
    assert len(found) > 500
    assert counts["corrupt"] > 50
    for fix in found:
        if fix.status >= 0:
            assert (fix.latitude, fix.longitude) == (52.0, 13.0)


def test_bytes_without_lines_are_not_kept():
    lines = Sentences(pynmeagps, lambda what, n: None)
    for _ in range(100):
        assert not list(lines.feed(b"x" * 100, 0.0))
        assert len(lines._rest) <= 1124


def test_time_is_unwrapped_over_midnight():
    found, _ = epochs(gga("235959.00") + gga("000000.00") + gga("000001.00"))
    assert np.diff([fix.seconds for fix in found]) == pytest.approx([1.0, 1.0][: len(found) - 1])


# --------------------------------------------------------------------------- emulator and driver


def test_the_emulators_fixes_are_consistent_with_the_truth():
    truth = np.array([30.0, -20.0, 1.0])
    emulator = GpsEmulator(lambda: truth, seed=3)
    data = b"".join(emulator.due(0.5 * k) for k in range(8000))
    found, counts = epochs(data)
    assert not counts
    points = np.array([ORIGIN.points(f.latitude, f.longitude, 40.0) for f in found])[:, :2]
    off = points - truth[:2]
    told = found[5].covariance[:2, :2]
    np.testing.assert_allclose(told, (WHITE**2 + SHARED**2) * np.eye(2), rtol=0.01)
    assert 0.5 < np.mean(np.sum(off**2, axis=1)) / np.trace(told) < 1.6  # 13 spans of its memory
    assert np.diff(off, axis=0).std() == pytest.approx(math.sqrt(2.0) * WHITE, rel=0.1)


def test_the_driver_delivers_stamped_fixes_and_notifies_their_loss():
    emulator = GpsEmulator(lambda: np.zeros(3))
    line = Line(emulator)
    inbox = Inbox()
    receiver = NmeaReceiver(port=line.url, label="gps")
    receiver.start(inbox)
    try:
        readings = inbox.wait(SatelliteFix, 3)
        for reading in readings[1:]:
            second = reading.device_stamp - 43200.0
            assert reading.message.stamp == pytest.approx(line.begin + second, abs=0.1)
        assert receiver.health().state == "ok"
        emulator.sky = False
        inbox.wait(SatelliteFix, len(inbox.of(SatelliteFix)) + 2)
        told = [r.message.text for r in inbox.of(Event)]
        assert any("has a fix" in text for text in told)
        assert any("lost its fix" in text for text in told)
        assert now() - line.begin < 20.0
    finally:
        receiver.stop()
        line.close()
