"""The map as a value: it moves with its keyframes, and comes back from its file as it was."""

import errno
import io
import json
import zipfile
from dataclasses import fields, replace
from itertools import chain
from pathlib import Path

import numpy as np
import pytest

from impslam.columns import Sweeps
from impslam.errors import ConfigError, ImpError
from impslam.geometry.se2 import compose
from impslam.map import Keyframe, Map, Revision, Track
from impslam.map_builder import MapBuilder, blended
from impslam.maps.grid import OccupancyGrid
from impslam.maps.layout import layout, undriven
from impslam.types import NO_COVARIANCE, NO_EDGES, Edges, Increment, Landmark, Observation, Scan

EYE, ZERO = np.eye(3), np.zeros(3)
EDGES = Edges(
    np.array([0, 2]),
    np.array([1, 0]),
    np.array([[1.0, 0.0, 0.1], [-2.0, 1.0 / 3.0, 0.0]]),
    np.array([EYE, 4.0 * EYE]),
    np.array([np.inf, 25.0]),
)
JOINT = np.arange(16.0).reshape(4, 4)
WALL = Landmark(
    3,
    "wall",
    np.array([0.1, 1.0 / 3.0]),
    {"r": 0.1, "alpha": 2.0},
    1e-4 * np.eye(2),
    np.array([[0.0, 1.0], [2.0, 3.0]]),
    5,
    0.5,
    1e9 + 0.1,
)
POST = Landmark(
    7, "cylinder", np.array([1.0, -2.0]), {"x": 1.0, "y": -2.0}, np.eye(2), None, 1, 0.0, 1.0
)

SEEN = (
    (
        Observation("wall", np.array([1.0, 0.5]), 1e-4 * EYE[:2, :2], end_points=EYE[:2, :2]),
        Observation("post", np.array([0.1, 0.2]), EYE[:2, :2], attributes={"radius": 0.15}),
    ),
    (),
    (Observation("post", np.array([0.1, 0.2]), 1e-4 * EYE[:2, :2], label=7, delay=0.01),),
)


def scan(n=4):
    """Return a scan of n beams of which the first is not valid."""
    points, valid = np.arange(2.0 * n).reshape(n, 2), np.arange(n) > 0
    many = np.zeros((n, 2))
    return Scan(
        *(0.0, np.zeros(n), np.ones(n), valid, points, many, many, np.ones(n), 0.0, 10.0),
        np.array([0.1, 0.2, 0.3]),
    )


def no_sweeps():
    return Sweeps("lidar", None, None, None, None, None, None)


def keyframe(k, points=4):
    motion = Increment(float(k), ZERO, 0.01 * EYE, 1.0)
    odometry = np.array([float(k), 0.0, 0.0])
    return Keyframe(
        *(k, float(k), motion, odometry, ZERO, 0.0 * EYE, no_sweeps(), 0), scan=scan(points)
    )


def track(anchor, m=2):
    stamps = anchor + (1.0 + np.arange(m)) / (m + 1)
    steps = np.column_stack([0.1 * (1.0 + np.arange(m)), np.zeros((m, 2))])
    spread = np.broadcast_to(1e-4 * EYE, (m, 3, 3))
    return Track(
        *(anchor, stamps, steps, spread, steps, no_sweeps(), slice(0, m)),
        *(np.zeros(m, bool), np.zeros(m, np.int8), np.zeros(m), None),
    )


def revision(ids, poses):
    return Revision(np.array(ids), np.array(poses, float), np.tile(1e-3 * EYE, (len(ids), 1, 1)))


def built(keyframes=3):
    """Return a builder with keyframes at x = 0, 1, 2, ... and two sweeps after each."""
    builder = MapBuilder()
    for k in range(keyframes):
        builder.revise(keyframe(k), revision([k], [[float(k), 0.0, 0.0]]))
        builder.follow(track(k))
    return builder


