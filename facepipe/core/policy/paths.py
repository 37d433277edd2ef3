"""What files from elsewhere may do: where results go, where copied bytes come from, which files are read and loaded.

One policy for all that reads a stage, a recipe or a project of somebody else's. The caller chooses it (``--root``,
``--trust-models``, `trusting`, or the variable FACEPIPE_ROOTS); nothing that is read can change it.
"""

from __future__ import annotations

import os
import posixpath
import re
import stat
import sys
from collections.abc import Collection, Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from pathlib import Path

from facepipe.core.errors import InputError, system_errors

ROOTS = "FACEPIPE_ROOTS"  # folders, separated as in PATH
PROJECT = "facepipe.toml"  # marks the folder of a project
_MOST_STEPS = 1000  # of a path, through links
PREFIX = ".facepipe-"  # of the names of files and folders that are there while others are written
OWN = Path(__file__).parents[2]  # networks and tables that come with facepipe
_CODE = (".pt2", ".pt", ".pth", ".ckpt", ".pkl", ".pickle", ".joblib")  # files that run code as they are loaded
SCHEMES = {"s3": "s3fs", "gs": "gcsfs", "memory": "fsspec"}  # -> package that it needs
_URL = re.compile(rf"({'|'.join(SCHEMES)})://[A-Za-z0-9][A-Za-z0-9._-]*(/[^/\\:*?\"<>|#@\x00-\x1f]+)*")


@dataclass(frozen=True, kw_only=True)
class Trust:
    """A policy; without roots the root of a file is its project's folder, else its own."""

    roots: tuple[Path, ...] = ()
    urls: tuple[str, ...] = ()  # roots in remote stores, for what reads and writes there (`facepipe.tasks`)
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
    if is_below(file, trust().project) and not trust().roots:
        return trust().project
    folder = file.parent.resolve()  # of a link to a folder the one that it means: paths are compared so
    return _known_roots(folder) or (folder,)


def _known_roots(folder: Path) -> tuple[Path, ...]:
    """The roots that hold for what is in a folder, whose path is without links; none where nobody has said any."""
    given, project = trust().roots, trust().project
    if given:
        return given
    if is_below(folder, project):
        return project
    marked = (one for one in (folder, *folder.parents) if os.path.isfile(one / PROJECT))  # noqa: PTH113  (never raises)
    return tuple(marked)[:1]


def is_below(path: Path, folders: Iterable[Path]) -> bool:
    """Whether a path, once all links are followed, lies in one of the folders or below it; it need not exist."""
    meant = real_path(path)
    return meant is not None and any(meant.is_relative_to(one) for one in map(real_path, folders) if one is not None)


def real_path(path: Path) -> Path | None:
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


def check_written(path: Path) -> None:
    """Check a file or folder that is written where the caller says, or beside that.

    It goes where its path leads, but for links that somebody may have put there: a link in its place must lead to below
    the roots, or its own folder; one to a folder on the way, that lies in the roots (those given, else those of the
    project, else the working folder), must not lead out of them. Links elsewhere are the caller's own.

    :raises InputError: such a link
    """
    place, left = Path(path.absolute().anchor), list(reversed(path.absolute().parts[1:]))
    for _ in range(_MOST_STEPS):
        if not left:
            return
        name = left.pop()
        step = place.parent if name == ".." else place / name
        if not os.path.islink(step):  # noqa: PTH114  (False for names that no file can have)
            place = step
            continue
        roots = _known_roots(place)
        allowed = (*(roots or (place,)), place) if not left else roots or (Path.cwd(),)
        if (not left or is_below(place, allowed)) and not is_below(step, allowed):
            meant = real_path(step) or step
            folder = meant if left else meant.parent
            shown = f"is a link to {meant}, outside the roots ({_shown(allowed)}), expected --root {folder}"
            raise InputError(path, shown if path == step else f"{step} {shown}")
        link = step.readlink()
        place = Path(link.anchor) if link.anchor else place
        left += reversed(link.parts[1:] if link.anchor else link.parts)
    raise InputError(path, f"more than {_MOST_STEPS} folders and links, expected fewer")


def check_copied(where: object, path: Path, file: Path) -> None:
    """Check a file whose bytes go into an output because `file`, a layer or document, names it.

    :raises InputError: neither below the roots of `file` nor below its folder
    """
    folders = (*roots_of(file), file.absolute().parent)
    if not is_below(path, folders):
        raise InputError(where, f"{os.path.normpath(path)} is outside the roots ({_shown(folders)}), expected --root")


def private_folder(path: Path) -> Path:
    """A folder of this user's for copies of what others may not see, made where there is none.

    :raises InputError: it can't be made, is a link, or is another user's
    """
    with system_errors(path, "can't be made"):
        path.mkdir(parents=True, exist_ok=True, mode=0o700)
        state = path.lstat()
        if not stat.S_ISDIR(state.st_mode):
            raise InputError(path, "is a link, expected a folder")
        if sys.platform != "win32":
            if state.st_uid != os.geteuid():
                raise InputError(path, "belongs to another user, expected a folder of your own")
            path.chmod(0o700)
    return path


def check_found(path: Path, near: Path) -> None:
    """Check a file that lies in the folder `near`, or beside the file `near`: a link can lead it elsewhere.

    :raises InputError: neither below the roots there nor below the folder
    """
    check_copied(path, path, near / "any" if near.is_dir() else near)


def check_readable(path: Path) -> None:
    """:raises InputError: reads are confined, and the path is outside the roots"""
    policy = trust()
    if policy.confined and not is_below(path, (*policy.roots, OWN)):
        raise InputError(path, f"is outside the roots ({_shown(policy.roots)})")


def check_model(path: Path) -> None:
    """:raises InputError: a model that can hold code, or a link to one, which the caller does not trust"""
    if not trust().models and any(one.suffix.lower() in _CODE for one in (path, real_path(path) or path)):
        raise InputError(path, "can run code as it is loaded, expected .onnx (or --trust-models)")


def _shown(folders: Iterable[Path]) -> str:
    return ", ".join(dict.fromkeys(map(str, folders)))


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


def file_named(where: object, name: str, file: Path) -> Path:
    """The path that a text in `file` means, from its folder where it is relative.

    :raises InputError: a URL, or neither below the roots of `file` nor below its folder
    """
    path = path_named(where, name, file)
    check_copied(where, path, file)
    return path


def file_chosen(where: object, name: str, project: Path, folders: Iterable[Path]) -> Path:
    """The path that the project file `project` chooses for an option, from its folder where it is relative.

    :param folders: of the project, with its roots where the caller trusts it
    :raises InputError: a URL, or outside of these folders and the given roots
    """
    # the caller shows it from elsewhere, where links before `..` would no longer be followed
    path = Path(os.path.normpath(path_named(where, name, project)))
    allowed = (*folders, *trust().roots)
    if not is_below(path, allowed):
        shown = ", ".join(dict.fromkeys(map(str, allowed)))
        raise InputError(where, f"{path} is outside the roots ({shown}), expected --root")
    return path


def path_named(where: object, name: str, file: Path) -> Path:
    """The path that a text in `file` means, for a further check.

    :raises InputError: a URL
    """
    if is_url(name):
        raise InputError(where, f"{name[:80]} is a URL, expected a file")
    return file.parent / name
