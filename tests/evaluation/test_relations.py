"""Relation errors, and the same figures as the suite's own formula on real relations."""

import importlib.util

import numpy as np
import pytest

from impslam.errors import ImpError
from impslam.evaluation.relations import read_relations, relation_errors
from impslam.evaluation.trajectory import associate, ate
from impslam.evaluation.tum import read_tum, write_tum
from impslam.geometry.se2 import between, compose


def path(n=200, seed=3):
    rng = np.random.default_rng(seed)
    heading = np.cumsum(rng.normal(0, 0.1, n))
    steps = 0.1 * np.c_[np.cos(heading), np.sin(heading)]
    return np.c_[0.2 * np.arange(n), np.cumsum(steps, axis=0), heading]


def relations_of(rows, rng, n=50):
    i, j = rng.integers(0, len(rows), (2, n))
    return np.c_[rows[i, 0], rows[j, 0], between(rows[i, 1:], rows[j, 1:])]


def test_a_perfect_path_in_any_frame_has_no_error(rng):
    rows = path()
    relations = relations_of(rows, rng)
    moved = np.c_[rows[:, 0], compose(np.array([3.0, -4.0, 2.0]), rows[:, 1:])]
    errors = relation_errors(moved[::-1], relations)
    assert errors.missing == 0
    assert errors.metres.max < 1e-9
    assert errors.radians.max < 1e-9


def test_errors_are_those_of_the_relative_pose(rng):
    rows = path()
    relations = relations_of(rows, rng)
    relations[:, 2] += 0.03
    relations[:, 4] -= 0.02
    errors = relation_errors(rows, relations)
    np.testing.assert_allclose(errors.translation, 0.03)
    np.testing.assert_allclose(errors.rotation, 0.02)


def test_relations_without_poses_are_counted(rng):
    relations = relations_of(path(), rng)
    relations[:7, 1] += 1e4
    assert relation_errors(path(), relations).missing == 7
    with pytest.raises(ImpError, match="no relation is within"):
        relation_errors(path(), relations + np.array([1e5, 0, 0, 0, 0]))


def test_bad_files_are_one_line(tmp_path):
    (tmp_path / "a.relations").write_text("1 2 3\n")
    with pytest.raises(ImpError, match=r"line 1: expected stamp1 stamp2"):
        read_relations(tmp_path / "a.relations")
    (tmp_path / "a.relations").write_text("")
    with pytest.raises(ImpError, match="contains no relation"):
        read_relations(tmp_path / "a.relations")


@pytest.fixture
def reference(data_folder):
    """The formula as it stands beside the data."""
    file = data_folder.parent / "tools" / "relations.py"
    if not file.exists():
        pytest.skip(f"needs the reference formula {file}")
    spec = importlib.util.spec_from_file_location("reference_relations", file)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.real
@pytest.mark.parametrize("name", ["intel", "fr079"])
def test_real_relations_give_the_reference_figures(data_folder, reference, tmp_path, name):
    file = data_folder / name / f"{name}.relations"
    relations = read_relations(file)
    stamps = np.unique(relations[:, :2])
    rows = path(len(stamps))
    rows[:, 0] = stamps + 0.01
    write_tum(tmp_path / "a.tum", rows[5:])
    ours = relation_errors(read_tum(tmp_path / "a.tum"), relations)
    theirs = reference.relations(tmp_path / "a.tum", file)
    assert (len(ours.translation), ours.missing) == (theirs["n"], theirs["missing"])
    assert ours.metres.mean == pytest.approx(theirs["trans_mean"], rel=1e-6)
    assert ours.metres.rmse**2 == pytest.approx(theirs["trans_sq"], rel=1e-6)
    assert ours.metres.max == pytest.approx(theirs["trans_max"], rel=1e-6)
    assert np.degrees(ours.radians.mean) == pytest.approx(theirs["rot_mean"], rel=1e-6)
    assert np.degrees(ours.rotation.std()) == pytest.approx(theirs["rot_std"], rel=1e-6)


@pytest.mark.real
def test_the_absolute_error_is_the_reference_figure(reference, tmp_path, rng):
    truth = path()
    estimate = (
        path()[10:-10:2] + [0.05, 3.0, -2.0, 0.4] + 0.05 * rng.normal(size=(90, 4)) * [0, 1, 1, 1]
    )
    write_tum(tmp_path / "truth.tum", truth)
    write_tum(tmp_path / "estimate.tum", estimate)
    theirs = reference.ate(tmp_path / "estimate.tum", tmp_path / "truth.tum")
    pairs = associate(read_tum(tmp_path / "estimate.tum"), read_tum(tmp_path / "truth.tum"))
    ours = ate(pairs)
    assert ours.count == theirs["n"]
    assert ours.rmse == pytest.approx(theirs["rmse"], rel=1e-6)
    assert ours.max == pytest.approx(theirs["max"], rel=1e-6)
