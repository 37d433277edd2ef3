"""Files at URLs as files of this process: lines read and write copies of them, which stand below a folder as the
originals do in their store, so that relative paths from one to another lead where they should."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import re
import shutil
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextvars import copy_context
from pathlib import Path
from typing import Any, TypeVar

from facepipe.core.atomic import hidden_folder
from facepipe.core.errors import ChangedError, InputError, system_errors
from facepipe.core.policy.paths import SCHEMES, checked, is_url, private_folder
from facepipe.core.reading import digest
from facepipe.stage.files import SUFFIXES, named_in
from facepipe.tasks import contents
from facepipe.tasks.contents import Cache
from facepipe.tasks.remote import State, Store, check_size, state_in

T = TypeVar("T")
_SCHEME = re.compile(r"[\w.:+-]*://")
_FILE = re.compile(r"[\w.+-]+://[^:]*")  # of FILE and FILE:NAME
_TILES = "<UDIM>"
_COPIES = "copies"  # folder of those that are kept
_AT_ONCE = 8  # requests
_TRIES = 3  # of a file that changes while it is copied


class Mirror:
    """The copies of one task."""

    def __init__(self, folder: Path, urls: Sequence[str], copies: Path, most_bytes: int) -> None:
        """
        :param folder: of this process alone; without roots there need be none, and all names are paths
        :param urls: roots
        :param copies: folder that keeps copies for other tasks, of other processes too, up to a size
        :raises InputError: a root that is no URL
        """
        self._folder, self._urls = folder, [checked(url, [url]) for url in urls]
        self._copies, self._most = copies, most_bytes
        self._states: dict[str, State | None] = {}  # of the files that this task has looked at
        self._stores: dict[str, Store] = {}
        self._own = re.compile(rf"{re.escape(str(folder))}[/\\]({'|'.join(SCHEMES)})[/\\]")
        self.clear()

    @property
    def roots(self) -> list[Path]:
        """The folders of the URLs that lines may read and write."""
        return [self.path(url) for url in self._urls]

    def clear(self) -> None:
        """Forget what a task had."""
        self._states.clear()
        for scheme in SCHEMES:
            shutil.rmtree(self._folder / scheme, ignore_errors=True)
        for root in self.roots:
            root.mkdir(parents=True, exist_ok=True)

    def path(self, name: str) -> Path:
        """Where a file is here."""
        return Path(self._local(name))

    def name(self, path: Path) -> str:
        """What a path is called elsewhere: its URL where it has one."""
        return str(self.with_urls(str(path.absolute()))) if self._holds(path) else path.as_posix()

    def with_urls(self, value: Any) -> Any:
        """A text, or the texts in a record, with URLs in place of paths of copies."""
        if isinstance(value, str):
            return self._own.sub(r"\1://", value)
        if isinstance(value, Mapping):
            return {self.with_urls(key): self.with_urls(one) for key, one in value.items()}
        return [self.with_urls(one) for one in value] if isinstance(value, list | tuple) else value

    def words(self, words: Sequence[str]) -> list[str]:
        """The words of a line with paths in place of URLs; what they name is copied here, but for the result.

        :raises FacepipeError: a URL outside the roots, or a store that does not answer
        """
        local = [self._local(word) for word in words]
        results = {place + 1 for place, word in enumerate(words) if word == "-o"}
        named = (_FILE.match(word) for place, word in enumerate(words) if place not in results)
        self.fetch(self.path(found[0]) for found in named if found)
        return local

    def fetch(self, paths: Iterable[Path]) -> None:
        """Copy files and folders here, with the layers, textures and buffers that they name.

        :raises FacepipeError: one outside the roots, a damaged one, or a store that does not answer
        """
        todo = {self.name(path) for path in paths if self._holds(path)}
        while todo:
            files = self._files(sorted(todo - self._states.keys()))
            _at_once(self._copy, files, files.values())
            named = {one for url in files for one in contents.named(self.path(url)) if self._holds(one)}
            todo = {self.name(one) for one in named} - self._states.keys()

    def state(self, name: str) -> State | contents.State | None:
        """A mark of a file that changes with it; None where there is no file."""
        if not is_url(name):
            return contents.state_of(name)
        if name not in self._states:
            info = self._store(name).info(checked(name, self._urls))
            return None if info is None else state_in(info)
        return self._states[name]

    def digest(self, name: str) -> str:
        """:raises FacepipeError: a file that can't be read"""
        path = self.path(name)
        self.fetch([path])
        return digest([path])

    def put(self, name: str, content: str) -> State | contents.State | None:
        """Bring a file that was written to where other processes look for it; its state there.

        :param content: its digest
        :raises FacepipeError: a URL outside the roots, or a store that does not answer
        """
        if is_url(name):
            store, path = self._store(checked(name, self._urls)), self.path(name)
            store.put(path, name)
            info = store.info(name)
            self._states[name] = state = (0, "") if info is None else state_in(info)
            check_size(name, state[0], path.stat().st_size)
            self._keep(name, content)
        return self.state(name)

    def remove(self, names: Iterable[str]) -> None:
        """Remove files at URLs."""
        for name in names:
            if is_url(name):
                self._store(name).remove(checked(name, self._urls))

    def check_named(self, path: Path) -> None:
        """:raises InputError: a stage that was written here stands on one at a URL, which USD doesn't read"""
        if self._urls and path.suffix.lower() in SUFFIXES and not self._holds(path):
            for one in filter(is_url, named_in(path)):
                raise InputError(path, f"stands on {one}, expected --flatten, or a result at a URL")

    def _local(self, word: str) -> str:
        def placed(match: re.Match[str]) -> str:
            scheme = match[0].removesuffix("://")
            if scheme.rpartition(":")[2] not in SCHEMES:
                return match[0]  # the address of a licence, say: nothing is read there
            if scheme not in SCHEMES or not self._urls:
                checked(word[match.start() :], ())  # says why
            return f"{self._folder}/{scheme}/"

        return _SCHEME.sub(placed, word)

    def _holds(self, path: Path) -> bool:
        return self._own.match(str(path.absolute())) is not None

    def _store(self, url: str) -> Store:
        scheme = url.partition("://")[0]
        if scheme not in self._stores:
            self._stores[scheme] = Store(url)
        return self._stores[scheme]

    def _files(self, urls: Sequence[str]) -> dict[str, State]:
        """The states of files, of all in folders, and of all tiles of a texture; what is not there is left out."""
        states: dict[str, State] = {}
        single = [checked(address.replace(_TILES, "1001"), self._urls) for address in urls]
        stores = [self._store(address) for address in single]
        infos = _at_once(Store.info, stores, single)
        for url, address, info in zip(urls, single, infos, strict=True):
            self._states[url] = None
            if _TILES in url:
                tile = re.compile(re.escape(url).replace(re.escape(_TILES), r"\d{4}"))
                listed = self._store(address).listed(address.rpartition("/")[0])
                states |= {name: state for name, state in listed.items() if tile.fullmatch(name)}
            elif info is not None and info["type"] == "directory":
                states |= self._store(address).listed(address, deep=True)
            elif info is not None:
                states[address] = state_in(info)
        return {url: state for url, state in states.items() if self._states.get(url) is None}

    def _copy(self, url: str, state: State | None) -> None:
        """Copy a file here as it is at one time."""
        path, store = self.path(checked(url, self._urls)), self._store(url)
        path.parent.mkdir(parents=True, exist_ok=True)
        for _ in range(_TRIES):
            self._states[url] = state
            if state is None or self._cache().fetch(self._key(url), path.__eq__):
                return
            store.get(url, path)
            info = store.info(url)
            after = None if info is None else state_in(info)
            if after == state:
                check_size(url, path.stat().st_size, state[0])
                self._keep(url, digest([path]))
                return
            state = after
        raise ChangedError(url, "changes while it is read, expected a file that nobody writes")

    def _key(self, url: str) -> str:
        return hashlib.sha256(json.dumps([url, self._states[url]]).encode()).hexdigest()

    def _keep(self, url: str, own: str) -> None:
        self._cache().keep(self._key(url), {"writes": {url: [None, own]}})

    def _cache(self) -> Cache:
        return Cache(self._copies, self._most, self.path)


