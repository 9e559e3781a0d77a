"""A receiver of readings for tests in real time."""

import threading

PATIENCE = 20.0  # s, for a loaded machine


class Inbox:
    """Records the readings of a device."""

    def __init__(self):
        self.readings, self.changed = [], threading.Condition()

    def __call__(self, reading):
        with self.changed:
            self.readings.append(reading)
            self.changed.notify_all()

    def of(self, kind):
        return [r for r in self.readings if isinstance(r.message, kind)]

    def wait(self, kind, number):
        """Wait for `number` readings of a kind, and return them."""
        with self.changed:
            arrived = self.changed.wait_for(lambda: len(self.of(kind)) >= number, PATIENCE)
            assert arrived, [r.message for r in self.readings]
            return self.of(kind)
