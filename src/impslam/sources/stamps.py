"""Checks stamps: repeated or backward ones and gaps are counted and reported."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from impslam.noise import MIN_BREAK
from impslam.sources.parts import Piece, by_stream
from impslam.types import Array, Ints, Mask

MIN_GAP = 10.0  # s; at walking pace a robot may then be in another room, beyond any gate


class StampCheck:
    """Checks the stamps of a log, part by part.

    Streams are checked separately: a scan is stamped at its first beam and arrives after wheel angles
    with later stamps. Nothing is dropped here; the estimator decides what to do with such a row.
    """

    def __init__(self, log: Path) -> None:
        self._log = log
        self._latest: dict[str, float] = {}

    def check(self, part: Sequence[Piece]) -> list[tuple[str, str, int]]:
        """Check the next rows of all streams; return (kind, first example, count) of problems."""
        found: dict[str, list[tuple[int, int, str]]] = {}  # by kind: order, count and text
        for stream, pieces in by_stream(part).items():
            order, places, stamps = _checked(pieces)
            if not len(stamps):
                continue
            before = np.append(self._latest.get(stream, np.nan), stamps[:-1])
            self._latest[stream] = float(stamps[-1])
            for kind, bad in _kinds(stamps - before).items():
                if bad.any():
                    k = int(bad.argmax())
                    what = _describe(kind, before[k], stamps[k])
                    example = f"{self._log}:{places[k]}: {stream} {what}"
                    found.setdefault(kind, []).append((int(order[k]), int(bad.sum()), example))
        return [
            (kind, min(several)[2], sum(count for _, count, _ in several))
            for kind, several in found.items()
        ]


def _checked(pieces: Sequence[Piece]) -> tuple[Ints, Ints, Array]:
    """Return order, place and stamp of the rows to check, in the order of the log."""
    order = np.concatenate([piece.columns.order[piece.checked] for piece in pieces])
    places = np.concatenate([piece.places[piece.checked] for piece in pieces])
    stamps = np.concatenate([piece.columns.stamps[piece.checked] for piece in pieces])
    sort = np.argsort(order)
    return order[sort], places[sort], stamps[sort]


def _kinds(steps: Array) -> dict[str, Mask]:
    return {"gap": steps > MIN_GAP, "backward stamp": steps < 0.0, "repeated stamp": steps == 0.0}


def _describe(kind: str, before: float, stamp: float) -> str:
    silent = stamp - before
    why = "was recording paused?"
    if silent > MIN_BREAK:
        why = "if another drive begins there, split the log and continue the map with --map"
    return {
        "gap": f"was silent for {silent:.1f} s; {why}",
        "backward stamp": f"has a stamp {before - stamp:.6f} s before that of its predecessor; file "
        "order is kept",
        "repeated stamp": f"has the same stamp as its predecessor, {stamp:.6f}",
    }[kind]
