"""Figures of Chapter IV: jumps, true and spurious detections, and the selection of scans."""

from __future__ import annotations

import math
import struct
from dataclasses import replace

import numpy as np
import pytest
from tests.extractors.scans import cast, room

from impslam.extractors.readings import usable
from impslam.geometry.se2 import between, compose, inverse, transform
from impslam.simulation.scene import Scene
from impslam.simulation.world import load_world
from impslam.studies.chapter4 import WORLDS, figures
from impslam.studies.chapter4_detections import (
    MAX_DISTANCE,
    ScanDetections,
    ThesisExtractors,
    detect,
    doubles,
    first_or_nearest,
    jumps,
    long_ones,
    on_people,
    rates,
    true_thing,
)
from impslam.studies.chapter4_hough import accumulator, hough_figure, peak, pixels
from impslam.studies.chapter4_jumps import jumps_figure
from impslam.studies.chapter4_plot import (
    SPURIOUS,
    TRUE,
    people_figure,
    scan_figure,
)
from impslam.studies.chapter4_scans import (
    ARENA,
    PEOPLE,
    SceneSnapshot,
    select_walls,
    snapshots,
    world_of,
)
from impslam.studies.corridor_truth import MAX_WALL_TURN
from impslam.studies.report import Section
from impslam.sweeps.job import Job
from impslam.types import Array, Observation

POSE = np.array([-0.4, 2.0, 1.3])
LEFT, RIGHT, BOTTOM, TOP = -1.6764, 0.3048, -0.3048, 6.0960  # the arena's walls (thesis 5.2)
CYLINDERS = np.array([[-1.2192, 1.5240], [-0.6096, 3.3528], [-1.2192, 5.1816]])


@pytest.fixture(scope="module")
def thesis() -> ThesisExtractors:
    return ThesisExtractors.presets()


@pytest.fixture(scope="module")
def arena() -> list[SceneSnapshot]:
    return list(snapshots(load_world(ARENA)))


@pytest.fixture(scope="module")
def part() -> Section:
    return figures(Job())


def snapshot_of(pose: Array = POSE, legs: Array | None = None) -> SceneSnapshot:
    """Return an exact scan of the arena with legs (k, 3) in it."""
    legs = np.empty((0, 3)) if legs is None else legs
    circles = np.vstack([np.column_stack([CYLINDERS, np.full(3, 0.1524)]), legs])
    seen = cast(room(LEFT, RIGHT, BOTTOM, TOP), circles, pose=pose)
    scene = Scene(load_world(ARENA))
    return SceneSnapshot(0, 0.0, seen.scan, pose, scene, scene.segments, np.empty((0, 4)), legs)


def wall(start: tuple[float, float], end: tuple[float, float], pose: Array = POSE) -> Observation:
    """Return a wall in map, as it is seen from a pose."""
    ends = transform(inverse(pose), np.array([start, end]))
    along = ends[1] - ends[0]
    alpha = math.atan2(-along[0], along[1])
    rho = float(ends[0] @ [math.cos(alpha), math.sin(alpha)])
    return Observation("wall", np.array([rho, alpha]), np.eye(2), end_points=ends)


def cylinder(x: float, y: float, pose: Array = POSE) -> Observation:
    centre = between(pose, np.array([x, y, 0.0]))[:2]
    return Observation("cylinder", centre, np.eye(2))


# --------------------------------------------------------------------------- jumps


def one_cylinder() -> tuple[SceneSnapshot, int, int]:
    """Return a scan of a cylinder in a room, and the first and the last beam on it."""
    seen = cast(room(-2.0, 3.0, -2.0, 2.0), np.array([[1.2, 0.5, 0.1524]]))
    on = seen.beams_on_circle(0)
    snapshot = replace(snapshot_of(), scan=seen.scan, pose=np.zeros(3))
    return snapshot, int(on[0]), int(on[-1])


