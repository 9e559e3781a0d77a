"""A plug-in as a third party would install it; importing it registers a toy."""

from impslam.component import register
from impslam.extractors.base import Extractor


@register("toy")
class Toy(Extractor):
    """A toy."""

    def extract(self, scan, rng):
        """Return nothing."""
        del scan, rng
        return []
