"""Parts of a recorded drive, mapped by themselves and merged. Figures were measured on 2026-11-22."""

import pytest
from benchmarks.merging import cut

from impslam.evaluation.relations import read_relations, relation_errors
from impslam.maps.merge import NotMergedError, merged
from impslam.run import run

pytestmark = [pytest.mark.real]


def test_two_parts_merged_are_as_right_as_the_whole(data_folder, tmp_path):
    log = data_folder / "fr079" / "fr079.log"
    known = merged(*(run(part) for part in cut(log, tmp_path, 2, 0.0)))
    relations = read_relations(data_folder / "fr079" / "fr079.relations")
    errors = relation_errors(known.path(), relations)
    assert errors.missing == 0
    assert errors.translation.mean() < 0.0443  # 0.0401; 1.1 times that of the whole drive
    assert errors.translation.max() < 0.5  # 0.20


def test_two_buildings_are_not_merged(data_folder):
    office = run(data_folder / "urg04lx-encoders" / "exp1.dat")
    other = run(data_folder / "lego-robot4")
    with pytest.raises(NotMergedError, match="map 2"):
        merged(office, other)