def test_jumps_are_where_the_range_jumps(thesis: ThesisExtractors) -> None:
    snapshot, begin, end = one_cylinder()
    seen = jumps(snapshot.scan, thesis.jump.threshold)
    assert seen.objects.tolist() == [[begin, end]]
    step = snapshot.scan.angles[1] - snapshot.scan.angles[0]
    fall = (snapshot.scan.ranges[begin] - snapshot.scan.ranges[begin - 1]) / step
    rise = (snapshot.scan.ranges[end + 1] - snapshot.scan.ranges[end]) / step
    assert seen.slopes[seen.falls] == pytest.approx([fall])
    assert seen.slopes[seen.rises] == pytest.approx([rise])
    assert fall < -thesis.jump.threshold
    assert rise > thesis.jump.threshold


def test_jumps_are_drawn_between_the_beams_that_jump(thesis: ThesisExtractors) -> None:
    snapshot, begin, end = one_cylinder()
    seen = jumps(snapshot.scan, thesis.jump.threshold)
    figure = jumps_figure(detect(snapshot, thesis.jump), seen, thesis.jump.threshold, 0.1524)
    _, slopes = figure.subfigs[1].axes
    lines = {line.get_label(): line.get_xdata() for line in slopes.lines}
    degrees = np.degrees(snapshot.scan.angles)
    assert lines["begins"] == pytest.approx([0.5 * (degrees[begin - 1] + degrees[begin])])
    assert lines["ends"] == pytest.approx([0.5 * (degrees[end] + degrees[end + 1])])


def test_lost_beams_count_as_range_zero(thesis: ThesisExtractors) -> None:
    snapshot, _, _ = one_cylinder()
    snapshot.scan.valid[100] = False
    seen = jumps(snapshot.scan, thesis.jump.threshold)
    assert seen.ranges[100] == 0.0
    assert [100, 100] in seen.objects.tolist()


# --------------------------------------------------------------------------- true or spurious


@pytest.mark.parametrize(
    ("finding", "there"),
    [
        (wall((LEFT, 1.0), (LEFT, 3.0)), True),
        (wall((LEFT + 0.14, 1.0), (LEFT + 0.14, 3.0)), True),
        (wall((LEFT + 0.16, 1.0), (LEFT + 0.16, 3.0)), False),
        (wall((LEFT, 3.0), (LEFT, 1.0)), True),  # direction along the wall does not matter
        (wall((LEFT - 0.17, 1.0), (LEFT + 0.17, 3.0)), True),  # askew by 9.6 deg
        (wall((LEFT - 0.18, 1.0), (LEFT + 0.18, 3.0)), False),  # askew by 10.2 deg
        (wall((LEFT, TOP + 0.5), (LEFT, TOP + 2.5)), False),  # in line with it but beyond its end
        (wall((LEFT, 3.0), (RIGHT, 3.0)), False),
        (cylinder(-0.6096 + 0.14, 3.3528), True),
        (cylinder(-0.6096 + 0.16, 3.3528), False),
        (cylinder(LEFT, 3.0), False),
    ],
)
def test_a_finding_is_judged_by_the_truth(finding: Observation, there: bool) -> None:
    assert (true_thing(snapshot_of(), finding) >= 0) == there


def test_a_line_across_an_open_door_is_of_the_wall_beside_it() -> None:
    wall_with_gap = np.array([[0.0, 0.0, 3.0, 0.0], [3.9, 0.0, 6.0, 0.0], [0.0, 2.0, 0.3, 2.0]])
    snapshot = replace(snapshot_of(np.zeros(3)), surfaces=select_walls(wall_with_gap))
    longer = np.array([[-0.45, 0.0, 3.45, 0.0], [3.45, 0.0, 6.45, 0.0]])
    assert snapshot.surfaces == pytest.approx(longer)
    across = wall((2.0, 0.1), (4.8, 0.1), np.zeros(3))
    assert true_thing(snapshot, across) >= 0
    assert true_thing(snapshot, wall((7.0, 0.0), (8.0, 0.0), np.zeros(3))) < 0


def test_few_far_readings_do_not_make_a_wall_spurious() -> None:
    snapshot = snapshot_of()
    points = transform(POSE, snapshot.scan.points)
    on = np.flatnonzero(np.abs(points[:, 0] - LEFT) < 0.01)
    askew = wall((LEFT - 0.01, 1.5), (LEFT + 0.4, 5.5))  # by 5.9 deg: its middle is 0.2 m off
    low = on[points[on, 1] < 2.5]
    assert true_thing(snapshot, replace(askew, beams=low)) >= 0
    assert true_thing(snapshot, askew) < 0