def same(one, two):
    for part in fields(one):
        a, b = getattr(one, part.name), getattr(two, part.name)
        if isinstance(a, np.ndarray):
            assert a.dtype == b.dtype
            assert a.tobytes() == b.tobytes(), part.name
            assert a.shape == b.shape
        elif part.name == "keyframes":
            same(a, b)
        elif part.name == "edges":
            assert [(c.dtype, c.tobytes()) for c in a] == [(c.dtype, c.tobytes()) for c in b]
        elif part.name == "landmarks":
            for mark, other in zip(a, b, strict=True):
                same(mark, other)
        elif part.name == "observations" and isinstance(one, Map):
            assert [len(keyframe) for keyframe in a] == [len(keyframe) for keyframe in b]
            for seen, other in zip(chain(*a), chain(*b), strict=True):
                same(seen, other)
        else:
            assert a == b, part.name


# --------------------------------------------------------------------------- the past can move


def driven(turn=0.3):
    """Return a builder with keyframes at 0, 1, 2 s on an arc, two sweeps after each, all exact."""
    builder, step = MapBuilder(), np.array([0.3, 0.0, turn])
    poses = [ZERO, step, compose(step, step)]
    for k, pose in enumerate(poses):
        motion = Increment(float(k), step if k else ZERO, 0.01 * EYE, 1.0)
        builder.revise(replace(keyframe(k), motion=motion), revision([k], [pose]))
        part = replace(track(k), T_anchor_base=np.array([0.3, 0.7])[:, None] * step)
        builder.follow(part)
    return builder, np.array(poses)


def test_blending_changes_nothing_where_keyframes_did_not_move_against_each_other():
    builder, poses = driven()
    known = builder.map()
    np.testing.assert_allclose(blended(known).path(), known.path(), atol=1e-12)
    rigid = compose(np.array([3.0, -2.0, 2.8]), poses)
    moved = known.revised(revision([0, 1, 2], rigid))
    np.testing.assert_allclose(blended(moved).path(), moved.path(), atol=1e-12)


def test_sweeps_before_a_motion_that_is_not_finite_stay_with_their_keyframe():
    builder, _ = driven()
    motion = Increment(3.0, np.full(3, np.nan), EYE, 1.0)
    builder.revise(replace(keyframe(3), motion=motion), revision([3], [ZERO]))
    known = builder.map()
    np.testing.assert_allclose(blended(known).path(), known.path(), atol=1e-12)


def test_blended_sweeps_leave_no_step_before_a_keyframe():
    builder, poses = driven(turn=0.0)
    shift = np.array([0.0, 0.1, 0.0])
    known = builder.map().revised(revision([0, 1, 2], poses + np.outer([0, 1, 2], shift)))
    path, plain = blended(known).path(), known.path()
    keys = [0, 3, 6]
    np.testing.assert_allclose(path[keys], plain[keys], atol=1e-12)
    np.testing.assert_allclose(path[1:3, 2], [0.03, 0.07], atol=1e-12)
    np.testing.assert_allclose(plain[1:3, 2], 0.0, atol=1e-12)
    np.testing.assert_allclose(path[7:], plain[7:], atol=1e-12)  # no keyframe follows


def test_keyframes_that_move_take_their_sweeps_along():
    builder = built()
    moved = [[9.0, 1.0, np.pi / 2], [2.5, 0.0, 0.0], [3.0, 0.0, 0.0]]
    builder.revise(keyframe(3), revision([0, 2, 3], moved))
    known = builder.map()
    np.testing.assert_allclose(known.keyframes.poses[:, 0], [9.0, 1.0, 2.5, 3.0])
    path = known.path()[:, 1:]
    np.testing.assert_allclose(path[0], moved[0], atol=1e-12)
    np.testing.assert_allclose(path[1], compose(np.array(moved[0]), np.array([0.1, 0, 0])))
    np.testing.assert_allclose(path[3:6, 0], [1.0, 1.1, 1.2])
    np.testing.assert_allclose(path[6:9, 0], [2.5, 2.6, 2.7])
    np.testing.assert_allclose(known.live_path()[:3, 1], [0.0, 0.1, 0.2])  # as it was at the time
    assert (np.linalg.eigvalsh(known.rows().covariances) > 0.0).all()


