"""Errors of the user's input; each message has the expected, the received, and what to do."""

from collections.abc import Generator
from contextlib import contextmanager


def reason_of(error: Exception) -> str:
    """The message of an error, without the number and file name of system errors."""
    return (error.strerror if isinstance(error, OSError) else None) or str(error)


def first_line(error: Exception, *, most: int = 120) -> str:
    """The first line of an error, such as of onnxruntime's long ones, or the name of its class."""
    return next(iter(str(error).strip().splitlines()), type(error).__name__)[:most]


class UserError(Exception):
    """The user's input is wrong: the command prints this one line and exits with 2.

    The message has the expected and the received value, and what to do.
    """


class TemplateError(UserError):
    """A template mesh or its TOML breaks the template contract."""


class CalibrationError(UserError):
    """A calibration file, board picture or set of pictures can't be used."""


class SourceError(UserError):
    """A video, folder or camera can't be read."""


class AnnotationError(UserError):
    """A boxes file or a masks folder can't be read or doesn't match the source."""


class ModelError(UserError):
    """A neural network's file can't be used: unreadable, of another kind or of the wrong shape."""


class ConfigError(UserError):
    """`config.toml` holds an unknown key, a wrong type or a value out of range."""


class OutputError(UserError):
    """The output folder can't be written to."""


class RecordingError(UserError):
    """A recording can't be read: damaged, torn, of a newer version, or none at all."""


@contextmanager
def requires_extra(extra: str, what: str) -> Generator[None]:
    """Turn the ImportError of a missing package into a UserError with how to install it.

    `extra`: of pyproject.toml, or "torch".
    """
    try:
        yield
    except ModuleNotFoundError as error:
        install = extra if extra == "torch" else f"'stream-dmr[{extra}]'"
        raise UserError(
            f"{what}: expected the package {error.name}, found none; install it with: "
            f"pip install {install}"
        ) from error
