"""How each of the controlled experiments is set up, and why its results differ from the print."""

from __future__ import annotations

import math
from dataclasses import dataclass

from impslam.studies.arena_runs import Way
from impslam.studies.arena_scores import NAMED

WALLS, CYLINDERS = NAMED[:4], NAMED[4:]
ROOT2 = math.sqrt(2.0)
WHEELS = "wheels taken for 2 % too large"


@dataclass(frozen=True)
class Setup:
    """One of the three experiments.

    Attributes
    ----------
    name, title : of the section
    section, table, figure : where the thesis has it
    names : the landmarks that it is about
    thesis : the thesis's way, as its text is taken to mean it: the preset
    letter : the same with the association gate as printed, where that makes a difference
    readings : other readings of what the text leaves open, by what to call them
    why : what made the results what they are
    """

    name: str
    title: str
    section: str
    table: str
    figure: str
    names: tuple[str, ...]
    thesis: Way
    letter: Way | None
    readings: dict[str, Way]
    why: str


def _way(
    preset: str, gate: float | None = None, threshold: int | None = None, more: tuple[str, ...] = ()
) -> Way:
    """Return the preset, but for what is given."""
    given = {
        "association.max_distance": gate,
        "sensors.lidar.extractors.walls.threshold": threshold,
    }
    settings = [f"{key}={value}" for key, value in given.items() if value is not None]
    return Way(preset, (*settings, *more))


_GATE = (
    "The gate of 2 m cannot have been one of 2 m. Neighbouring cylinders stand 1.93 m apart, in the "
    "print's own positions too (1.97 m from cylinder 1 to 2 in Table 1): with that gate cylinder 2, "
    "in a scan that shows it without cylinder 1, is taken for it, the pose jumps, and the map is "
    "lost. But every distance in the thesis's tables is a square, to the last digit; a gate of 2 on "
    "the squared distance is one of 1.41 m, and this is what 'thesis' and its presets stand for."
)
_THRESHOLD = (
    "The pixels that a line must exceed in Hough's accumulator are not printed ('any reasonable value "
    "may be chosen'). Here they are 40, more than a cylinder shows of itself (0.30 m, 31 pixels of "
    "1 cm). From 40 to 100 the result is the same within a centimetre, which fits the words; with 20 "
    "or 30, lines that are no walls enter the map at once and for ever, since the thesis has no "
    "tentative landmarks, and at 150 walls are missed so often that some maps are lost."
)
_SCALE = (
    "The print is further off than this, in ways that the noise of the simulation does not have and "
    "that the estimator could not know."
)

POINTS = Setup(
    "points",
    "Point features (thesis 5.2.1)",
    "5.2.1",
    "Table 1",
    "Fig. 24",
    CYLINDERS,
    _way("thesis-points"),
    _way("thesis-points", 2.0),
    {
        **{f"gate {gate:.2f} m": _way("thesis-points", gate) for gate in (2.0, ROOT2, 1.0, 0.5)},
        WHEELS: _way("thesis-points", more=("odometry.wheel_radius=0.06477",)),
    },
    f"{_GATE}\n\n{_SCALE} Cylinder 1 is seen from the start, before anything has moved, and is "
    "printed 1.5 degrees off in bearing: the robot was not set down quite along y, or the arena not "
    "measured quite so. That turn alone moves cylinder 3 by 0.14 m. The others are turned further, "
    "by 2.2 and 3.1 degrees, and 2 % too far out. A scale of the wheels that is 2 % wrong (the "
    "simulated ones are calibrated to 0.1 %) makes the errors of cylinders 2 and 3 two to three times "
    "as large and the estimate too sure, but stays far below the print. What the printed estimator "
    "did with the signs and derivatives that the thesis prints wrongly is not repeated here.",
)

LINES = Setup(
    "lines",
    "Linear features (thesis 5.2.2)",
    "5.2.2",
    "Table 2",
    "Fig. 25",
    WALLS,
    _way("thesis-lines"),
    None,
    {
        **{
            f"threshold {pixels} px": _way("thesis-lines", threshold=pixels)
            for pixels in (20, 30, 40, 60, 100, 150)
        },
        "gate 2.00 m": _way("thesis-lines", 2.0),
        "bins of 1 degree": _way(
            "thesis-lines", more=("sensors.lidar.extractors.walls.angle_bin=0.017453292519943295",)
        ),
        WHEELS: _way("thesis-lines", more=("odometry.wheel_radius=0.06477",)),
    },
    f"{_THRESHOLD} The gate of 2 m between feet, or 1.41 m, makes no difference here: the angle "
    "keeps neighbouring walls apart.\n\n"
    "Bins of 10 degrees and 2 cm do less harm than they seem to. A wall between two bins of angle "
    "gathers too few pixels and is not seen at all, as the thesis found in its turns; one near a bin "
    "is taken to lie in it, and as the robot turns these errors change sign and average out. Bins of "
    f"1 degree end no nearer.\n\n{_SCALE} Its arena is 2.8 % too wide between walls 2 and 4, which "
    "every scan along the corridor measures by itself: that is the lidar's scale, or the tape's. It "
    "is 0.41 m too long between walls 1 and 3 (6.4 m, beyond the lidar's 5.6 m, so that odometry "
    "joins them): wall 3 is 0.26 m off where it stands, not only at its foot.",
)

BOTH = Setup(
    "both",
    "Point and linear features (thesis 5.2.3)",
    "5.2.3",
    "Table 3",
    "Fig. 26",
    (*CYLINDERS, *WALLS),
    _way("thesis-both"),
    _way("thesis-both", 2.0),
    {
        **{
            f"gate {gate:.2f} m, threshold {pixels} px": _way("thesis-both", gate, pixels)
            for gate in (2.0, ROOT2)
            for pixels in (20, 40, 100)
        },
        WHEELS: _way("thesis-both", more=("odometry.wheel_radius=0.06477",)),
    },
    f"{_GATE}\n\n{_THRESHOLD}\n\n{_SCALE} All its cylinders are 1 to 3 % too far from the start, and "
    "the arena is 2.2 % too wide, as in Table 2. The largest entry, wall 3 with 0.367 m, is a turn: "
    "at its middle the printed wall is within 1 cm of the true one, but turned by 3.4 degrees, and "
    "its foot is found 6.1 m from the start. That is the score, not the map: walls are to be "
    "compared where they are. The same holds for wall 1.\n\n"
    "The thesis's estimate is too sure here: it takes the errors of Hough's bins for new in every "
    "scan, ten times a second, while they stay the same as long as the heading does.",
)
