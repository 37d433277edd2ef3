"""Errors of facepipe. Every message is one line: where, what, what was expected."""

import contextlib
from collections.abc import Iterator


class FacepipeError(Exception):
    """Base of all errors that a user can cause or fix.

    :param where: the trail to the culprit, outermost first, like ``head.usdc -> </Face/Head/jawOpen>``
    :param what: what was found and what was expected, like ``51 offsets, expected 52``
    """

    def __init__(self, where: object, what: str) -> None:
        self.where = printable(str(where))
        self.what = printable(" ".join(what.split()))
        super().__init__(f"{self.where}: {self.what}")

    def __reduce__(self) -> tuple[type["FacepipeError"], tuple[str, str]]:
        """Pickled whole: an error that can't be read takes a pool of processes with it."""
        return type(self), (self.where, self.what)

    def under(self, outer: object) -> "FacepipeError":
        """The same error with `outer` put before its trail."""
        return type(self)(f"{outer} -> {self.where}", self.what)


def printable(text: str) -> str:
    """The message in one line: control characters in names of files and prims become their codes."""
    return text if text.isprintable() else "".join(one if one.isprintable() else f"\\x{ord(one):02x}" for one in text)


class InputError(FacepipeError):
    """A file or value given by the user can't be used."""


@contextlib.contextmanager
def system_errors(where: object, what: str) -> Iterator[None]:
    """What the system refuses in the block becomes an InputError: `what`, like "can't be read", and why."""
    try:
        yield
    except OSError as error:
        raise InputError(where, f"{what}: {error.strerror or error}") from error


class ChangedError(InputError):
    """A file that another process changes at this moment; later it may be whole."""


class TopologyError(FacepipeError):
    """Meshes, shapes or weights whose counts don't fit each other."""


class SchemaError(FacepipeError):
    """A stage that doesn't follow the stage convention."""


class FitError(FacepipeError):
    """A solver or fit that found no usable result."""


class ExportError(FacepipeError):
    """A face that a format can't hold, or a file that can't be written."""
