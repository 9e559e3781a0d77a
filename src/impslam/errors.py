"""The exceptions of the library; only the command line prints them and exits."""


class ImpError(Exception):
    """A failure that a user can act on; its message is one line: what, where and what to do."""


class QuitError(ImpError):
    """The user stopped early; nothing is wrong."""


class Interrupted(KeyboardInterrupt):
    """A signal ended the command; `code` is the conventional exit code of that signal."""

    def __init__(self, message: str, code: int) -> None:
        super().__init__(message)
        self.code = code


class ConfigError(ImpError):
    """A configuration that cannot be used: an unknown key, a wrong type, an unknown component."""


class SourceError(ImpError):
    """A log, folder or device that cannot be read, or that contains nothing usable."""


class MessageError(ImpError):
    """A message that cannot be used: it is counted, reported and dropped, and the run continues."""


class NumericalError(MessageError):
    """A scan without a numerical solution, e.g. because a covariance is not positive definite."""


class ShapeError(ImpError, ValueError):
    """An array of the wrong shape that is passed to the library."""


def in_a_line(error: BaseException) -> str:
    """Return an error's message in one line, preceded by its type if it is not an `ImpError`."""
    words = " ".join(str(error).split())
    if isinstance(error, KeyboardInterrupt):
        return words or "interrupted"
    return words if isinstance(error, ImpError) else f"{type(error).__name__}: {words}"
