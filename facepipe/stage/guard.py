"""Exceptions of USD, and of values of other types than their attributes declare, as one-line errors."""

from __future__ import annotations

import contextlib
import functools
import re
from collections.abc import Callable, Iterator
from typing import Any, TypeVar, cast

from pxr import Tf

from facepipe.core.errors import FacepipeError, InputError

Reader = TypeVar("Reader", bound=Callable[..., Any])

USD_ERRORS = (Tf.ErrorException, UnicodeDecodeError)  # names and texts of a damaged file may be no UTF-8
UNREADABLE = (*USD_ERRORS, TypeError, ValueError, OverflowError)  # ... and text where numbers belong


def reason(error: Exception) -> str:
    """The messages of an error without its C++ trail, in one line."""
    try:
        text = str(error)
    except UnicodeDecodeError:  # USD quotes bytes of the file
        return "damaged text"
    messages = re.findall(r" : '(.*?)'\s*(?=\n\s*Error in |\Z)", text, flags=re.DOTALL)
    text = re.sub(r"pxrInternal_\w+::", "", messages[0] if messages else text)
    return " ".join((text or type(error).__name__).split())[:300]


@contextlib.contextmanager
def usd_errors(where: object, *further: type[Exception]) -> Iterator[None]:
    """What USD raises in the block, or another error of the `further` kinds, becomes an InputError at `where`."""
    try:
        yield
    except (*USD_ERRORS, *further) as error:
        raise InputError(where, f"can't be read as USD: {reason(error)}") from None


@contextlib.contextmanager
def errors_below(where: str) -> Iterator[None]:
    """Do as `usd_errors` does; the trails of other errors begin with the file of `where`."""
    file = where.partition(" -> ")[0]
    try:
        with usd_errors(where):
            yield
    except FacepipeError as error:
        raise error if error.where.startswith(file) else error.under(file) from None


def reads_prim(reader: Reader) -> Reader:
    """A reader of a prim whose values may be damaged or of any type: raises InputError at the prim for those."""

    @functools.wraps(reader)
    def guarded(prim: Any, *args: Any, **kwargs: Any) -> Any:
        try:
            return reader(prim, *args, **kwargs)
        except UNREADABLE as error:
            raise InputError(str(prim.GetPath()), f"holds a value that can't be read: {reason(error)}") from None

    return cast(Reader, guarded)
