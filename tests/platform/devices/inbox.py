"""A receiver of readings for tests in real time."""

import threading

PATIENCE = 20.0  # s, for a loaded machine


class Inbox:
    """Records the readings of a device."""

    def __init__(self):
        self.readings, self.news = [], threading.Condition()

    def __call__(self, reading):
        with self.news:
            self.readings.append(reading)
            self.news.notify_all()

    def of(self, kind):
        return [r for r in self.readings if isinstance(r.message, kind)]

    def wait(self, kind, number):
        """Wait for `number` readings of a kind, and return them."""
        with self.news:
            there = self.news.wait_for(lambda: len(self.of(kind)) >= number, PATIENCE)
            assert there, [r.message for r in self.readings]
            return self.of(kind)
