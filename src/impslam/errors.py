"""The one exception tree. The library raises these; only the command line prints and exits."""


class ImpError(Exception):
    """A failure a user can act on: one line that says what, where and what to do."""


class LeftError(ImpError):
    """The user has ended it early; nothing is wrong."""


class Interrupted(KeyboardInterrupt):
    """A signal has ended the command; `code` is the exit code by which shells know it."""

    def __init__(self, said: str, code: int) -> None:
        super().__init__(said)
        self.code = code


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


def in_a_line(error: BaseException) -> str:
    """Return an error's message without line breaks; the type of one that is not ours stands first."""
    words = " ".join(str(error).split())
    if isinstance(error, KeyboardInterrupt):
        return words or "interrupted"
    return words if isinstance(error, ImpError) else f"{type(error).__name__}: {words}"
