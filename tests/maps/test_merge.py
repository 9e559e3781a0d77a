"""Maps of several drives through one building become one, or it is told why not."""

from dataclasses import replace

import numpy as np
import pytest
from tests.extractors.scans import room
from tests.maps.drawn import mapped
from tests.numeric import wrapped
from tests.recognition.plans import OFFICE, way

from impslam.errors import ConfigError
from impslam.map import Map
from impslam.maps.merge import NotMergedError, check_logs, merged

LEFT = np.concatenate([way(-7.0, -0.3, 0.0, -0.2, 16), way(0.0, 0.2, -7.0, 0.3, 16)])
MIDDLE = np.concatenate([way(-5.0, 0.2, 5.0, -0.2, 22), way(5.0, 0.3, -2.5, 0.0, 16)])
RIGHT = np.concatenate([way(1.0, -0.4, 8.0, 0.2, 16), way(8.0, -0.2, 1.5, 0.3, 14)])
FAR = (40.0, -30.0, 2.5)


def drives(*ways, seed=0):
    """Return the map of each way, each in a frame of its own but the first."""
    frames = [(0.0, 0.0, 0.0), FAR, (-3.0, 7.0, -1.0)]
    return [
        mapped(OFFICE, w, T=T, seed=seed + k)
        for k, (w, T) in enumerate(zip(ways, frames, strict=False))
    ]


def test_two_maps_become_one_in_the_frame_of_the_first():
    one, other = drives(LEFT, MIDDLE)
    told = []
    both = merged(one, other, progress=lambda what, share: told.append((what, share)))
    truth = np.concatenate([LEFT, MIDDLE])
    off = wrapped(both.keyframes.poses - truth, 2)
    assert np.hypot(off[:, 0], off[:, 1]).max() < 0.05
    assert np.abs(off[:, 2]).max() < 0.01
    assert both.keyframes.placed.all()
    assert both.keyframes.sessions.tolist() == [0] * len(LEFT) + [1] * len(MIDDLE)
    assert len(both.path()) == len(one.stamps) + len(other.stamps)
    assert told[0] == ("finding map 2", 0.0)
    assert told[-1][0] == "joining"


def test_a_map_that_overlaps_a_later_one_alone_waits_for_it():
    maps = drives(LEFT[:24], RIGHT, MIDDLE)
    known = merged(*maps)
    truth = np.concatenate([LEFT[:24], MIDDLE, RIGHT])
    assert known.keyframes.sessions.max() == 2
    off = wrapped(known.keyframes.poses - truth, 2)
    assert np.hypot(off[:, 0], off[:, 1]).max() < 0.1


def test_a_merged_map_is_a_map_like_any_other(tmp_path):
    both = merged(*drives(LEFT, MIDDLE))
    again = Map.load(both.save(tmp_path / "both.imp"))
    third = mapped(OFFICE, RIGHT, T=(-3.0, 7.0, -1.0), seed=2)
    known = merged(again, third)
    assert known.keyframes.sessions.max() == 2
    logs = known.about["logs"]
    assert [log["log"] for log in logs] == ["drawn"] * 3
    assert [log["scans"] for log in logs] == [2 * len(w) for w in (LEFT, MIDDLE, RIGHT)]


def test_covariances_of_the_second_map_are_as_valid_as_of_the_first():
    one, other = drives(LEFT, MIDDLE)
    both = merged(one, other)
    spread = np.sqrt(both.keyframes.covariances[:, 0, 0])
    assert np.isfinite(spread).all()
    assert spread[len(LEFT) :].max() < 0.5  # it was 40 m away, and is known to centimetres


def test_a_map_of_another_building_is_named():
    one, other = drives(LEFT, MIDDLE)
    hall = mapped(room(0.0, 9.0, 0.0, 7.0), way(1, 1, 8, 5, 30), seed=5)
    with pytest.raises(NotMergedError, match="map 3: they have no place in common") as caught:
        merged(one, other, hall)
    assert caught.value.which == 2


def logs(**scans):
    """What a map of these logs tells of them."""
    named = [{"log": f"{name}.log", "log_sha256": name, "scans": n} for name, n in scans.items()]
    return {"log": named[0]["log"], "logs": named}


@pytest.mark.parametrize(
    ("first", "second"),
    [
        ({"monday": 48}, {"monday": 48}),
        ({"monday": 48}, {"monday": 20, "tuesday": 28}),
        ({"tuesday": 8, "monday": 40}, {"monday": 20, "wednesday": 28}),
    ],
)
def test_maps_that_contain_the_same_log_are_refused(first, second):
    one, other = drives(LEFT[:4], MIDDLE[:4])
    maps = replace(one, about=logs(**first)), replace(other, about=logs(**second))
    with pytest.raises(ConfigError, match=r"map 2 and map 3 both contain the log monday\.log, "):
        merged(mapped(OFFICE, LEFT[:4]), *maps)


def test_maps_share_no_log_that_is_unknown_or_without_scans():
    one, other = drives(LEFT[:4], MIDDLE[:4])
    there = {"monday": 48, "localised": 0}, {"localised": 0, "": 48}
    maps = [
        replace(known, about=logs(**about))
        for known, about in zip((one, other), there, strict=True)
    ]
    check_logs([one, other], ["a", "b"])
    check_logs(maps, ["a", "b"])
    check_logs([replace(known, about=logs(**{"": 48})) for known in (one, other)], ["a", "b"])


def test_maps_without_hashes_that_contain_the_same_scans_are_refused():
    """The second map lacks some scans, as that of a robot that was too slow for its lidar."""
    one, other = drives(LEFT, MIDDLE)
    rows = np.delete(np.arange(len(one.stamps)), [3, 7])
    fewer = replace(
        one,
        stamps=one.stamps[rows],
        anchors=one.anchors[rows],
        tracked=one.tracked[rows],
        odometry_poses=one.odometry_poses[rows],
    )
    with pytest.raises(ConfigError, match=r"a and b both contain the same \d+ scans, which would"):
        check_logs([one, fewer], ["a", "b"])
    check_logs([one, other], ["a", "b"])


def test_nothing_is_changed_where_nothing_is_merged():
    (one,) = drives(LEFT)
    assert merged(one) is not None
    np.testing.assert_array_equal(merged(one).keyframes.poses, one.keyframes.poses)


def test_what_is_no_map_is_named():
    with pytest.raises(ConfigError, match=r"map 2 = 'b\.imp': expected a Map"):
        merged(mapped(OFFICE, way(-6.0, -0.5, 6.0, 0.2, 3)), "b.imp")
