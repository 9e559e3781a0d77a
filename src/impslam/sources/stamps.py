"""Checking of stamps: those that repeat, run backwards or leave a gap are counted and explained."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from impslam.sources.parts import Piece, by_stream
from impslam.types import Array, Ints, Mask

GAP = 10.0  # s; at walking pace a robot is then in another room, beyond what any gate bridges


class StampCheck:
    """Checks the stamps of a log, part by part.

    Each stream is a clock of its own: a scan is stamped at its first beam and arrives after wheel
    angles that are younger. Nothing is dropped here; only the estimator knows what it can do with
    such a row.
    """

    def __init__(self, log: Path) -> None:
        self._log = log
        self._latest: dict[str, float] = {}

    def check(self, part: Sequence[Piece]) -> list[tuple[str, str, int]]:
        """Take in the next rows of all streams; return (kind, first example, count) of problems."""
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
                    said = f"{self._log}:{places[k]}: {stream} {_say(kind, before[k], stamps[k])}"
                    found.setdefault(kind, []).append((int(order[k]), int(bad.sum()), said))
        return [
            (kind, min(several)[2], sum(count for _, count, _ in several))
            for kind, several in found.items()
        ]


def _checked(pieces: Sequence[Piece]) -> tuple[Ints, Ints, Array]:
    """Return order, place and stamp of the rows to be checked, in the order of the log."""
    order = np.concatenate([piece.columns.order[piece.checked] for piece in pieces])
    places = np.concatenate([piece.places[piece.checked] for piece in pieces])
    stamps = np.concatenate([piece.columns.stamps[piece.checked] for piece in pieces])
    sort = np.argsort(order)
    return order[sort], places[sort], stamps[sort]


def _kinds(steps: Array) -> dict[str, Mask]:
    return {"gap": steps > GAP, "backward stamp": steps < 0.0, "repeated stamp": steps == 0.0}


def _say(kind: str, before: float, stamp: float) -> str:
    return {
        "gap": f"has been silent for {stamp - before:.1f} s; was it paused?",
        "backward stamp": f"is stamped {before - stamp:.6f} s before its predecessor; file order "
        "is kept",
        "repeated stamp": f"has the stamp {stamp:.6f} of the one before it",
    }[kind]
