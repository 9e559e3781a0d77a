"""Merging of maps of parts of a drive, and rejection of maps without common places.

    python -m benchmarks.merging --data ../shared/data              # tables, in Markdown
    python -m benchmarks.merging --data ../shared/data --tries 20

Two parts have no place in common if they are of two buildings, or if less than `MIN_OVERLAP` of floor is
free in both, by the map of the whole drive. The alignment is not told that the parts are in the same
frame.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from impslam.evaluation.relations import read_relations, relation_errors
from impslam.map import Keyframes, Map
from impslam.maps.merge import merged
from impslam.maps.relation import RelationStatus, align_maps
from impslam.run import run
from impslam.types import Ints

BUILDINGS = {
    "intel": "intel/intel.log",
    "fr079": "fr079/fr079.log",
    "fr-hospital": "fr-hospital/fr-hospital.log",
    "exp1": "urg04lx-encoders/exp1.dat",
}
MIN_OVERLAP = 1.0  # m^2
CELL = 0.1  # m
PART_LENGTH = 20.0, 120.0  # m driven


class Part(NamedTuple):
    """A part of a drive: its building, its keyframes, and the keys (n,) of its free cells."""

    name: str
    keyframes: Keyframes
    free: Ints


def cut(log: Path, folder: Path, parts: int, overlap: float) -> list[Path]:
    """Write parts of a CARMEN log with equal numbers of scans and an overlap; return their paths."""
    lines = log.read_text().splitlines(keepends=True)
    scans = [i for i, line in enumerate(lines) if line.startswith("FLASER")]
    out = []
    for p in range(parts):
        first = max(0, int(len(scans) * (p - overlap / 2) / parts))
        last = min(len(scans) - 1, int(len(scans) * (p + 1 + overlap / 2) / parts))
        begin = 0 if p == 0 else scans[first]
        out.append(folder / f"{log.stem}-{p + 1}-of-{parts}.log")
        out[-1].write_text("".join(lines[begin : scans[last] + 1]))
    return out


def mergers(data: Path, whole: dict[str, Map]) -> None:
    """Print the relation errors of merged maps of parts, with those of the map of the whole drive."""
    print(
        "| log | parts | shared scans | relations, m | the whole log's | ratio | worst, m | CPU s |"
    )
    print("|---|---|---|---|---|---|---|---|")
    for name in ("intel", "fr079"):
        relations = read_relations(data / name / f"{name}.relations")
        best = relation_errors(whole[name].path(), relations).translation.mean()
        for parts in (2, 4):
            for overlap in (0.0, 0.1):
                with tempfile.TemporaryDirectory() as folder:
                    logs = cut(data / BUILDINGS[name], Path(folder), parts, overlap)
                    maps = [run(log) for log in logs]
                begin = time.process_time()
                known = merged(*maps)
                seconds = time.process_time() - begin
                error = relation_errors(known.path(), relations).translation
                cells = (
                    *(name, parts, f"{100 * overlap:.0f} %", f"{error.mean():.4f}", f"{best:.4f}"),
                    *(f"{error.mean() / best:.3f}", f"{error.max():.2f}", f"{seconds:.1f}"),
                )
                print("|", " | ".join(map(str, cells)), "|", flush=True)


def part(name: str, known: Map, rng: np.random.Generator) -> Part:
    """Return a part of random length and position."""
    steps = np.diff(known.keyframes.poses, axis=0)
    travel = np.concatenate([[0.0], np.cumsum(np.hypot(steps[:, 0], steps[:, 1]))])
    length = min(rng.uniform(*PART_LENGTH), 0.5 * travel[-1])
    begin = rng.uniform(0.0, travel[-1] - length)
    rows = np.arange(*np.searchsorted(travel, [begin, begin + length]))
    keyframes = known.keyframes.take(rows)
    grid = replace(known, keyframes=keyframes).grid(CELL)
    found, columns = np.nonzero(grid.logodds < 0.0)
    cells = (found + grid.corner[1] << 32) + columns + grid.corner[0]
    return Part(name, keyframes, cells)


def apart(one: Part, other: Part) -> bool:
    if one.name != other.name:
        return True
    return len(np.intersect1d(one.free, other.free, assume_unique=True)) * CELL**2 < MIN_OVERLAP


def refusals(maps: dict[str, Map], tries: int, seed: int = 1) -> None:
    """Print the outcomes for pairs of parts without a common place, half of them of one building."""
    rng, names = np.random.default_rng(seed), list(maps)
    counts: Counter[tuple[bool, str]] = Counter()
    seconds: list[float] = []
    while counts.total() < tries:
        alike = counts.total() % 2 == 0
        first, second = rng.choice(names, 2, replace=False)
        if alike:
            second = first
        one, other = part(str(first), maps[first], rng), part(str(second), maps[second], rng)
        if not apart(one, other):
            continue
        begin = time.process_time()
        found = align_maps(one.keyframes, other.keyframes)
        seconds.append(time.process_time() - begin)
        counts[alike, found.outcome.value] += 1
        print(f"\r{counts.total()} of {tries} tries", end="", file=sys.stderr)
        if found.outcome is not RelationStatus.APART:
            print(f"  {one.name}, {other.name}: {found.outcome.value}, {found.words}", flush=True)
    print("\n| parts without a common place | tries | found | ambiguous | apart | CPU s, median |")
    print("|---|---|---|---|---|---|")
    for alike, words in ((True, "of one building"), (False, "of two buildings")):
        totals = [counts[alike, outcome.value] for outcome in RelationStatus]
        print(
            "|",
            " | ".join(map(str, (words, sum(totals), *totals, f"{np.median(seconds):.1f}"))),
            "|",
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--tries", type=int, default=100)
    asked = parser.parse_args()
    maps = {name: run(asked.data / log) for name, log in BUILDINGS.items()}
    mergers(asked.data, maps)
    if asked.tries > 0:
        refusals(maps, asked.tries)


if __name__ == "__main__":
    main()