def to_nearest_wall(snapshot: SceneSnapshot, finding: Observation) -> float:
    """Return how far a finding's middle is from the arena's walls of about its direction, m.

    Written for the arena's axes, without the geometry under test.
    """
    rho, alpha = finding.z
    normal = np.array([math.cos(alpha), math.sin(alpha)])
    middle = snapshot.scan.points[finding.beams].mean(axis=0)
    x, y = transform(snapshot.pose, (middle + (rho - middle @ normal) * normal)[None])[0]
    ends = transform(snapshot.pose, finding.end_points)
    dx, dy = np.abs(ends[1] - ends[0])
    apart = [math.inf]
    if math.atan2(dx, dy) <= MAX_WALL_TURN:
        outside = max(BOTTOM - y, y - TOP, 0.0)
        apart += [math.hypot(x - LEFT, outside), math.hypot(x - RIGHT, outside)]
    if math.atan2(dy, dx) <= MAX_WALL_TURN:
        outside = max(LEFT - x, x - RIGHT, 0.0)
        apart += [math.hypot(y - BOTTOM, outside), math.hypot(y - TOP, outside)]
    return min(apart)


@pytest.mark.parametrize("name", ["ransac", "hough"])
def test_spurious_walls_are_away_from_every_wall(
    arena: list[SceneSnapshot], thesis: ThesisExtractors, name: str
) -> None:
    lax = {"ransac": thesis.ransac, "hough": thesis.hough.model_copy(update={"threshold": 20})}
    seen = [detect(snapshot, lax[name]) for snapshot in arena]
    spurious = [to_nearest_wall(s.snapshot, o) for s in seen for o in s.spurious]
    true = [to_nearest_wall(s.snapshot, o) for s in seen for o in s.true]
    assert len(spurious) > 10
    assert len(true) > 100
    assert min(spurious) > MAX_DISTANCE
    assert max(true) <= MAX_DISTANCE


def test_spurious_cylinders_are_away_from_every_axis(thesis: ThesisExtractors) -> None:
    seen = [detect(snapshot, thesis.low) for snapshot in snapshots(world_of(PEOPLE))]
    parted = {"true": [], "spurious": []}
    for s in seen:
        for name, apart in parted.items():
            for finding in getattr(s, name):
                centre = compose(s.snapshot.pose, np.array([*finding.z, 0.0]))[:2]
                apart.append(np.hypot(*(CYLINDERS - centre).T).min())
    assert len(parted["spurious"]) > 10
    assert min(parted["spurious"]) > MAX_DISTANCE
    assert max(parted["true"]) <= MAX_DISTANCE
    # In an arena with nothing but cylinders and people, most of them are on legs.
    assert sum(map(on_people, seen)) > 0.5 * len(parted["spurious"])


def test_a_wall_that_is_found_twice_is_a_double() -> None:
    twice = (wall((LEFT, 1.0), (LEFT, 2.0)), wall((LEFT + 0.1, 2.0), (LEFT + 0.1, 3.0)))
    other = wall((RIGHT, 1.0), (RIGHT, 2.0))
    assert doubles(ScanDetections(snapshot_of(), (*twice, other), ())) == 1
    assert doubles(ScanDetections(snapshot_of(), (twice[0], other), ())) == 0


def test_long_spurious_walls_are_a_metre_or_more() -> None:
    found = wall((-1.0, 1.0), (-0.3, 1.0)), wall((-1.5, 2.0), (-0.4, 2.0)), cylinder(-1.0, 3.0)
    detections = ScanDetections(snapshot_of(), (), found)
    assert long_ones(detections) == [found[1]]
    assert rates([detections, ScanDetections(snapshot_of(), found[:1], ())]) == {
        "scans": 2,
        "true_per_scan": 0.5,
        "spurious_per_scan": 1.5,
        "long_spurious_per_scan": 0.5,
    }


