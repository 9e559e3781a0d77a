"""The numbers of a comparison as JSON, including some that the tables do not show."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

from impslam.evaluation.relations import RelationErrors
from impslam.evaluation.scores import KindScore, PathScore


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
