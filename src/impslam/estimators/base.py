"""The role of an estimator: keyframes in, revisions of the map out."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Mapping
from typing import Any, ClassVar, NamedTuple

import numpy as np
import numpy.typing as npt

from impslam.component import Component
from impslam.errors import ConfigError, NumericalError
from impslam.map import Keyframe, Map, Revision
from impslam.tracking.base import KeyframeGate
from impslam.types import NO_EDGES, Array, Edges, Increment, Landmark, Observation


class Draft(NamedTuple):
    """What an estimator has estimated by a moment; later keyframes do not change it.

    Attributes
    ----------
    settle : returns all keyframes refined, or None; see `Estimator.settle`
    landmarks : returns the landmarks; those at the refined poses after `settle`
    """

    settle: Callable[[], Revision | None]
    landmarks: Callable[[], tuple[Landmark, ...]]


class Estimator(Component):
    """Estimates the poses of keyframes and a map of landmarks, one keyframe at a time."""

    role: ClassVar[str] = "estimator"
    parts: ClassVar[tuple[str, ...]] = ()
    """Roles of the components that it is made of; `start` is given one of each."""
    goes_on: ClassVar[bool] = False
    """Whether it can begin with a map that is known."""
    tells_landmarks: ClassVar[bool] = True
    """Whether revisions tell of each landmark when it is matched, comes and goes."""
    takes_unique: ClassVar[bool] = False
    """Whether it estimates landmarks of which there is one, such as the frame of a GPS."""
    keyframes: ClassVar[KeyframeGate] = KeyframeGate()
    """Which scans it takes in, unless the config says otherwise."""

    @abstractmethod
    def start(
        self,
        pose: Array,
        known: Map | None = None,
        frozen: bool = False,
        hint: Array | None = None,
        **parts: Any,
    ) -> None:
        """Begin at a pose (3,) with an empty map, or go on with a map that is known.

        Keyframes are numbered on from those of the map. With `frozen` its keyframes and landmarks stay
        as they are. `hint` (3,) or (2,) is about where in the map the next session begins.

        `parts` are the components named in the class's `parts`, by role, and `models`, the landmark
        models by kind.
        """

    def _refuse(self, known: Map | None) -> None:
        """Raise `ConfigError` if a map is given, for an estimator that cannot go on with one."""
        if known is not None:
            raise ConfigError(
                f"estimator {self.name!r} cannot go on with a map; choose another one "
                "with --set estimator.kind=graph"
            )

    @abstractmethod
    def add(self, keyframe: Keyframe) -> Revision:
        """Take in a keyframe: its motion since the one before, and what is seen in it.

        A keyframe that is `lost` begins a session: it and those after it are not placed in the map
        until it is found where they lie. An estimator that cannot do so takes its motion for a guess.

        A keyframe that cannot be used is told in the revision, which then holds the pose by its
        motion alone; it never leaves the estimator half changed.
        """

    def settle(self) -> Revision | None:
        """Return the poses of all keyframes as well as they can be told at the end, or None.

        It may take seconds. More keyframes may follow, as if it had not been asked for; until then
        `landmarks` are those at these poses.
        """
        return None

    @abstractmethod
    def landmarks(self) -> tuple[Landmark, ...]:
        """Return the landmarks in the form users read."""

    def draft(self) -> Draft:
        """Return the estimate as it is now; this takes at most milliseconds.

        What takes longer is done when the draft's functions are called, in any one thread, while
        this estimator goes on. By default the landmarks are those of now, and nothing is refined.
        """
        landmarks = self.landmarks()
        return Draft(lambda: None, lambda: landmarks)

    def edges(self) -> Edges:
        """Return the pose graph, whose nodes are keyframes, by their ids; none without a graph."""
        return NO_EDGES

    def observations(self) -> tuple[tuple[Observation, ...], ...]:
        """Return what the keyframes saw of landmarks, if it is needed to go on with the map."""
        return ()

    def belief(self) -> Mapping[str, npt.NDArray[Any]]:
        """Return arrays by name that are needed beside the `Map` to go on with it, in its frame."""
        return {}

    def counts(self) -> Mapping[str, int]:
        """Return how often what has happened, by name: e.g. loops closed."""
        return {}

    @property
    @abstractmethod
    def state_size(self) -> int:
        """Number of scalars that are estimated."""


def is_known(motion: Increment) -> bool:
    """Tell whether a motion and its covariance are finite."""
    return bool(np.isfinite(motion.d_pose).all() and np.isfinite(motion.covariance).all())


def check_keyframe(keyframe: Keyframe) -> None:
    """Raise `NumericalError` for a motion or an observation that is not finite."""
    numbers = [part.ravel() for o in keyframe.observations for part in (o.z, o.R)]
    if not is_known(keyframe.motion):
        raise NumericalError("the motion or its covariance is not finite")
    if numbers and not np.isfinite(np.concatenate(numbers)).all():
        raise NumericalError("an extractor's observation is not finite")
