"""What commands print: tables, JSON, progress, logs; what libraries print unasked goes nowhere.

``--quiet`` and ``--verbose`` are decided here: notes and bars ask `_loudness`, debug lines are those of the logger
``facepipe``, which a host may listen to as well.
"""

from __future__ import annotations

import contextlib
import io
import json
import logging
import os
import sys
import time
import warnings
from collections.abc import Iterable, Iterator, Mapping
from contextvars import ContextVar
from typing import Any, Literal

from facepipe.core.errors import printable
from facepipe.core.reports import Report, unwatched

Loudness = Literal["quiet", "usual", "verbose"]

_loudness: ContextVar[Loudness] = ContextVar("facepipe_loudness", default="usual")
_log = logging.getLogger(__name__)


@contextlib.contextmanager
def speaking(loudness: Loudness) -> Iterator[None]:
    """In the block, stderr gets errors alone (quiet), or also debug lines with the milliseconds since the start."""
    token, logger, level = _loudness.set(loudness), logging.getLogger("facepipe"), logging.getLogger("facepipe").level
    lines = logging.StreamHandler(sys.stderr)
    lines.setFormatter(logging.Formatter("facepipe: %(relativeCreated)d ms: %(message)s"))
    if loudness == "verbose":
        logger.addHandler(lines)
        logger.setLevel(logging.DEBUG)
    try:
        yield
    finally:
        logger.removeHandler(lines)
        logger.setLevel(level)
        _loudness.reset(token)


def is_quiet() -> bool:
    """Whether stderr gets errors alone."""
    return _loudness.get() == "quiet"


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
    """Print a fact to stderr, unless all is to be quiet."""
    if not is_quiet():
        print(f"facepipe: {printable(line)}", file=sys.stderr)


def noted_names(given: str | None, names: Mapping[str, str]) -> None:
    """Print how many names a `--rename` changed to stderr."""
    if given is not None:
        like = next((f", like '{old}' to '{new}'" for old, new in names.items()), "")
        note(f"--rename {given}: {len(names)} names changed{like}")


@contextlib.contextmanager
def progress(label: str, total: int) -> Iterator[Any]:
    """A bar on stderr with ``update()`` per step; shown on a terminal only, and as a line with its time if verbose."""
    start = time.perf_counter()
    with contextlib.ExitStack() as shown:
        if _loudness.get() == "usual" and sys.stderr.isatty():
            from tqdm import tqdm  # 0.01 s

            bar = shown.enter_context(tqdm(total=total, desc=label, file=sys.stderr, leave=False))
            bar.show = lambda _: None  # a terminal has no pictures
            yield bar
        else:
            yield shown.enter_context(unwatched(label, total))
    _log.debug("%s: %d step(s) in %.3f s", label, total, time.perf_counter() - start)


@contextlib.contextmanager
def quiet_libraries() -> Iterator[None]:
    """No warnings of Python and numpy, and nothing that C++ writes to stderr: USD, onnxruntime, libtiff.

    `sys.stderr` still leads where stderr led. Warnings that Python was asked for (``-W``, ``PYTHONWARNINGS``) stay.
    """
    with warnings.catch_warnings(), _own_stderr():
        if not sys.warnoptions:
            warnings.simplefilter("ignore")
        # errors that C++ code or a finaliser swallows: USD does so over values that Python can't hold
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
