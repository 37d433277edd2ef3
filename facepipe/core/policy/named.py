"""Files that texts name: those in a file, and those that a project chooses for options.

Each is checked before it is opened, listed or looked at. docs/paths.md lists who asks for what.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path

from facepipe.core.errors import InputError
from facepipe.core.policy.paths import check_copied, is_below, trust
from facepipe.core.policy.urls import is_url


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