def test_tracks_after_a_revision_hang_on_the_moved_keyframe():
    builder = built()
    builder.revise(keyframe(3), revision([3, 0], [[5.0, 2.0, 0.0], [1.0, 1.0, 0.0]]))
    np.testing.assert_allclose(builder.follow(track(3)).poses, [[5.1, 2, 0], [5.2, 2, 0]])


def test_what_was_given_out_before_does_not_change():
    builder = built()
    early, keyframes = builder.map(), builder.keyframes()
    path, cells = early.path().tobytes(), early.grid().logodds.tobytes()
    poses = keyframes.poses.tobytes()
    for k in range(3, 200):  # beyond the room that is set aside
        far = [[50.0, 50.0, 1.0], [float(k), 0.0, 0.0]]
        builder.revise(keyframe(k), revision([0, k], far))
        builder.follow(track(k))
    assert early.path().tobytes() == path
    assert early.grid().logodds.tobytes() == cells
    assert keyframes.poses.tobytes() == poses
    assert builder.map().grid().logodds.size > early.grid().logodds.size


def test_values_given_out_are_read_only():
    known = built().map()
    with pytest.raises(ValueError, match="read-only"):
        known.keyframes.poses[0] = 1.0
    with pytest.raises(ValueError, match="read-only"):
        known.live_poses[0] = 1.0


# --------------------------------------------------------------------------- the file


@pytest.fixture
def known():
    about = {"log": "büro.mcap", "counts": {"scans": 9}, "start": [0.5, None, True]}
    return replace(
        built().map(),
        landmarks=(WALL, POST),
        landmark_covariance=JOINT,
        edges=EDGES,
        observations=SEEN,
        about=about,
    )


@pytest.fixture
def file(known, tmp_path):
    return known.save(tmp_path / "office.imp")


def test_a_map_comes_back_to_the_byte(known, file, tmp_path):
    back = Map.load(str(file))
    same(known, back)
    assert back.path().tobytes() == known.path().tobytes()
    assert back.grid().logodds.tobytes() == known.grid().logodds.tobytes()
    assert back.save(tmp_path / "again.imp").read_bytes() == file.read_bytes()
    assert back.landmarks[0].parameters == WALL.parameters
    assert back.landmarks[1].end_points is None


def test_edges_join_keyframes_and_keep_their_kernels(file):
    edges = Map.load(file).edges
    assert edges.i.tolist() == [0, 2]
    assert edges.j.tolist() == [1, 0]
    assert edges.kernel.tolist() == [np.inf, 25.0]
    np.testing.assert_array_equal(edges.information, EDGES.information)


def of_version(file, version, about):
    """Rewrite a map's file as one of an older version, and return the map in it."""
    wanted = layout(version)
    with np.load(file) as whole:
        missing = [name for name in whole.files if name not in wanted and name != "about"]
    rewritten(file, {"about": text({"version": version, "about": about})}, missing=missing)
    return Map.load(file)


def test_a_file_of_version_3_has_no_joint_covariance(known, file):
    back = of_version(file, 3, known.about)
    same(replace(known, landmark_covariance=NO_COVARIANCE), back)


@pytest.mark.parametrize("version", [1, 2])
def test_a_file_of_an_older_version_tells_motions_by_its_poses(known, file, version):
    """The first one has no edges, and neither has motions, sessions or observations."""
    keyframes, back = known.keyframes, of_version(file, version, known.about)
    before = replace(keyframes, **undriven(keyframes.poses))
    expected = replace(
        known,
        keyframes=before,
        tracked=known.T_anchor_base,
        observations=(),
        landmark_covariance=NO_COVARIANCE,
    )
    same(replace(expected, edges=NO_EDGES) if version == 1 else expected, back)
    driven = back.keyframes.motions
    np.testing.assert_allclose(compose(keyframes.poses[:-1], driven[1:]), keyframes.poses[1:])


