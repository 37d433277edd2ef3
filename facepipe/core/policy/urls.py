"""URLs of files: which there are, and what names of files (URLs or paths) that others wrote may reach.

A URL that the caller types allows its scheme, host and folder; one that a file holds must lie below one of these.
"""

from __future__ import annotations

import os
import posixpath
import re
from collections.abc import Collection, Iterable
from pathlib import Path

from facepipe.core.errors import InputError
from facepipe.core.policy.paths import OWN, PREFIX, is_below

SCHEMES = {"s3": "s3fs", "gs": "gcsfs", "memory": "fsspec"}  # -> package that it needs
_URL = re.compile(rf"({'|'.join(SCHEMES)})://[A-Za-z0-9][A-Za-z0-9._-]*(/[^/\\:*?\"<>|#@\x00-\x1f]+)*")


def is_url(name: str) -> bool:
    """Whether a name is no path, of whatever kind it is."""
    return "://" in name


def placed(folder: str | Path, path: str) -> str:
    """A path, from a folder where it is relative, in its shortest form; either can be a URL."""
    whole = path if is_url(path) or Path(path).is_absolute() else f"{folder}/{path}"
    scheme, mark, rest = whole.rpartition("://")
    return f"{scheme}{mark}{posixpath.normpath(rest)}" if mark else os.path.normpath(whole)


def checked(url: str, roots: Collection[str]) -> str:
    """A URL of a file or folder below one of the roots.

    :raises InputError: it is not, or is none: of another scheme, with a key or an option in it, with ``..`` in its path
    """
    plain = url.rstrip("/")
    parts = plain.split("/")
    if not _URL.fullmatch(plain) or {".", ".."} & {*parts} or any(part.startswith(PREFIX) for part in parts):
        shown = re.sub(r"//[^/]*@", "//...@", url)[:200]
        raise InputError(shown, f"can't be used, expected one like {'://, '.join(SCHEMES)}://BUCKET/FOLDER/FILE")
    if not any(f"{plain}/".startswith(f"{root.rstrip('/')}/") for root in roots):
        shown = ", ".join(roots) or "none has a URL"
        raise InputError(url, f"is outside the roots ({shown}), expected --root {'/'.join(parts[:3])}")
    return plain


def typed_roots(words: Iterable[str]) -> tuple[str, ...]:
    """The folders of the URLs among words that the caller types: up to the first wildcard or brace."""
    urls = [re.split(r"[*?\[{]", word)[0] for word in words if word.partition("://")[0] in SCHEMES and is_url(word)]
    return tuple(dict.fromkeys(url.rpartition("/")[0] for url in urls))


class Reach:
    """Whether names in records of others lie below the roots: each is asked about before anything is looked up there.

    Folders are looked at once: a record of a plan names a few in a million tasks. A hostile one names a hundred
    thousand, and to resolve each would take five seconds.
    """

    def __init__(self, folder: Path, roots: Iterable[Path], urls: Collection[str]) -> None:
        """:param folder: that paths are relative to"""
        self._folder, self._roots, self._urls = folder, (*roots, OWN), urls
        self._known = {str(folder): is_below(folder, self._roots)}

    def __call__(self, name: str) -> bool:
        """Whether a URL or a path does."""
        if is_url(name):
            try:
                return bool(checked(name, self._urls))
            except InputError:
                return False
        parent, last = os.path.split(os.path.join(self._folder, name))  # noqa: PTH118  (half the time)
        if parent not in self._known:
            self._known[parent] = self._is_plainly_below(parent) or is_below(Path(parent), self._roots)
        plain = last not in ("", ".", "..") and "\0" not in name and not os.path.islink(f"{parent}/{last}")  # noqa: PTH114
        return (self._known[parent] and plain) or is_below(Path(parent, last), self._roots)

    def _is_plainly_below(self, folder: str) -> bool:
        """Whether a folder lies in one that is known to be below the roots, with no link on the way."""
        while not self._known.get(folder):
            above, last = os.path.split(folder)
            if last in ("", ".", "..") or os.path.islink(folder):  # noqa: PTH114  (never raises)
                return False
            folder = above
        return True
