"""The one exception tree. The library raises these; only the command line prints and exits."""


class ImpError(Exception):
    """A failure a user can act on: one line that says what, where and what to do."""


class LeftError(ImpError):
    """The user has ended it early; nothing is wrong."""


class ConfigError(ImpError):
    """A configuration that cannot be used: an unknown key, a wrong type, an unknown component."""


class SourceError(ImpError):
    """A log, folder or device that cannot be read, or that holds nothing usable."""


class MessageError(ImpError):
    """One message that cannot be used; it is counted, dropped and explained, and the run goes on."""


class NumericalError(MessageError):
    """A scan whose numbers admit no solution: a covariance that is not positive definite."""


class ShapeError(ImpError, ValueError):
    """An array that has the wrong shape at a border of the library."""
