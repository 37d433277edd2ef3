"""The files of a face as a browser sends them, written to a folder while they come."""

from __future__ import annotations

from pathlib import Path
from typing import IO, Any

from starlette.requests import Request

from facepipe.core.errors import InputError
from facepipe.server.uploads import checked_name

_MOST_FILES = 200
_MOST_FIELD = 1000  # bytes of one that is no file


class _Parts:
    """Called by the parser, piece by piece."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.files, self.fields = folder, list[str](), dict[str, bytes]()
        self._name, self._value, self._headers = b"", b"", dict[bytes, bytes]()
        self._file: IO[bytes] | None = None
        self._field, self.ended = "", False

    def on_end(self) -> None:
        self.ended = True

    def on_part_begin(self) -> None:
        self._headers = {}

    def on_header_field(self, data: bytes, start: int, end: int) -> None:
        self._name += data[start:end]

    def on_header_value(self, data: bytes, start: int, end: int) -> None:
        self._value += data[start:end]

    def on_header_end(self) -> None:
        self._headers[self._name.lower()] = self._value
        self._name = self._value = b""

    def on_headers_finished(self) -> None:
        from python_multipart.multipart import parse_options_header

        options = parse_options_header(self._headers.get(b"content-disposition", b""))[1]
        try:
            self._field = options.get(b"name", b"").decode()
            given = options[b"filename"].decode() if b"filename" in options else None
        except UnicodeDecodeError:
            raise InputError("multipart", "has a name that is no UTF-8") from None
        if given is None:
            self.fields[self._field] = b""
            return
        name = checked_name(given)
        if name in self.files or len(self.files) >= _MOST_FILES:
            raise InputError("multipart", f"expected up to {_MOST_FILES} files of different names")
        self.files.append(name)
        place = self.folder / name
        try:
            place.parent.mkdir(parents=True, exist_ok=True)
            self._file = place.open("xb")
        except (FileExistsError, NotADirectoryError):  # a file and a folder of one name
            raise InputError("multipart", "expected files of different names") from None

    def on_part_data(self, data: bytes, start: int, end: int) -> None:
        if self._file is not None:
            self._file.write(data[start:end])
        elif self._field in self.fields:
            self.fields[self._field] += data[start:end]
            if len(self.fields) > _MOST_FILES or len(self.fields[self._field]) > _MOST_FIELD:
                raise InputError("multipart", f"expected fields of up to {_MOST_FIELD} bytes")

    def on_part_end(self) -> None:
        self.close()
        self._field = ""

    def close(self) -> None:
        """Close the file that is being written."""
        if self._file is not None:
            self._file.close()
            self._file = None


async def received(request: Request, folder: Path) -> tuple[list[str], dict[str, str]]:
    """The names of the files that a request brings, and its other fields.

    :raises InputError: another kind of body, one that is cut off, or names that files here can't have
    """
    from python_multipart.exceptions import FormParserError
    from python_multipart.multipart import MultipartParser, parse_options_header

    kind, options = parse_options_header(request.headers.get("content-type", ""))
    if kind != b"multipart/form-data" or not options.get(b"boundary"):
        raise InputError("Content-Type", "expected multipart/form-data")
    parts = _Parts(folder)
    names = ("on_part_begin", "on_part_data", "on_part_end", "on_header_field", "on_header_value", "on_header_end")
    calls: Any = {name: getattr(parts, name) for name in (*names, "on_headers_finished", "on_end")}
    try:
        parser = MultipartParser(options[b"boundary"], calls)
        async for piece in request.stream():
            parser.write(piece)
        if not parts.ended:
            raise InputError("multipart", "is cut off")
        return parts.files, {name: value.decode() for name, value in parts.fields.items()}
    except (FormParserError, UnicodeDecodeError):
        raise InputError("multipart", "is damaged") from None
    finally:
        parts.close()


async def body(request: Request, file: Path) -> None:
    """Write a request's body to a file."""
    with file.open("xb") as out:
        async for piece in request.stream():
            out.write(piece)