def test_readings_on_legs_are_those_that_met_them() -> None:
    legs = np.array([[-0.5, 2.9, 0.06], [-0.9, 2.8, 0.06]])
    snapshot = snapshot_of(legs=legs)
    circles = np.vstack([np.column_stack([CYLINDERS, np.full(3, 0.1524)]), legs])
    hit = cast(room(LEFT, RIGHT, BOTTOM, TOP), circles, pose=POSE).hit
    assert snapshot.on_legs == np.count_nonzero(hit >= 4 + 3) > 10
    assert not snapshot.is_clear
    assert snapshot_of().on_legs == 0
    assert snapshot_of().is_clear


def test_without_a_scan_that_satisfies_the_rule_the_nearest_is_returned() -> None:
    def most(detections: ScanDetections) -> int:
        return len(detections.spurious)

    a, b = (
        ScanDetections(snapshot_of(), (), ()),
        ScanDetections(snapshot_of(), (), (cylinder(0.0, 0.0),)),
    )
    assert first_or_nearest([a, b], lambda s: not s.spurious, most) == (a, True)
    assert first_or_nearest([a, b], lambda s: len(s.spurious) > 3, most) == (b, False)


def test_random_draws_depend_on_seed_and_scan_alone(
    arena: list[SceneSnapshot], thesis: ThesisExtractors
) -> None:
    def ends(seed: int) -> list[Array]:
        seen = detect(arena[13], thesis.ransac, seed)
        return [o.z for o in (*seen.true, *seen.spurious)]

    assert np.array_equal(ends(0), ends(0))
    assert not np.array_equal(ends(0), ends(1))


# --------------------------------------------------------------------------- the Hough transform


def test_each_pixel_votes_once_for_each_angle(thesis: ThesisExtractors) -> None:
    snapshot = snapshot_of()
    white = pixels(snapshot.scan.points[usable(snapshot.scan)], thesis.hough)
    votes, thetas, distances = accumulator(white, thesis.hough)
    assert np.degrees(thetas) == pytest.approx(np.arange(0.0, 180.0, 10.0))
    assert votes.shape == (len(thetas), len(distances))
    assert (votes.sum(axis=1) == len(white)).all()


def test_a_row_of_pixels_fills_one_cell(thesis: ThesisExtractors) -> None:
    white = np.column_stack([np.full(30, 400.0), np.arange(100.0, 130.0)])
    votes, thetas, distances = accumulator(white, thesis.hough)
    i, j = np.unravel_index(votes.argmax(), votes.shape)
    assert (thetas[i], distances[j], votes[i, j]) == (0.0, 400.0, 30.0)


@pytest.mark.parametrize("heading", np.linspace(-3.1, 3.1, 9))
def test_a_peak_is_the_line_of_its_wall_in_the_image(
    heading: float, thesis: ThesisExtractors
) -> None:
    pose = np.array([-0.6, 2.4, heading])
    finding = wall((LEFT, 0.7), (LEFT, 4.9), pose)
    theta, distance = peak(finding, thesis.hough)
    middle, scale = thesis.hough.size // 2, thesis.hough.resolution
    for x, y in finding.end_points:
        column, row = middle - y / scale, middle + x / scale  # thesis Eq. 4.13
        assert column * math.cos(theta) + row * math.sin(theta) == pytest.approx(distance)
    assert -1e-6 < theta < math.pi


def test_detected_walls_are_cells_above_the_threshold(
    arena: list[SceneSnapshot], thesis: ThesisExtractors
) -> None:
    for snapshot in arena[::10]:
        seen = detect(snapshot, thesis.hough)
        white = pixels(snapshot.scan.points[usable(snapshot.scan)], thesis.hough)
        votes, thetas, distances = accumulator(white, thesis.hough)
        for finding in (*seen.true, *seen.spurious):
            theta, distance = peak(finding, thesis.hough)
            i = int(np.abs(thetas - theta).argmin())
            j = int(np.abs(distances - distance).argmin())
            assert thetas[i] == pytest.approx(theta, abs=1e-6)
            # OpenCV may round to the next cell.
            assert votes[i, j - 1 : j + 2].max() > thesis.hough.threshold - 2


# --------------------------------------------------------------------------- what is drawn


