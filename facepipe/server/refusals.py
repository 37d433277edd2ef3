"""What a server says no to, with its status of HTTP."""

from __future__ import annotations

from facepipe.core.errors import FacepipeError


class RefusedError(FacepipeError):
    """No, and the status says why."""

    status = 400


class UnauthorisedError(RefusedError):
    """No token, or one that counts no more."""

    status = 401


class ForeignError(RefusedError):
    """Asked by a page of another site."""

    status = 403


class MissingError(RefusedError):
    """There is none, or it is another tenant's: that looks the same."""

    status = 404


class ConflictError(RefusedError):
    """Not while others stand on it."""

    status = 409

    def __init__(self, where: object, what: str, dependents: tuple[str, ...] = ()) -> None:
        super().__init__(where, what)
        self.dependents = dependents


class TooLargeError(RefusedError):
    """More bytes than may be sent, or kept."""

    status = 413


class TooManyError(RefusedError):
    """Too many requests, or jobs that wait."""

    status = 429


class AwayError(RefusedError):
    """Something that it needs does not answer now."""

    status = 503
