"""Conversion of observations of keyframes to the columns in a map's file, and back."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from impslam.types import Array, Ints, Observation

Arrays: TypeAlias = dict[str, npt.NDArray[Any]]
Seen: TypeAlias = tuple[tuple[Observation, ...], ...]
"""Observations by keyframe."""


def packed(seen: Sequence[Sequence[Observation]]) -> Arrays:
    """Return observations as arrays, without beam indices, because maps do not contain sweeps."""
    flat = [o for keyframe in seen for o in keyframe]
    kinds = sorted({o.kind for o in flat})
    names = sorted({name for o in flat for name in o.attributes})
    table = json.dumps({"kinds": kinds, "attributes": names})
    return {
        "counts": np.array([len(keyframe) for keyframe in seen], np.int64),
        "kinds": np.array([kinds.index(o.kind) for o in flat], np.int64),
        "sizes": np.array([len(o.z) for o in flat], np.int64),
        "z": np.concatenate([np.empty(0), *(o.z for o in flat)]),
        "R": np.concatenate([np.empty(0), *(o.R.ravel() for o in flat)]),
        "end_points": np.array([_ends(o) for o in flat], float).reshape(-1, 2, 2),
        "labels": np.array([-1 if o.label is None else o.label for o in flat], np.int64),
        "delays": np.array([o.delay for o in flat], float),
        "attributes": np.array(
            [[o.attributes.get(name, math.nan) for name in names] for o in flat], float
        ).ravel(),
        "names": np.frombuffer(table.encode(), np.uint8),
    }


def unpacked(arrays: Arrays) -> Seen:
    """Return packed observations; raise ValueError if the arrays are inconsistent."""
    table = json.loads(arrays["names"].tobytes())
    kinds, names = list(map(str, table["kinds"])), list(map(str, table["attributes"]))
    counts, sizes = arrays["counts"], arrays["sizes"]
    n = len(sizes)
    if (counts < 0).any() or counts.sum() != n:
        raise ValueError("observations/counts does not fit the observations")
    if (sizes < 1).any() or sizes.sum() != len(arrays["z"]):
        raise ValueError("observations/z does not have the length of its sizes")
    if (sizes**2).sum() != len(arrays["R"]) or n * len(names) != len(arrays["attributes"]):
        raise ValueError("observations/R or attributes does not have the length of its sizes")
    if ((arrays["kinds"] < 0) | (arrays["kinds"] >= len(kinds))).any():
        raise ValueError("observations/kinds are not named")
    flat = list(_rows(arrays, kinds, names))
    ends = np.cumsum(counts)
    return tuple(
        tuple(flat[e - c : e]) for c, e in zip(counts.tolist(), ends.tolist(), strict=True)
    )


def _rows(arrays: Arrays, kinds: list[str], names: list[str]) -> list[Observation]:
    sizes = arrays["sizes"]
    z = _split(arrays["z"], sizes)
    R = _split(arrays["R"], sizes**2)
    attributes = arrays["attributes"].reshape(len(sizes), len(names)).tolist()
    ends = arrays["end_points"]
    none = np.asarray(np.isnan(ends).any(axis=(1, 2)))
    return [
        Observation(
            kinds[kind],
            z[k],
            R[k].reshape(len(z[k]), len(z[k])),
            end_points=None if none[k] else ends[k],
            attributes={n: v for n, v in zip(names, attributes[k], strict=True) if not math.isnan(v)},
            label=None if label < 0 else label,
            delay=delay,
        )
        for k, (kind, label, delay) in enumerate(
            zip(
                arrays["kinds"].tolist(), arrays["labels"].tolist(), arrays["delays"].tolist(),
                strict=True,
            )
        )
    ]  # fmt: skip


def _split(flat: Array, sizes: Ints) -> list[Array]:
    return np.split(flat, np.cumsum(sizes)[:-1]) if len(sizes) else []


def _ends(observation: Observation) -> Array:
    ends = observation.end_points
    return np.full((2, 2), math.nan) if ends is None else ends
