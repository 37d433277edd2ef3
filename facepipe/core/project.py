"""The project that a caller works in: that of the variable FACEPIPE_PROJECT, else of the nearest ``facepipe.toml``
around the working folder. The latter may be somebody else's, so its roots don't count.

    roots = ["/mnt/assets", "../library"]

    [names]
    studio = "tables/names.csv"            # --rename studio

    [defaults.export]
    engine = "unity"
    rename = "studio"

    [defaults."neural-rig train"]
    steps = 4000

Paths are relative to the file, those of options too. An empty file marks the folder. Roots come on top of that folder.
Files that it names lie below these, or below the roots that the caller gives.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from facepipe.core.errors import InputError
from facepipe.core.names import check_keys
from facepipe.core.policy.paths import PROJECT, is_url
from facepipe.core.reading import read_toml

_MOST_BYTES = 1 << 20
VARIABLE = "FACEPIPE_PROJECT"
_KEYS = ("roots", "names", "defaults")


@dataclass(frozen=True, kw_only=True)
class Project:
    """The settings of a project."""

    file: Path
    roots: tuple[Path, ...] = ()
    trusted: bool = False  # the caller has named it
    names: Mapping[str, str] = field(default_factory=dict)  # tables of other names, by what they are called
    defaults: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)  # command -> option -> value

    @property
    def folders(self) -> tuple[Path, ...]:
        """Its folder, and its roots where it is trusted."""
        return (self.file.parent, *(self.roots if self.trusted else ()))


def project_around(folder: Path) -> Project | None:
    """The project that the environment names, else that of the nearest file around a folder; None where there is none.

    :raises InputError: a file that can't be read, or unknown keys or kinds of values in it
    """
    if os.environ.get(VARIABLE):
        return replace(_read(Path(os.environ[VARIABLE]).absolute()), trusted=True)
    for one in (folder.absolute(), *folder.absolute().parents):
        if (one / PROJECT).is_file():
            return _read(one / PROJECT)
    return None


def _read(file: Path) -> Project:
    content = read_toml(file, _MOST_BYTES)
    check_keys(file, content, _KEYS)
    roots, names, defaults = (content.get(key, kind()) for key, kind in zip(_KEYS, (list, dict, dict), strict=True))
    if not isinstance(roots, list) or not all(isinstance(root, str) for root in roots):
        raise InputError(f"{file} -> roots", 'expected a list of folders, like ["../library"]')
    for root in roots:
        if is_url(root):
            raise InputError(f"{file} -> roots", f"{root[:80]} is a URL, expected a folder")
    if not isinstance(names, dict) or not all(isinstance(one, str) for one in names.values()):
        raise InputError(f"{file} -> names", 'expected tables, like studio = "names.csv"')
    if not isinstance(defaults, dict) or not all(isinstance(default, dict) for default in defaults.values()):
        raise InputError(f"{file} -> defaults", "expected a table for each command, like [defaults.export]")
    return Project(file=file, roots=tuple(file.parent / root for root in roots), names=names, defaults=defaults)
