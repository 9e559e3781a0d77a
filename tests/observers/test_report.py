"""The report is one page that needs nothing else, for any run."""

import math
import re
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest
from tests.observers import runs

from impslam.evaluation.landmarks import transform_landmarks
from impslam.evaluation.quality import Quality
from impslam.observers.accuracy import align_truth
from impslam.observers.base import Dropped
from impslam.observers.history import History
from impslam.observers.page import ChartLine, chart
from impslam.observers.quality_section import quality_section
from impslam.observers.recorder import Recorder
from impslam.observers.run_folder import write_run
from impslam.observers.sections import duration, matching
from impslam.observers.summary import real_time_factor
from impslam.types import TrueLandmark, TruePose

VOID = {"meta", "img", "path", "br", "input"}


class Balanced(HTMLParser):
    """Checks that every tag is closed in its turn."""

    def __init__(self):
        super().__init__()
        self.open = []

    def handle_starttag(self, tag, attrs):
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        if tag not in VOID:
            assert self.open.pop() == tag


def true_landmarks():
    wall = {"r": 3.0, "alpha": 0.0}
    ends = np.array([[3.0, -2.0], [3.0, 4.0]])
    return [
        TrueLandmark("column", "cylinder", np.array([0.0, 1.0]), {"radius": 0.1}),
        TrueLandmark("east", "wall", np.array([3.0, 0.0]), wall, ends),
        TrueLandmark("gone", "cylinder", np.array([2.0, 2.0]), {"radius": 0.1}),
    ]


def write(folder, n=50, truth=None, outcome=None, true_landmarks=(), landmarks=None):
    runs.play([Recorder(folder, true_landmarks)], n, truth, outcome, landmarks)
    assert (folder / "report.png").read_bytes().startswith(b"\x89PNG")
    text = (folder / "report.html").read_text()
    checker = Balanced()
    checker.feed(text)
    assert checker.open == []
    return text


def test_the_page_needs_no_network(tmp_path):
    text = write(tmp_path, truth=runs.make_truth(), true_landmarks=true_landmarks())
    assert not re.search(r"https?://|<script[^>]* src|<link|@import|url\(|fetch\(|import\(", text)
    assert '"data:image/png;base64,' in text
    assert 'name="viewport"' in text
    assert "prefers-color-scheme: dark" in text


def test_the_report_lists_landmarks_and_dropped_data(tmp_path):
    text = write(tmp_path)
    for words in ("room.log", "1 cylinder, 1 wall", "250×", "nan ranges", "track = 0.3"):
        assert words in text
    assert "Errors against the truth" not in text


def test_an_unknown_duration_of_the_log_is_no_number(tmp_path):
    text = write(tmp_path, outcome=runs.make_outcome(log_seconds=math.nan))
    tiles = text[text.index("Duration") : text.index("<section")]
    assert "unknown" in tiles
    assert re.search(r"\d ms", tiles)
    assert "nan" not in tiles


def test_text_from_a_log_is_escaped(tmp_path):
    assert "all &lt;NaN&gt;; check" in write(tmp_path)


def test_errors_are_shown_where_the_truth_is_known(tmp_path):
    text = write(tmp_path, truth=runs.make_truth(), true_landmarks=true_landmarks())
    assert "Errors against the truth" in text
    assert "2 of 3 found, 0 false, 0 double" in text
    assert "missing" in text
    assert "NEES" in text


@pytest.mark.parametrize("frame", [(40.0, -7.0, 2.0), (0.03, -0.01, 0.03)])
def test_a_truth_in_its_own_frame_is_aligned_at_the_start(tmp_path, frame):
    """Also one of a robot that was put on the origin of the tracking system, by hand."""
    figure = re.compile(r'From the start</div><div class="figure">([^<]+)<')
    here = write(tmp_path, truth=runs.make_truth())
    there = write(tmp_path, truth=runs.make_truth(frame=frame))
    assert figure.search(here).group(1) == figure.search(there).group(1)
    assert "It is given in the map frame." in here
    assert "It is aligned with the map at the first pose" in there


@pytest.mark.parametrize(("sigma", "how"), [(0.02, "map"), (1e-4, "start")])
def test_a_truth_is_in_map_if_the_first_poses_agree_within_their_covariance(sigma, how):
    """After the localisation in a map, the first pose is uncertain; else it defines the map."""
    known = runs.play([], 50)
    covariances = known.keyframes.covariances.copy()
    covariances[0] = sigma**2 * np.eye(3)
    known = replace(known, keyframes=replace(known.keyframes, covariances=covariances))
    truth = [(p.stamp, *p.pose) for p in runs.make_truth(frame=(0.03, 0.0, 0.02))]
    history = History(known, np.array(truth))
    assert align_truth(history).how == how


def test_a_truth_of_another_time_is_left_out(tmp_path):
    late = [runs.TruePose(p.stamp + 1e6, p.pose) for p in runs.make_truth()]
    assert "Errors against" not in write(tmp_path, truth=late)


@pytest.mark.parametrize("n", [0, 1, 2])
def test_a_run_of_hardly_any_scans_has_a_page(tmp_path, n):
    nothing = {"stages": {"estimate": np.empty(0)}, "wall_seconds": 0.0, "counts": {}}
    outcome = runs.make_outcome(n, **nothing)
    page = write(tmp_path, n, runs.make_truth(), outcome, landmarks=())
    assert (
        "No landmark was found.</p>" in page
    )  # scan matching needs none: this is no dead reckoning


def test_the_speed_is_that_without_compiling(tmp_path):
    """50 scans in 5 s of log: 22 s, of which 20 s compile, are 2.5 times real time."""
    slow = runs.make_outcome(wall_seconds=22.0, compile_seconds=20.0)
    assert real_time_factor(slow) == pytest.approx(2.5)
    text = write(tmp_path, outcome=slow)
    assert "real time, 40.00 ms per scan; 20 s compiling, once, not counted" in text
    assert "compiling, once" not in write(tmp_path)


