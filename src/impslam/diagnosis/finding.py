"""A finding of the diagnosis: one line on what is wrong, the settings that fix it, and its certainty."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

from impslam.health import SOUND, Standing

ERROR_RATE = 1e-3
"""Share of tests that may find what is not there: some twenty tests make 2 % of sound logs."""
SIGMAS = 3.29
"""Standard deviations of a normal error beyond which `ERROR_RATE` lies, both sides together."""
SUREST = 0.9999
"""Nothing is surer: standard deviations rest on the noise being what it seems."""


@dataclass(frozen=True, slots=True)
class Finding:
    """Something that the data show to be other than the config has it.

    Attributes
    ----------
    kind : its name, the same in every log
    what : what is measured, with its standard deviation
    fix : settings for --set that fix it, as "key=value"; several go together
    sure : probability that it is so
    advice : what to do where no setting fixes it, or what else it may be
    harmful : whether a run suffers; otherwise it copes, and the finding is for information
    health : the reason, with its amount, why no pose of such a run can be trusted
    """

    kind: str
    what: str
    fix: tuple[str, ...] = ()
    sure: float = SUREST
    advice: str = ""
    harmful: bool = True
    health: Standing = SOUND

    def __str__(self) -> str:
        """Return the finding as one line."""
        mended = " ".join(f"--set '{one}'" if "[" in one else f"--set {one}" for one in self.fix)
        ends = "; ".join(part for part in (mended, self.advice) if part)
        return f"{self.what} ({100.0 * self.sure:.4g} % sure)" + (f": {ends}" if ends else "")


def standing(findings: Iterable[Finding]) -> Standing:
    """Return the worst reason that harmful findings give for not trusting the poses of a run."""
    harm = (one.health for one in findings if one.harmful)
    return max(harm, key=lambda one: one.reason, default=SOUND)


def certainty(off: float, sigma: float, allowed: float) -> float:
    """Return how sure it is that a value with a normal error is off by more than is allowed."""
    above = (abs(off) - allowed) / max(sigma, 1e-12)
    return min(0.5 * math.erfc(-above / math.sqrt(2.0)), SUREST)


def is_off(off: float, sigma: float, allowed: float) -> bool:
    """Tell whether a value is off by more than is allowed, at the error rate of all tests."""
    return abs(off) - SIGMAS * sigma > allowed
