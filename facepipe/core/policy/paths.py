"""What files from elsewhere may do: where results go, where copied bytes come from, which files are read and loaded.

One policy for all that reads a stage, a recipe or a project of somebody else's. The caller chooses it (``--root``,
``--trust-models``, `trusting`, or the variable FACEPIPE_ROOTS); nothing that is read can change it.
"""

from __future__ import annotations

import os
import re
import stat
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from pathlib import Path

from facepipe.core.errors import InputError

ROOTS = "FACEPIPE_ROOTS"  # folders, separated as in PATH
PROJECT = "facepipe.toml"  # marks the folder of a project
PREFIX = ".facepipe-"  # of the names of files and folders that are there while others are written
OWN = Path(__file__).parents[2]  # networks and tables that come with facepipe
_CODE = (".pt2", ".pt", ".pth", ".ckpt", ".pkl", ".pickle", ".joblib")  # files that run code as they are loaded


@dataclass(frozen=True, kw_only=True)
class Trust:
    """A policy; without roots the root of a file is its project's folder, else its own."""

    roots: tuple[Path, ...] = ()
    urls: tuple[str, ...] = ()  # roots in remote stores, for what reads and writes there (`facepipe.farm`)
    project: tuple[Path, ...] = ()  # folders of the caller's project, which are the roots of the files in them
    models: bool = False  # models that can hold code are loaded
    confined: bool = False  # files outside the roots are not even read: for hosts that serve others


_given: ContextVar[Trust | None] = ContextVar("facepipe_trust", default=None)


def trust() -> Trust:
    """The policy in force: that of `trusting`, else the roots of the environment."""
    given = _given.get()
    if given is not None:
        return given
    roots, urls = roots_in(re.split(rf"{os.pathsep}(?!//)", os.environ.get(ROOTS, "")))
    return Trust(roots=roots, urls=urls)


def roots_in(said: Iterable[str]) -> tuple[tuple[Path, ...], tuple[str, ...]]:
    """Folders and URLs among roots as they are given."""
    given = [one for one in said if one]
    return tuple(Path(one) for one in given if "://" not in one), tuple(one for one in given if "://" in one)


@contextmanager
def trusting(policy: Trust) -> Iterator[None]:
    """`policy` is in force in the block, for this thread and the contexts copied from it.

    :raises InputError: a root that is no folder, or a confined policy without roots
    """
    for root in policy.roots:
        if not root.is_dir():
            raise InputError(f"--root {root}", "is no folder")
    if policy.confined and not policy.roots:
        raise InputError("--root", "none given, expected one that reads are confined to")
    token = _given.set(policy)
    try:
        yield
    finally:
        _given.reset(token)


def roots_of(file: Path) -> tuple[Path, ...]:
    """The roots of a stage, recipe or project: given ones, else the nearest project's folder, else its own."""
    given, project = trust().roots, trust().project
    if given:
        return given
    if is_below(file, project):
        return project
    folder = file.parent.resolve()  # of a link to a folder the one that it means: paths are compared so
    marked = (one for one in (folder, *folder.parents) if os.path.isfile(one / PROJECT))  # noqa: PTH113  (never raises)
    return (next(marked, folder),)


def is_below(path: Path, folders: Iterable[Path]) -> bool:
    """Whether a path, once all links are followed, lies in one of the folders or below it; it need not exist."""
    meant = _meant(path)
    return meant is not None and any(meant.is_relative_to(one) for one in map(_meant, folders) if one is not None)


def _meant(path: Path) -> Path | None:
    """A path with all links followed; None for links in a circle and names that no file can have."""
    try:
        return path.resolve()
    except (OSError, RuntimeError, ValueError):
        return None


def is_writable(path: Path, folders: Iterable[Path]) -> bool:
    """Whether a file that is written at a path lies in one of the folders or below it.

    So must the folder that the path names, where a temporary file and a lock come, and what a link there leads to.
    """
    folders = tuple(folders)
    return is_below(path.parent, folders) and is_below(path, folders)


def check_writable(where: object, path: Path, file: Path) -> None:
    """Check a path that `file` says is written.

    :raises InputError: outside the roots of `file`
    """
    if not is_writable(path, roots_of(file)):
        raise InputError(where, f"{path} is outside the roots ({_shown(roots_of(file))}), expected --root")


def check_beside(path: Path, file: Path) -> None:
    """Check a file or folder that is written beside `file`, which the caller named: links can lead it elsewhere.

    :raises InputError: neither below the roots of `file` nor below its folder
    """
    folders = (*roots_of(file), file.parent)
    if not is_writable(path, folders):
        raise InputError(path, f"leads outside the roots ({_shown(folders)}), expected --root")


def check_copied(where: object, path: Path, file: Path) -> None:
    """Check a file whose bytes go into an output because `file`, a layer or document, names it.

    :raises InputError: neither below the roots of `file` nor below its folder
    """
    folders = (*roots_of(file), file.absolute().parent)
    if not is_below(path, folders):
        raise InputError(where, f"{path} is outside the roots ({_shown(folders)}), expected --root")


def check_links(path: Path) -> None:
    """Check a file or folder that is written: links of somebody else's folder don't lead it elsewhere.

    What the caller names is written where it says. But a link on the way that lies below the roots (given ones, else
    those of the project, else of the working folder) must not lead out of them; other links are the caller's own.

    :raises InputError: one does
    """
    place = Path(os.path.abspath(path))  # noqa: PTH100  (links stay)
    links = [one for one in (place, *place.parents) if os.path.islink(one)]  # noqa: PTH114  (never raises)
    if not links:
        return
    folders = trust().roots or trust().project or roots_of(Path.cwd() / "any")
    for one in links:
        if is_below(one.parent, folders) and not is_below(one, folders):
            meant = _meant(one) or one
            raise InputError(path, f"{one} leads outside the roots ({_shown(folders)}), expected --root {meant}")


def private_folder(path: Path) -> Path:
    """A folder of this user's for copies of what others may not see, made where there is none.

    :raises InputError: it can't be made, is a link, or is another user's
    """
    try:
        path.mkdir(parents=True, exist_ok=True, mode=0o700)
        state = path.lstat()
        if not stat.S_ISDIR(state.st_mode):
            raise InputError(path, "is a link, expected a folder")
        if sys.platform != "win32":
            if state.st_uid != os.geteuid():
                raise InputError(path, "belongs to another user, expected a folder of your own")
            path.chmod(0o700)
    except OSError as error:
        raise InputError(path, f"can't be made: {error.strerror or error}") from error
    return path


def check_readable(path: Path) -> None:
    """:raises InputError: reads are confined, and the path is outside the roots"""
    policy = trust()
    if policy.confined and not is_below(path, (*policy.roots, OWN)):
        raise InputError(path, f"is outside the roots ({_shown(policy.roots)})")


def check_model(path: Path) -> None:
    """:raises InputError: a model that can hold code, or a link to one, which the caller does not trust"""
    if not trust().models and any(one.suffix.lower() in _CODE for one in (path, _meant(path) or path)):
        raise InputError(path, "can run code as it is loaded, expected .onnx (or --trust-models)")


def _shown(folders: Iterable[Path]) -> str:
    return ", ".join(dict.fromkeys(map(str, folders)))