def test_an_empty_map_comes_back(tmp_path):
    empty = MapBuilder().map()
    same(empty, Map.load(empty.save(tmp_path / "empty.imp")))


def test_arrays_that_lie_by_columns_are_written_by_rows(known, tmp_path):
    turned = replace(known, live_poses=np.asfortranarray(known.live_poses))
    back = Map.load(turned.save(tmp_path / "turned.imp"))
    np.testing.assert_array_equal(back.live_poses, known.live_poses)


def test_any_program_that_reads_npz_reads_a_map(known, file):
    with np.load(file) as arrays:
        np.testing.assert_array_equal(arrays["keyframes/poses"], known.keyframes.poses)


def test_a_file_that_cannot_be_written_is_told_and_leaves_the_old_one(known, file, tmp_path):
    with pytest.raises(ImpError, match="cannot be written"):
        known.save(tmp_path / "gone" / "office.imp")
    with pytest.raises(ImpError, match="cannot be written"):
        known.save(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == [file.name]


def test_a_map_replaces_no_file_that_is_not_a_map(known, file, tmp_path):
    notes = tmp_path / "notes.txt"
    notes.write_text("mine")
    with pytest.raises(
        ConfigError, match=r"notes\.txt: exists and is not a map; give another path"
    ):
        known.save(notes)
    assert notes.read_text() == "mine"
    assert known.save(file) == file


def test_on_a_full_disk_the_advice_is_one_that_a_robots_user_can_follow(
    known, tmp_path, monkeypatch
):
    """The page of a robot shows it, and offers no other folder."""

    def fail(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("impslam.maps.archive._write", fail)
    with pytest.raises(ImpError, match=r"\(No space left on device\); free disk space or check"):
        known.save(tmp_path / "map.imp")


def refuses(path, said=""):
    with pytest.raises(ImpError) as error:
        Map.load(path)
    text = str(error.value)
    assert text.startswith(f"{path}: ")
    assert "\n" not in text
    assert len(text) < 300 + len(str(path))
    assert said in text


def test_a_file_that_is_not_there_is_told(tmp_path):
    refuses(tmp_path / "gone.imp", "no such file")
    refuses(tmp_path, "is a folder; give the file of a map")
    refuses(tmp_path / ("a" * 300), "no such file")


def test_a_file_that_may_not_be_read_is_told(file, monkeypatch):
    def refused(*_):
        raise PermissionError(errno.EACCES, "Permission denied")

    monkeypatch.setattr(Path, "open", refused)  # a superuser may read any
    refuses(file, "cannot be read (Permission denied); check permissions")


def test_wrong_arguments_are_told(known):
    with pytest.raises(ImpError, match="path = None: expected the path of a map's file"):
        Map.load(None)
    np.testing.assert_array_equal(
        known.moved([1, 2, 3]).path(), known.moved(np.array([1.0, 2, 3])).path()
    )
    with pytest.raises(ImpError, match="T has shape"):
        known.moved([1.0, 2.0])


@pytest.mark.parametrize("content", [b"", b"hello", b"PK\x03\x04", b"\0" * 1000])
def test_what_is_no_zip_is_no_map(tmp_path, content):
    (tmp_path / "x.imp").write_bytes(content)
    refuses(tmp_path / "x.imp", "not a map, or damaged")


def test_a_file_cut_anywhere_is_told(file):
    whole = file.read_bytes()
    for size in range(0, len(whole), 37):
        file.write_bytes(whole[:size])
        refuses(file, "not a map, or damaged")


def test_a_flipped_byte_is_told_or_harmless(known, file):
    """Bytes that nothing reads, such as dates, are the only ones that may differ."""
    whole, told = file.read_bytes(), []
    for place in range(0, len(whole), 13):
        spoilt = bytearray(whole)
        spoilt[place] ^= 0x55
        file.write_bytes(spoilt)
        try:
            back = Map.load(file)
        except ImpError as error:
            told.append(str(error))
        else:
            same(back, known)
    assert not any("\n" in line for line in told)
    assert len(told) > 0.7 * len(whole) / 13


def rewritten(file, changes=None, compression=zipfile.ZIP_STORED, missing=()):
    """Write a map's file again with other arrays."""
    with np.load(file) as old:
        arrays = {name: old[name] for name in old.files}
    arrays |= changes or {}
    with zipfile.ZipFile(file, "w", compression) as packed:
        for name, array in arrays.items():
            if name in missing:
                continue
            stream = io.BytesIO()
            np.lib.format.write_array(stream, np.asarray(array), allow_pickle=True)
            packed.writestr(f"{name}.npy", array if isinstance(array, bytes) else stream.getvalue())


def text(value):
    return np.frombuffer(json.dumps(value).encode(), np.uint8)


def test_a_compressed_file_is_refused(file):
    rewritten(file, compression=zipfile.ZIP_DEFLATED)
    refuses(file, "about is compressed")


@pytest.mark.parametrize(
    "name", ["about", "stamps", "keyframes/starts", "landmarks", "edges/kernel"]
)
def test_what_is_missing_is_named(file, name):
    rewritten(file, missing=[name])
    refuses(file, f"it lacks {name}")


class Evil:
    def __reduce__(self):
        return print, ("this must not run",)


WRONG = [
    ("stamps", np.array([Evil()], dtype=object), "stamps holds object"),
    ("stamps", np.zeros(9, np.float32), "stamps holds float32, expected float64"),
    ("stamps", np.zeros(9, ">f8"), "stamps holds >f8"),
    ("stamps", np.zeros((9, 1)), "stamps has shape (9, 1)"),
    ("anchors", np.zeros(8, np.int64), "anchors has shape (8,)"),
    ("anchors", np.full(9, 3), "anchors are not keyframes"),
    ("anchors", np.full(9, -1), "anchors are not keyframes"),
    ("T_anchor_base", np.zeros((9, 4)), "T_anchor_base has shape (9, 4)"),
    ("live_poses", np.float64(1.0), "live_poses has shape ()"),
    ("live_poses", np.asfortranarray(np.ones((9, 3))), "by rows"),
    ("keyframes/points", np.zeros((8, 2), np.float32), "starts does not fit"),
    ("keyframes/starts", np.array([0, 99, 6, 9]), "starts decreases"),
    ("keyframes/starts", np.array([-5, 3, 6, 9]), "starts does not fit"),
    ("keyframes/starts", np.zeros(0, np.int64), "starts does not fit"),
    ("edges/i", np.array([0, 3]), "edges do not join two keyframes"),
    ("edges/j", np.array([-1, 0]), "edges do not join two keyframes"),
    ("edges/j", np.array([0, 0]), "edges do not join two keyframes"),
    ("edges/j", np.array([1, 0, 1]), "edges/j has shape (3,)"),
    ("edges/T_i_j", np.full((2, 3), np.nan), "edges are not finite"),
    ("edges/information", np.full((2, 3, 3), np.inf), "edges are not finite"),
    ("edges/information", np.ones((2, 3)), "edges/information has shape (2, 3)"),
    ("edges/kernel", np.array([np.nan, 1.0]), "edges/kernel is not positive"),
    ("landmarks", text([{"id": 1}]), "missing"),
    ("landmarks", text([7]), ""),
    ("landmarks", text({}), "landmark_covariance does not fit the landmarks"),
    ("landmarks", np.frombuffer(b"[" * 100_000, np.uint8), ""),
    ("about", np.frombuffer(b"[" * 100_000, np.uint8), ""),
    ("about", text({"about": {}}), "version"),
    ("about", text({"version": 1}), "about"),
    ("about", text({"version": 0, "about": {}}), "no version 0"),
    ("about", text({"version": [], "about": {}}), ""),
    ("about", text({"version": 9, "about": {}}), "is of version 9, this program reads up to 4"),
    ("tracked", np.zeros((8, 3)), "tracked has shape (8, 3)"),
    ("keyframes/placed", np.ones(3, np.int8), "keyframes/placed holds int8, expected bool"),
    ("keyframes/sessions", np.array([0, 2, 2]), "sessions do not count up"),
    ("keyframes/sessions", np.array([1, 1, 1]), "sessions do not count up"),
    ("keyframes/poses", np.full((3, 3), np.nan), "keyframes/poses is not finite"),
    ("keyframes/motion_covariances", -np.ones((3, 3, 3)), "are not covariances"),
    ("keyframes/motion_covariances", np.full((3, 3, 3), np.triu(EYE + 1.0)), "are not covariances"),
    ("observations/counts", np.array([2, 9, 0]), "counts does not fit"),
    ("observations/counts", np.array([3]), "counts does not fit"),
    ("observations/counts", np.array([-1, 4, 0]), "counts does not fit"),
    ("observations/sizes", np.array([2, 2, 1 << 62]), "z does not have the length"),
    ("observations/sizes", np.array([2, 2, -2]), "z does not have the length"),
    ("observations/kinds", np.array([0, 1, 2]), "kinds are not named"),
    ("observations/R", np.zeros(11), "attributes does not have the length"),
    ("observations/names", text([]), ""),
    ("landmark_covariance", np.eye(3), "landmark_covariance does not fit the landmarks"),
    ("landmark_covariance", np.eye(4)[:3], "landmark_covariance has shape (3, 4)"),
    ("landmark_covariance", np.full((4, 4), np.nan), "landmark_covariance is not finite"),
    ("landmark_covariance", np.array([[Evil()]], dtype=object), "landmark_covariance holds object"),
    ("about", text([]), ""),
]


@pytest.mark.parametrize(("name", "array", "said"), WRONG)
def test_a_wrong_part_is_refused_in_one_line(file, name, array, said, capsys):
    rewritten(file, {name: array})
    refuses(file, said)
    assert capsys.readouterr().out == ""


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("position", [1.0]),
        ("position", None),
        ("covariance", [[1.0, 0.0]]),
        ("covariance", 3.0),
        ("end_points", [[1.0, 2.0]]),
        ("kind", 3),
        ("parameters", [1]),
        ("id", "x"),
        ("first_stamp", None),
        ("colour", "red"),
    ],
)
def test_a_wrong_landmark_is_refused_in_one_line(file, field, value):
    with np.load(file) as old:
        marks = json.loads(old["landmarks"].tobytes())
    marks[0][field] = value
    rewritten(file, {"landmarks": text(marks)})
    refuses(file, "not a map, or damaged")


