"""Diagnosis of real logs: sound ones have no harmful findings, and a wrong preset is found."""

import pytest

from impslam.diagnosis.diagnose import initial_findings
from impslam.open_log import open_log

pytestmark = [pytest.mark.real]


def findings(folder, log, preset=None):
    config, source = open_log(folder / log, preset)
    with source:
        return initial_findings(config, source)


@pytest.mark.parametrize(
    "log",
    ["turtlebot3/turtlebot3.bag", "lego-robot4", "urg04lx-encoders/exp1.dat", "intel/intel.log",
     "fr079/fr079.log", "fr101/fr101.recovered.log", "carpark", "mrclam6"],
)  # fmt: skip
def test_sound_logs_have_no_findings(data_folder, log):
    assert findings(data_folder, log) == []


@pytest.mark.parametrize("preset", ["imp", "mines-rover", "lego-robot4"])
def test_another_robots_preset(data_folder, preset):
    (only,) = findings(data_folder, "turtlebot3/turtlebot3.bag", preset)
    assert only.kind == "wrong preset"
    assert only.advice.endswith("-c turtlebot3-waffle")
