"""Files at URLs, through fsspec (https://filesystem-spec.readthedocs.io): Amazon's S3 and what speaks its protocol,
Google's storage, and this process's memory. Keys and addresses come from the environment, as their libraries read
it.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from facepipe.core.errors import FacepipeError, InputError
from facepipe.core.policy.paths import SCHEMES, is_url

State = tuple[int, str]  # bytes, and a mark of the version
_PATIENCE, _SLOWEST = 60.0, 20e3  # seconds for an upload, and bytes in each of those that it takes longer
_VERSIONS = ("ETag", "etag", "generation", "created", "LastModified", "mtime")  # as the stores call it


class StoreError(FacepipeError):
    """A store that does not answer, or not as it should; it may do so later."""


class Store:
    """The store of a URL's scheme."""

    def __init__(self, url: str) -> None:
        """:raises InputError: its library is not installed"""
        self._scheme = url.partition("://")[0]
        try:
            import fsspec

            with _asked(url):
                self._files = _strict(fsspec.filesystem(self._scheme, use_listings_cache=False), self._scheme)
        except ImportError:
            raise InputError(url, f"needs {SCHEMES[self._scheme]}: pip install {SCHEMES[self._scheme]}") from None

    def info(self, url: str) -> Mapping[str, Any] | None:
        """What the store knows about a file or folder; None where there is none."""
        with _asked(url), contextlib.suppress(FileNotFoundError):
            found: Mapping[str, Any] = self._files.info(url)
            return found
        return None

    def listed(self, folder: str, *, deep: bool = False) -> dict[str, State]:
        """The states of the files in a folder, with `deep` of those in its folders too, in a few requests."""
        with _asked(folder), contextlib.suppress(FileNotFoundError):
            found = self._files.find(folder, maxdepth=None if deep else 1, detail=True)
            return {self._url(name): state_in(one) for name, one in found.items() if one["type"] == "file"}
        return {}

    def matching(self, pattern: str) -> list[str]:
        """The URLs of files that are called like a pattern."""
        with _asked(pattern):
            return sorted(map(self._url, self._files.glob(pattern)))

    def read(self, url: str, most: int) -> bytes:
        """:raises InputError: there is no such file, or it is larger than that [bytes]"""
        with _asked(url):
            size = int(self._files.size(url))
            data = bytes(self._files.cat_file(url, end=most + 1))
        if len(data) > most:
            raise InputError(url, f"larger than {most} bytes")
        check_size(url, len(data), size)
        return data

    def get(self, url: str, path: Path) -> None:
        """Copy a file to a path; where the connection ends early, less of it may come."""
        # s3fs fetches parts at once into a file that has its full size before: a part cut short would not be seen
        options = {"max_concurrency": 1} if self._scheme == "s3" else {}
        with _asked(url):
            self._files.get_file(url, str(path), **options)

    def put(self, path: Path, url: str) -> None:
        """Copy a file to a URL, where it is seen whole or not at all.

        :raises FacepipeError: there is no bucket, or it took too long: libraries wait for ever where a server stops
            reading
        """
        size = path.stat().st_size
        seconds = _PATIENCE + size / _SLOWEST
        with _asked(url):
            try:
                if self._files.async_impl:
                    from fsspec.asyn import sync

                    sync(self._files.loop, self._files._put_file, str(path), url, timeout=seconds)
                else:
                    self._files.put_file(str(path), url)
            except FileNotFoundError as error:
                if "NoSuchUpload" in str(error.__cause__):  # it came to an end that the store could not confirm
                    raise StoreError(url, f"can't be written: {_line(error)}") from error
                raise InputError(url, "can't be written: no such bucket") from error
            except TimeoutError as error:
                raise StoreError(url, f"was not written in time ({seconds:.0f} seconds at most)") from error

    def remove(self, url: str) -> None:
        """Remove a file."""
        with _asked(url), contextlib.suppress(FileNotFoundError):
            self._files.rm_file(url)

    def remove_below(self, folder: str) -> None:
        """Remove all files below a folder, in S3 all their versions too."""
        with _asked(folder), contextlib.suppress(FileNotFoundError):
            if self._scheme != "s3":
                self._files.rm(list(self._files.find(folder)))
                return
            bucket, _, prefix = folder.removeprefix("s3://").partition("/")
            asked: dict[str, str] = {"Bucket": bucket, "Prefix": f"{prefix}/"}
            while True:  # a thousand at a time
                found = self._files.call_s3("list_object_versions", **asked)
                for one in (*found.get("Versions", ()), *found.get("DeleteMarkers", ())):
                    named = {"Bucket": bucket, "Key": one["Key"], "VersionId": one["VersionId"]}
                    self._files.call_s3("delete_object", **named)
                if not found.get("IsTruncated"):
                    return
                asked |= {"KeyMarker": found["NextKeyMarker"], "VersionIdMarker": found["NextVersionIdMarker"]}

    def _url(self, name: str) -> str:
        return f"{self._scheme}://{str(name).lstrip('/')}"


def check_size(url: str, size: int, expected: int) -> None:
    """:raises StoreError: fewer or more bytes than the store has: a connection that ended early is not always seen"""
    if size != expected:
        raise StoreError(url, f"{size} bytes came, expected {expected}")


def _strict(files: Any, scheme: str) -> Any:
    """A file system whose walks fail where a listing does: fsspec takes such a folder for an empty one."""
    listed = getattr(files, "_ls", None)
    if listed is None or hasattr(listed, "strict"):
        return files

    async def strict(path: str, *args: Any, **options: Any) -> Any:
        try:
            return await listed(path, *args, **options)
        except (FileNotFoundError, PermissionError):
            raise
        except OSError as error:
            raise StoreError(f"{scheme}://{path}", f"can't be listed: {_line(error)}") from error

    strict.strict = True  # type: ignore[attr-defined]
    files._ls = strict
    return files


def state_in(info: Mapping[str, Any]) -> State:
    """The state of a file from what a store knows about it."""
    return int(info["size"]), str(next((info[key] for key in _VERSIONS if info.get(key)), ""))


class States:
    """The states of files as they were when a run first asked: a listing for a folder, not a question for a file."""

    def __init__(self, deep: str) -> None:
        """:param deep: a URL, or empty: what is below it is listed at once"""
        self._deep = deep
        self._listed: set[str] = set()
        self._known: dict[str, State] = {}

    def __call__(self, url: str) -> State | None:
        """The state of a file; None where there is none, or its store does not answer."""
        deep = bool(self._deep) and url.startswith(f"{self._deep}/")
        folder = self._deep if deep else url.rpartition("/")[0]
        if folder not in self._listed:
            self._listed.add(folder)
            with contextlib.suppress(FacepipeError):  # who does the task says what is wrong
                self._known = {**Store(url).listed(folder, deep=deep), **self._known}
        return self._known.get(url)

    def learn(self, writes: Mapping[str, Iterable[Any]]) -> None:
        """What a task has written in the meantime."""
        self._known |= {name: tuple(state) for name, (state, _) in writes.items() if is_url(name)}


@contextlib.contextmanager
def _asked(url: str) -> Iterator[None]:
    """Errors of the libraries, of which each store has its own, in one line."""
    try:
        yield
    except (FacepipeError, ImportError):
        raise
    except FileNotFoundError:
        raise InputError(url, "no such file") from None
    except PermissionError as error:
        raise InputError(url, f"access denied: {_line(error)}") from None
    except Exception as error:
        raise StoreError(url, f"{type(error).__name__}: {_line(error)}") from None


def _line(error: Exception) -> str:
    return " ".join(str(error).split())[:200]
