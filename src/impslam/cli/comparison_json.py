"""The numbers of a comparison as JSON, including some that the tables do not show."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from impslam.errors import ConfigError
from impslam.evaluation.json_values import json_values
from impslam.evaluation.relations import RelationErrors
from impslam.evaluation.scores import KindScore, PathScore
from impslam.paths import replacement, written


def write_json(path: Path, facts: Mapping[str, Any]) -> None:
    """Write numbers as JSON; unknown values are null.

    Raises
    ------
    ConfigError
        If the file cannot be written.
    """
    text = json.dumps(json_values(facts), indent=2, ensure_ascii=False, allow_nan=False) + "\n"
    with written(path, "choose another path", ConfigError), replacement(path) as stream:
        stream.write(text.encode())


def path_facts(score: PathScore) -> dict[str, Any]:
    """Return the figures of a path; lengths in m, angles in rad."""
    return {
        "T_truth_map": score.T_truth_map.tolist(),
        "ate_given_m": score.given,
        "ate_m": score.aligned,
        "heading_rad": score.heading,
        "rpe_m": score.rpe_metres,
        "rpe_rad": score.rpe_radians,
        "nees": score.consistency,
    }


def kind_facts(scores: Sequence[KindScore]) -> dict[str, Any]:
    """Return the figures of landmarks by kind; lengths in m, angles in rad."""
    return {
        score.kind: {
            "true": score.true,
            "missing": score.missing,
            "false": score.false,
            "doubles": score.doubles,
            "distance_m": score.distance,
            "angle_rad": score.angle,
            "nees": score.nees,
        }
        for score in scores
    }


def relation_facts(errors: RelationErrors) -> dict[str, Any]:
    """Return the figures of relations; lengths in m, angles in rad."""
    return {
        "missing": errors.missing,
        "translation_m": {**asdict(errors.metres), "std": float(errors.translation.std())},
        "rotation_rad": {**asdict(errors.radians), "std": float(errors.rotation.std())},
    }
