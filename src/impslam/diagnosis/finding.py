"""A finding of the diagnosis: one line on the problem, the settings that fix it, and its probability."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace

from impslam.health import NO_FAULT, LogFault

ERROR_RATE = 1e-3
"""Rate of false findings per test: some twenty tests give one in 2 % of sound logs."""
SIGMAS = 3.29
"""Standard deviations of a normal error that `ERROR_RATE` corresponds to, two-sided."""
MAX_PROBABILITY = 0.9999
"""Upper bound of all probabilities: standard deviations depend on assumptions about the noise."""


@dataclass(frozen=True, slots=True)
class Finding:
    """A difference between the data and the config.

    Attributes
    ----------
    kind : its name, the same in every log
    what : the measurement, with its standard deviation
    fix : settings for --set that fix it together, as "key=value"
    certainty : probability that the finding is true; 1 if it is no measurement
    advice : what to do if no setting fixes it, or another possible cause
    harmful : whether it makes a run worse; otherwise the finding is for information
    fault : why no pose of a run with this log can be trusted
    lidar : name of the lidar that it is about; "" for the odometry, or the robot as a whole
    """

    kind: str
    what: str
    fix: tuple[str, ...] = ()
    certainty: float = MAX_PROBABILITY
    advice: str = ""
    harmful: bool = True
    fault: LogFault = NO_FAULT
    lidar: str = ""

    def with_lidar(self) -> Finding:
        """Return the finding with the name of its lidar, for robots with several."""
        return replace(self, what=f"{self.lidar}: {self.what}") if self.lidar else self

    def __str__(self) -> str:
        """Return the finding as one line."""
        settings = " ".join(f"--set '{one}'" if "[" in one else f"--set {one}" for one in self.fix)
        remedy = "; ".join(part for part in (settings, self.advice) if part)
        claim = self.what
        if self.certainty < 1.0:
            claim += f" ({100.0 * self.certainty:.4g} % certain)"
        return f"{claim}: {remedy}" if remedy else claim


def worst_fault(findings: Iterable[Finding]) -> LogFault:
    """Return the worst fault that harmful findings imply for all poses; `NO_FAULT` if there is none."""
    harm = (one.fault for one in findings if one.harmful)
    return max(harm, key=lambda one: one.reason, default=NO_FAULT)


def probability_off(off: float, sigma: float, allowed: float) -> float:
    """Return the probability that a value with a normal error is off by more than allowed."""
    above = (abs(off) - allowed) / max(sigma, 1e-12)
    return min(0.5 * math.erfc(-above / math.sqrt(2.0)), MAX_PROBABILITY)


def is_off(off: float, sigma: float, allowed: float) -> bool:
    """Return whether a value is significantly (see `ERROR_RATE`) off by more than allowed."""
    return abs(off) - SIGMAS * sigma > allowed