def _at_once(ask: Callable[..., T], *items: Iterable[Any]) -> list[T]:
    with ThreadPoolExecutor(_AT_ONCE) as pool:
        asked = [pool.submit(copy_context().run, ask, *each) for each in zip(*items, strict=True)]
        return [one.result() for one in asked]


@contextlib.contextmanager
def mirror(urls: Sequence[str], folder: str | None, most_bytes: int) -> Iterator[Mirror]:
    """The mirror of this process.

    :param urls: roots; nothing outside them is read or written
    :param folder: for it, and for the copies that are kept (default ``~/.cache/facepipe``)
    :raises InputError: a root that is no URL, or the folder can't be written or leads elsewhere
    """
    if not urls:
        yield Mirror(Path(os.devnull), (), Path(os.devnull), 0)
        return
    if folder is None:
        said = Path(os.environ.get("XDG_CACHE_HOME", ""))  # one that is relative would lie in the folder of the plan
        place = private_folder((said if said.is_absolute() else Path.home() / ".cache") / "facepipe")
    else:
        place = Path(folder)
        with system_errors(place, "can't be made"):
            place.mkdir(parents=True, exist_ok=True)
    if (place / _COPIES).is_symlink():
        raise InputError(place / _COPIES, "is a link, expected a folder")
    with hidden_folder(place) as own:
        yield Mirror(own, urls, place / _COPIES, most_bytes)