def test_findings_are_drawn_in_the_colour_of_what_they_are(thesis: ThesisExtractors) -> None:
    good, bad = wall((LEFT, 1.0), (LEFT, 3.0)), wall((-1.0, 1.0), (-0.5, 1.2))
    detections = ScanDetections(snapshot_of(), (good,), (bad,))
    for axes in (scan_figure(detections).axes[0], people_figure(detections).axes[1]):
        drawn = {line.get_color(): line.get_xydata() for line in axes.lines if line.get_gid()}
        assert drawn[TRUE] == pytest.approx(np.array([[LEFT, 1.0], [LEFT, 3.0]]))
        assert drawn[SPURIOUS] == pytest.approx(np.array([[-1.0, 1.0], [-0.5, 1.2]]))
    words = [text.get_text() for text in scan_figure(detections).legends[0].get_texts()]
    assert words[-2:] == ["wall, true (1)", "wall, spurious (1)"]
    image, cells, _ = hough_figure(detections, thesis.hough).axes
    assert [line.get_color() for line in image.lines[2:]] == [TRUE, SPURIOUS]
    assert len(cells.lines) == 2


def test_every_figure_is_a_picture_with_a_caption(part: Section) -> None:
    names = [picture.name for picture in part.pictures]
    assert names == [
        "fig11-jumps",
        "fig12-camera",
        "fig13-spurious-cylinders",
        "fig14-filtered-cylinders",
        "fig15-ransac",
        "fig16-ransac-spurious",
        "fig17-hough",
        "fig17-hough-accumulator",
        "fig18-hough-people",
        "fig19-hough-people",
    ]
    for picture in part.pictures:
        assert picture.content[:8] == b"\x89PNG\r\n\x1a\n"
        width, height = struct.unpack(">II", picture.content[16:24])
        assert 500 < width < 1700
        assert 400 < height < 1700
        assert len(picture.caption) > 80
    assert set(part.numbers["scans"]) == set(names)


def test_the_chosen_scans_show_what_the_captions_say(part: Section) -> None:
    seen = part.numbers["scans"]
    assert all(counts["occurs"] for counts in seen.values())
    assert seen["fig11-jumps"]["true"] >= 2
    assert seen["fig11-jumps"]["spurious"] == 0
    assert seen["fig13-spurious-cylinders"]["true"] >= 1
    assert seen["fig13-spurious-cylinders"]["spurious"] >= 2
    assert seen["fig12-camera"]["scan"] == seen["fig13-spurious-cylinders"]["scan"]
    assert seen["fig14-filtered-cylinders"]["scan"] == seen["fig13-spurious-cylinders"]["scan"]
    assert seen["fig15-ransac"]["true"] >= 3
    assert seen["fig15-ransac"]["spurious"] == seen["fig15-ransac"]["doubles"] == 0
    assert seen["fig16-ransac-spurious"]["long_spurious"] >= 1
    assert seen["fig17-hough"]["scan"] == seen["fig16-ransac-spurious"]["scan"]
    assert seen["fig18-hough-people"]["on_legs"] > 20
    assert seen["fig19-hough-people"]["on_legs"] > 20


def test_the_filter_keeps_spurious_cylinders_out(part: Section) -> None:
    corridor = part.numbers["runs"]["corridor"]
    assert corridor["low"]["spurious_per_scan"] > 0.1
    assert corridor["filtered"]["spurious_per_scan"] < 0.1 * corridor["low"]["spurious_per_scan"]


@pytest.mark.parametrize("world", WORLDS)
def test_hough_gives_fewer_spurious_walls_and_fewer_true_ones(part: Section, world: str) -> None:
    run = part.numbers["runs"][world]
    for what in ("spurious_per_scan", "long_spurious_per_scan", "true_per_scan"):
        assert run["hough"][what] < run["ransac"][what]


def test_the_result_does_not_depend_on_the_job(part: Section) -> None:
    steps: list[tuple[int, int]] = []
    again = figures(
        Job(seeds=3, processes=2, progress=lambda _, done, total: steps.append((done, total)))
    )
    assert [p.content for p in again.pictures] == [p.content for p in part.pictures]
    assert again.text == part.text
    assert [p.caption for p in again.pictures] == [p.caption for p in part.pictures]
    assert again.numbers == part.numbers
    assert steps == [(0, 3), (1, 3), (2, 3), (3, 3)]
