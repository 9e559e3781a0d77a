"""The beginning of a log, as much as a diagnosis needs."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field

from impslam.columns import Batch
from impslam.types import LaserScan


@dataclass(slots=True)
class Head:
    """Keeps the first batches of a log, until they contain `max_scans` scans."""

    max_scans: int
    batches: list[Batch] = field(default_factory=list)
    scans: int = 0

    @property
    def is_full(self) -> bool:
        """Whether there are enough scans."""
        return self.scans >= self.max_scans

    def add(self, batch: Batch) -> None:
        """Keep a batch, unless there are enough scans."""
        if not self.is_full:
            self.batches.append(batch)
            self.scans += sum(len(c) for c in batch.values() if c.kind is LaserScan)

    def read(self, batches: Iterable[Batch]) -> Iterator[Batch]:
        """Keep the beginning of a log; yield the batches kept."""
        for batch in batches:
            self.add(batch)
            yield batch
            if self.is_full:
                return
