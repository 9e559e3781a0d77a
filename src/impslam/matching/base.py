"""The role of a matcher: it refines the motion between scans by what both scans show."""

from __future__ import annotations

from abc import abstractmethod
from typing import ClassVar

from impslam.component import Component
from impslam.types import Increment, Scan


class Matcher(Component):
    """Turns an increment of odometry into a better one. The filter cannot tell them apart."""

    role: ClassVar[str] = "matcher"

    @abstractmethod
    def refine(self, increment: Increment, scan: Scan) -> Increment:
        """Return the motion from the previous scan to this one, with its covariance.

        Where the scan tells nothing, the increment comes back as it was. What a matcher remembers
        are values that it replaces and never changes: a `model_copy` made before a scan that is
        dropped takes the scan back.

        Raises
        ------
        NumericalError
            If the scan and the increment admit no solution.
        """
