import math
from pathlib import Path

import numpy as np
import pytest
from tests.sources.logs import dat_line, read, write_dat

from impslam.errors import MessageError
from impslam.sources.tinyslam import MicrosecondClock
from impslam.types import LaserScan, WheelAngles


def log(tmp_path: Path, *lines: str) -> Path:
    path = tmp_path / "a.dat"
    path.write_text("\n".join(lines) + "\n")
    return path


def test_encoders_come_before_the_scan_of_the_same_stamp(tmp_path: Path) -> None:
    found, source = read(write_dat(tmp_path / "a.dat"))
    assert [type(m) for m in found] == [WheelAngles, LaserScan] * 3
    np.testing.assert_allclose([m.stamp for m in found], [0.1, 0.1, 0.2, 0.2, 0.3, 0.3])
    assert (found[2].left, found[2].right) == (10.0, 14.0)
    np.testing.assert_array_equal(found[1].ranges, np.arange(682) / 1000.0)
    assert (found[1].range_min, found[1].range_max) == (0.02, 5.6)
    assert source.preset == "mines-rover"
    assert not source.problems.counts


def test_geometry_is_that_of_the_urg(tmp_path: Path) -> None:
    scan = read(write_dat(tmp_path / "a.dat"))[0][1]
    assert scan.angles[[0, 340, 681]] == pytest.approx([-2.0862, 0.0, 2.0924], abs=1e-4)
    assert scan.time_offsets[1] == pytest.approx(97.66e-6, abs=1e-8)


def test_the_short_layout_has_the_right_encoder_inverted(tmp_path: Path) -> None:
    line = " ".join(map(str, [1000, 5, -7, *[0] * 9, *range(682), 0]))
    found, _ = read(log(tmp_path, line))
    assert (found[0].left, found[0].right) == (5.0, 7.0)
    np.testing.assert_array_equal(found[1].ranges, np.arange(682) / 1000.0)


def test_the_clock_wraps(tmp_path: Path) -> None:
    counts = [2**32 - 100_000, 2**32 - 1, 99_999, 199_999]
    found, source = read(log(tmp_path, *(dat_line(c, 0, 0) for c in counts)))
    steps = np.diff([m.stamp for m in found[::2]])
    np.testing.assert_allclose(steps, [0.099999, 0.1, 0.1], atol=1e-6)
    assert not source.problems.counts


def test_one_wrong_count_does_not_turn_the_clock_for_good() -> None:
    clock = MicrosecondClock()
    times = [clock.seconds(c) for c in (3_000_000_000, 100_000_000, 3_000_100_000)]
    assert times[2] - times[0] == pytest.approx(0.1)
    with pytest.raises(MessageError, match="32-bit"):
        clock.seconds(2**32)


@pytest.mark.parametrize(
    "bad",
    ["1 2 3", dat_line(2, 0, 0)[:-9], "x" + dat_line(2, 0, 0), dat_line(-5, 0, 0)]
    + [dat_line(2, 0, 0).replace(" 14000 0 0 ", f" 14000 {w} 0 ") for w in ("nan", "inf", "l")],
)
def test_bad_lines_are_counted_and_dropped(tmp_path: Path, bad: str) -> None:
    path = log(tmp_path, dat_line(1, 0, 0), bad, dat_line(3, 0, 0))
    found, source = read(path)
    assert len(found) == 4
    assert source.problems.counts == {"malformed line": 1}
    assert source.problems.examples["malformed line"].startswith(f"{path}:2: ")


@pytest.mark.real
@pytest.mark.parametrize(("name", "scans"), [("exp1", 756), ("exp2", 641), ("test_lab2", 404)])
def test_real_logs(data_folder: Path, name: str, scans: int) -> None:
    found, source = read(data_folder / "urg04lx-encoders" / f"{name}.dat")
    assert [type(m) for m in found] == [WheelAngles, LaserScan] * scans
    cut = {"malformed line": 1} if name == "test_lab2" else {}
    assert source.problems.counts == cut
    steps = np.diff([m.stamp for m in found[::2]])
    assert 0.0 < steps.min() < steps.max() < 0.3
    assert math.isclose(np.median(steps), 0.098, abs_tol=0.002)
