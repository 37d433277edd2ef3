"""What commands print: tables, JSON, progress; and what libraries print of their own accord, which goes nowhere."""

from __future__ import annotations

import contextlib
import io
import json
import os
import sys
import warnings
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

from facepipe.core.errors import printable
from facepipe.core.reports import Report


def emit(value: Report | dict[str, Any], text: str, *, as_json: bool) -> None:
    """Print the JSON of a result, or its text."""
    if as_json:
        print(
            value.to_json() if isinstance(value, Report) else json.dumps(value, sort_keys=True, indent=2, default=str)
        )
    else:
        print("\n".join(map(printable, text.split("\n"))))


def warn(lines: Iterable[str]) -> None:
    """Print warnings to stderr, a line each."""
    for line in lines:
        note(f"warning: {line}")


def note(line: str) -> None:
    """Print a fact to stderr."""
    print(f"facepipe: {printable(line)}", file=sys.stderr)


def noted_names(given: str | None, names: Mapping[str, str]) -> None:
    """Print how many names a `--rename` changed to stderr."""
    if given is not None:
        like = next((f", like '{old}' to '{new}'" for old, new in names.items()), "")
        note(f"--rename {given}: {len(names)} names changed{like}")


@contextlib.contextmanager
def progress(label: str, total: int) -> Iterator[Any]:
    """A bar on stderr with ``update()`` per step; shown on a terminal only."""
    from tqdm import tqdm

    with tqdm(total=total, desc=label, file=sys.stderr, disable=None, leave=False) as bar:
        yield bar


@contextlib.contextmanager
def quiet_libraries() -> Iterator[None]:
    """No warnings of Python and numpy, and nothing that C++ writes to stderr: USD, onnxruntime, libtiff.

    `sys.stderr` still leads where stderr led. Warnings that Python was asked for (``-W``, ``PYTHONWARNINGS``) stay.
    """
    with warnings.catch_warnings(), _own_stderr(), _no_reports():
        if not sys.warnoptions:
            warnings.simplefilter("ignore")
        yield


@contextlib.contextmanager
def _no_reports() -> Iterator[None]:
    """Errors that C++ code or a finaliser swallows are not printed: USD does so over values that Python can't hold."""
    before = sys.excepthook, sys.unraisablehook
    sys.excepthook = lambda *_: None
    sys.unraisablehook = lambda _: None
    try:
        yield
    finally:
        sys.excepthook, sys.unraisablehook = before


@contextlib.contextmanager
def _own_stderr() -> Iterator[None]:
    try:
        kept, ours = os.dup(2), sys.stderr.fileno() == 2
    except (OSError, AttributeError, io.UnsupportedOperation):  # closed, or a host's own
        yield
        return
    before = sys.stderr
    if ours:
        before.flush()
        sys.stderr = open(  # noqa: SIM115 (closed below)
            kept, "w", 1, encoding=before.encoding, errors=before.errors, closefd=False
        )
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 2)
    os.close(nowhere)
    try:
        yield
    finally:
        if ours:
            with contextlib.suppress(OSError):  # nobody reads it any more
                sys.stderr.close()
            sys.stderr = before
        os.dup2(kept, 2)
        os.close(kept)
