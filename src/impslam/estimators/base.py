"""The interface of estimators: keyframes in, revisions of the map out."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, ClassVar, NamedTuple

import numpy as np
from pydantic import PrivateAttr

from impslam.component import Component
from impslam.errors import ConfigError, NumericalError
from impslam.map import Keyframe, Map, Revision
from impslam.tracking.base import KeyframeGate
from impslam.types import (
    NO_COVARIANCE,
    NO_EDGES,
    Array,
    Edges,
    ErrorEstimate,
    Increment,
    Landmark,
    Observation,
)

MIN_SIGMA = 1e-4
"""m and rad, of the start, which defines the map frame, and added to motions and to the scatter of
particles: it only keeps covariances positive definite."""


class Draft(NamedTuple):
    """A snapshot of an estimate; later keyframes do not change it.

    Attributes
    ----------
    refine : returns the refined poses of all keyframes, or None; see `Estimator.refine`
    landmarks : returns the landmarks; after `refine`, those at the refined poses
    edges : returns the edges of the pose graph; after `refine`, those of the refined poses
    landmark_covariance : returns the joint covariance of the landmarks, or none
    """

    refine: Callable[[], Revision | None]
    landmarks: Callable[[], tuple[Landmark, ...]]
    edges: Callable[[], Edges] = lambda: NO_EDGES
    landmark_covariance: Callable[[], Array] = lambda: NO_COVARIANCE


def _go_on() -> None:
    """Do nothing: the default between the steps of long work."""


class Estimator(Component):
    """Estimates the poses of keyframes and a map of landmarks, one keyframe at a time."""

    role: ClassVar[str] = "estimator"
    considers_systematic_errors: ClassVar[bool] = False
    """Whether it passes `Increment.systematic` to its filter."""
    parts: ClassVar[tuple[str, ...]] = ()
    """Roles of the components that it uses; `start` receives one of each."""
    can_continue: ClassVar[bool] = False
    """Whether it can continue a known map."""
    takes_unique: ClassVar[bool] = False
    """Whether it estimates landmarks of unique kinds, such as the frame of a GPS."""
    library: ClassVar[str] = ""
    """Module of an optional extra that it needs to start."""
    keyframes: ClassVar[KeyframeGate] = KeyframeGate()
    """Which scans become keyframes, unless the config overrides it."""
    _checkpoint: Callable[[], None] = PrivateAttr(_go_on)
    """Called between the steps of work that takes seconds; what it raises ends the work."""

    def check_with(self, checkpoint: Callable[[], None]) -> None:
        """Call a function between the steps of `refine`, which it may end with an exception."""
        self._checkpoint = checkpoint

    @abstractmethod
    def start(self, pose: Array, **parts: Any) -> None:
        """Begin at a pose (3,) with an empty map.

        `parts` are the components named in the class's `parts`, by role, and `models`, the landmark
        models by kind.
        """

    def resume(self, known: Map, *, frozen: bool = False, hint: Array | None = None) -> None:
        """Continue a known map instead of the empty one, after `start`.

        Keyframe ids continue those of the map. With `frozen` the keyframes and landmarks of the map do not
        change. `hint` (3,) or (2,) is the approximate start of the next session in the map, m, m, rad.

        Raises
        ------
        ConfigError
            If this estimator cannot continue maps; see `can_continue`.
        """
        del known, frozen, hint
        raise ConfigError(
            f"estimator {self.name!r} cannot continue a map; choose another one "
            "with --set estimator.kind=graph"
        )

    @abstractmethod
    def add(self, keyframe: Keyframe) -> Revision:
        """Process a keyframe: the motion since the previous one, and its observations.

        A `lost` keyframe begins a session: it and its successors are not placed in the map until they are
        located in it. An estimator without sessions uses the motion as a guess.

        The revision reports a keyframe that cannot be used, with the pose predicted from its motion; the
        estimator is never left partly changed.
        """

    def refine(self) -> Revision | None:
        """Return the refined poses of all keyframes, or None if the estimator does not refine them.

        This may take seconds. More keyframes may follow, with the same result as without this call; until
        then `landmarks` are those at these poses.
        """
        return None

    @abstractmethod
    def landmarks(self) -> tuple[Landmark, ...]:
        """Return the landmarks as `types.Landmark`."""

    def landmark_covariance(self) -> Array:
        """Return the joint covariance (2 k, 2 k) of the k `landmarks`, in their order.

        Empty, (0, 0), from an estimator that has none.
        """
        return NO_COVARIANCE

    def draft(self) -> Draft:
        """Return a snapshot of the estimate; this takes at most milliseconds.

        Longer work is deferred to the functions of the draft, which may run in one other thread while this
        estimator continues. By default the landmarks are the current ones, and nothing is refined.
        """
        landmarks, covariance = self.landmarks(), self.landmark_covariance()
        return Draft(lambda: None, lambda: landmarks, landmark_covariance=lambda: covariance)

    def edges(self) -> Edges:
        """Return the edges of the pose graph between keyframe ids, or none without a graph."""
        return NO_EDGES

    @property
    def systematic_errors(self) -> ErrorEstimate | None:
        """What is known of the systematic errors of odometry; None if they are not considered."""
        return None

    def observations(self) -> tuple[tuple[Observation, ...], ...]:
        """Return the observations of each keyframe, if they are needed to continue the map."""
        return ()

    def counts(self) -> Mapping[str, int]:
        """Return counts of events by name, e.g. of loops closed."""
        return {}

    @property
    @abstractmethod
    def state_size(self) -> int:
        """Number of estimated scalars."""


def completed(known: Map, estimate: Estimator | Draft) -> Map:
    """Return a map with the landmarks and the edges of an estimate."""
    return replace(
        known,
        landmarks=estimate.landmarks(),
        landmark_covariance=estimate.landmark_covariance(),
        edges=estimate.edges(),
    )


def is_finite(motion: Increment) -> bool:
    """Return whether a motion and its covariance are finite."""
    return bool(np.isfinite(motion.d_pose).all() and np.isfinite(motion.covariance).all())


def check_keyframe(keyframe: Keyframe) -> None:
    """Raise `NumericalError` if a motion or an observation is not finite, or an R is not a covariance.

    An R without the observation's shared error is a covariance, too.
    """
    numbers = [part.ravel() for o in keyframe.observations for part in (o.z, o.R)]
    if not is_finite(keyframe.motion):
        raise NumericalError("the motion or its covariance is not finite")
    if numbers and not np.isfinite(np.concatenate(numbers)).all():
        raise NumericalError("an extractor's observation is not finite")
    for o in keyframe.observations:
        if not is_definite(o.R):
            raise NumericalError(
                f"the covariance R of a {o.kind} is not positive definite: check its sensor's noise"
            )
        if o.shared is not None and not is_definite(o.R - np.outer(o.shared, o.shared)):
            raise NumericalError(f"the R of a {o.kind} does not include its shared error")


def with_motion(keyframe: Keyframe, motion: Increment) -> tuple[Keyframe, str]:
    """Return a keyframe with another motion, without its scan if `check_keyframe` fails, and the reason."""
    try:
        check_keyframe(keyframe)
    except NumericalError as error:
        reason = f"the scan at {keyframe.stamp:.3f} s is not used for the map: {error}"
        return replace(keyframe, motion=motion, scan=None, observations=()), reason
    return replace(keyframe, motion=motion), ""


def is_definite(R: Array) -> bool:
    """Return whether a finite, symmetric R (d, d) is positive definite."""
    if len(R) == 2:  # nearly all observations; 20 times as fast as numpy's determinant
        (a, b), (c, d) = R.tolist()
        return bool(a > 0.0 and a * d > b * c)
    try:
        np.linalg.cholesky(R)
    except np.linalg.LinAlgError:
        return False
    return True
