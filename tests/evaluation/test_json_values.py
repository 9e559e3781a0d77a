"""Numbers for other programs: plain, and null where nothing is known."""

import json
import math
from dataclasses import dataclass
from typing import NamedTuple

from impslam.evaluation.json_values import json_values


class Range(NamedTuple):
    low: float
    high: float


@dataclass
class Result:
    name: str
    error: float
    range: Range


def test_everything_becomes_plain_and_what_is_not_finite_null():
    result = Result("ekf", math.nan, Range(1.0, math.inf))
    found = json_values({"rows": (result, [1, math.nan]), "range": Range(-math.inf, 2.0)})
    assert found == {
        "rows": [{"name": "ekf", "error": None, "range": {"low": 1.0, "high": None}}, [1, None]],
        "range": {"low": None, "high": 2.0},
    }
    json.dumps(found, allow_nan=False)