def test_memory_is_not_taken_by_a_lie(file):
    """An array says that it has 10^15 rows; nothing of that size is asked for."""
    stream = io.BytesIO()
    np.lib.format.write_array_header_1_0(
        stream, {"descr": "<f8", "fortran_order": False, "shape": (10**15,)}
    )
    rewritten(file, {"stamps": stream.getvalue() + bytes(72)})
    refuses(file, "stamps has another length than declared")


def test_a_keyframe_that_is_placed_later_is_drawn(known):
    keyframes, grid, whole = known.keyframes, OccupancyGrid(), OccupancyGrid()
    late = np.arange(len(keyframes)) != 1
    replace(keyframes, placed=late).draw(grid)
    keyframes.draw(grid)
    keyframes.draw(whole)
    np.testing.assert_array_equal(grid.logodds, whole.logodds)


def test_some_keyframes_take_their_points_along():
    known = built(4).map().keyframes
    some = known.take(np.array([3, 1]))
    assert some.stamps.tolist() == [3.0, 1.0]
    for k, row in enumerate((3, 1)):
        own = some.points[some.starts[k] : some.starts[k + 1]]
        np.testing.assert_array_equal(own, known.points[known.starts[row] : known.starts[row + 1]])
    assert len(known.take(np.empty(0, np.int64))) == 0
