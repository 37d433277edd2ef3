"""Progress of a task, and reports of what was done: frozen dataclasses that serialise to JSON, and text for people."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, Protocol


class Bar(Protocol):
    """Progress of one task."""

    def show(self, picture: Callable[[], bytes]) -> object:
        """How it stands, from here on: a JPEG that is drawn where somebody looks."""

    def update(self) -> object:
        """One step is done."""


Watch = Callable[[str, int], AbstractContextManager[Any]]  # label, steps -> the task's `Bar`


@contextmanager
def unwatched(label: str, steps: int) -> Iterator[Bar]:
    """Progress that is not shown."""
    yield _Unseen()


class _Unseen:
    """A bar that shows nothing."""

    def show(self, picture: Callable[[], bytes]) -> None:
        """How it stands."""

    def update(self) -> None:
        """One step is done."""


def not_in_json() -> Any:
    """A field of a report for what draws pictures or pages of it; it is not in the JSON."""
    return field(default=None, repr=False, compare=False, metadata={"in_json": False})


@dataclass(frozen=True, kw_only=True)
class Report:
    """Base of all reports."""

    warnings: tuple[str, ...] = ()

    def to_json(self) -> str:
        """The report as JSON, keys sorted."""
        fields = (field.name for field in dataclasses.fields(self) if field.metadata.get("in_json", True))
        return json.dumps({name: getattr(self, name) for name in fields}, default=_plain, sort_keys=True, indent=2)

    def to_dict(self) -> dict[str, Any]:
        """What `to_json` writes, as texts, numbers, lists and mappings."""
        content: dict[str, Any] = json.loads(self.to_json())
        return content

    def as_text(self, out: Path) -> str:
        """The report for people, of what is at `out`."""
        return str(out)


@dataclass(frozen=True, kw_only=True)
class ExportReport(Report):
    """What an exporter wrote, and what the format could not hold."""

    path: Path
    files: tuple[Path, ...] = ()  # everything written, the sidecars too
    counts: Mapping[str, int] = field(default_factory=dict)  # joints, shapes, vertices ...
    bytes: int = 0
    seconds: float = 0.0
    dropped: tuple[str, ...] = ()  # what the format can't hold, one line each
    added: tuple[str, ...] = ()  # what the format asks for and the face lacks, one line each
    chosen: tuple[str, ...] = ()  # what the file's purpose asked for, one line each
    # Largest error, where there is one: of offsets quantised or left out, in the bind pose, at most, whatever shapes
    # are on together, plus that of fewer influences over the face's own animations, plus that of quantised weights
    # where the joints of a point take it a head height apart.
    # Of ONNX weights in fewer bytes: of points, over slider values. Of learned sliders: theirs, and that.
    error_mm: float | None = None
    pose: str = "rest"  # the person that is the file's rest: the template, or what it was set by
    renamed: Mapping[str, str] = field(default_factory=dict)  # names that were changed, old -> new
    # Of expressions on top of a person that is set, over all shapes at 1 and random poses: mean_mm, max_mm, counts.
    pose_error: Mapping[str, float] | None = None


@dataclass(frozen=True, kw_only=True)
class Finding:
    """One thing that a check found."""

    check: str  # "facepipe:SkinWeightsSum"
    severity: Literal["error", "warning", "info"]
    where: str  # the trail, outermost first: "head.usdc -> </Face/Head>"
    message: str  # one line: what was found, what was expected

    def __str__(self) -> str:
        return f"{self.severity}: {self.check}: {self.where}: {self.message}"


def _plain(value: Any) -> Any:
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return dataclasses.asdict(value)
    return value.tolist() if hasattr(value, "tolist") else str(value)  # arrays and numbers of numpy


def table(rows: Iterable[Sequence[object]]) -> str:
    """Rows as aligned columns; numbers to the right."""
    texts = [[str(cell) for cell in row] for row in rows]
    if not texts:
        return ""
    widths = [max(len(row[i]) for row in texts if i < len(row)) for i in range(max(map(len, texts)))]
    lines = []
    for row in texts:
        numbers = [one.replace(".", "").replace(",", "").replace("-", "").isdigit() for one in row]
        cells = zip(row, widths, numbers, strict=False)
        lines.append("  ".join(one.rjust(width) if right else one.ljust(width) for one, width, right in cells).rstrip())
    return "\n".join(lines)