def test_the_report_states_that_everything_was_used(tmp_path):
    text = write(tmp_path, outcome=runs.make_outcome(dropped={}))
    assert "None: all data of the log were used" in text
    many = {f"kind {i}": Dropped(1, "x") for i in range(3)}
    assert "kind 2" in write(tmp_path, outcome=runs.make_outcome(dropped=many))


def test_a_long_run_is_written_small(tmp_path):
    run, results = runs.Scripted(), list(runs.make_results(200))
    for i in range(14000):
        result = replace(results[i % 200], stamp=0.1 * i, scan=None)
        run.step(result, keyframe=i % 10 == 0)
    write_run(tmp_path, run.map(), runs.make_outcome())
    assert (tmp_path / "report.html").stat().st_size < 2e6


def test_history_is_the_map_beside_the_truth():
    known, results = runs.play([], 5), list(runs.make_results(5))
    history = History(known, np.empty((0, 4)))
    np.testing.assert_allclose(history.covariances, [r.covariance for r in results], atol=1e-15)
    np.testing.assert_array_equal(history.odometry[:, 1:], [r.odometry for r in results])
    np.testing.assert_allclose(
        history.sigmas[3], np.sqrt(np.diag(results[3].covariance)), atol=1e-12
    )
    nis = results[2].matches[0].distance2
    assert known.keyframes.innovations[2].tolist() == [1.0, nis, 2.0]


@pytest.mark.parametrize("values", [[0.0, 0.0], [np.nan, np.nan], [1e-9, 2e-9], [-5.0, np.nan]])
def test_charts_of_odd_values(values):
    text = chart("t", np.array([0.0, 1.0]), [ChartLine("", np.array(values))], np.array([1.0, 2.0]))
    assert text.count("tick y") >= 2


def test_an_estimator_without_matches_has_no_charts_of_them():
    known = runs.play([], 5)
    assert "Matches" in matching(History(known, np.empty((0, 4))))
    bare = replace(known.keyframes, innovations=np.zeros((len(known.keyframes), 3)))
    assert matching(History(replace(known, keyframes=bare), np.empty((0, 4)))) == ""


def test_durations_have_readable_units():
    assert duration(7.25) == "7.2 s"
    assert duration(754.0) == "12 min 34 s"
    assert duration(3 * 3600 + 125) == "3 h 02 min"


def positions(**frame):
    return [TruePose(p.stamp, np.array([*p.pose[:2], np.nan])) for p in runs.make_truth(**frame)]


def test_a_truth_without_headings_is_aligned_by_the_best_fit_without_nees(tmp_path):
    text = write(tmp_path, truth=positions(frame=(40.0, -7.0, 2.0)))
    assert "aligned with the map by the best fit of the path" in text
    assert "x error in cm, band" not in text
    for words in ("NEES of the pose", "Heading error", "From the start", "nan cm", "nan°"):
        assert words not in text
    best = re.search(r'Path error \(ATE\)</div><div class="figure">([\d.]+) cm<', text)
    assert float(best.group(1)) < 1.0


def test_true_landmarks_are_given_in_the_frame_of_the_truth(tmp_path):
    frame = np.array([40.0, -7.0, 2.0])
    known = transform_landmarks(frame, true_landmarks())
    text = write(tmp_path, truth=runs.make_truth(frame=frame), true_landmarks=known)
    assert "2 of 3 found, 0 false, 0 double" in text


def test_missing_headings_leave_two_degrees_of_freedom(tmp_path):
    truth = list(runs.make_truth())
    truth[30] = TruePose(truth[30].stamp, np.array([*truth[30].pose[:2], np.nan]))
    assert "position only; ideal 2" in write(tmp_path, truth=truth)


def test_map_quality_is_reported_if_scans_overlap():
    assert quality_section(Quality(*[math.nan] * 7)) == ""
    text = quality_section(Quality(0.02, 0.01, 0.03, 0.015, 0.004, 0.001, 0.9))
    for words in ("disagreement", "2.00 cm", "3.00 cm", "0.4 %", "90.0 %"):
        assert words in text
    assert "-</td>" in quality_section(Quality(0.01, 0.01, math.nan, 0.015, 0.004, 0.001, 0.0))


def test_a_chart_contains_the_rows_of_two_logs_in_either_order():
    stamps = np.array([100.0, 101.0, 102.0, 0.0, 1.0, 2.0])
    drawn = chart("x", stamps, [ChartLine("", np.arange(6.0), "one")])
    assert 'data-begin="0.000000" data-end="102.000000"' in drawn
    (path,) = re.findall(r'class="line one" d="([^"]+)"', drawn)
    across = [float(x) for x in re.findall(r"[ML]([-\d.]+) ", path)]
    assert min(across) == 0.0
    assert max(across) == 1000.0


def test_the_lines_of_two_logs_at_one_time_are_not_joined():
    """Time runs back where a map was continued, by more than stamps jitter."""
    t = np.array([0.0, 50.0, 49.9, 100.0, 0.0, 100.0])
    text = chart("t", t, [ChartLine("", np.arange(6.0), "a")])
    assert re.findall(r'class="line a" d="([^"]*)"', text)[0].count("M") == 2


def test_the_figures_of_a_continued_map_are_those_of_the_log(tmp_path):
    """The path of the map has 50 scans, the log 20 of them in 2 s."""
    outcome = runs.make_outcome(20)
    text = write(tmp_path, outcome=outcome)
    assert ">20<" in text
    assert "10.0 scans/s" in text
    assert "real time, 1.00 ms per scan" in text
