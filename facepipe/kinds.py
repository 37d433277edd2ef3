"""The kinds of actions, of which each is declared once, in the folder of its processor.

    @action("shrink", "draw points closer to their centre")
    @dataclass(frozen=True, kw_only=True)
    class Shrink(StageAction[ShrinkReport]):
        # a docstring, the text of --help

        face: Path = source("face stage")
        width_mm: float = option(3.0, "width of the border", 0.0, 100.0, "mm")
        picture: Path | None = beside("draw what moved", ".png", "draw")

        def author(self, face: Face, job: Job) -> ShrinkReport: ...

The command with its flags and help, the recipe and its cooking, `--edit` and the Python function follow from that.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Generic, TypeVar

from facepipe.core.errors import InputError
from facepipe.declare import check_ranges, fields_of

if TYPE_CHECKING:
    from facepipe.core.reports import Report, Watch
    from facepipe.parts import FaceParts, Recipe
    from facepipe.stage import Face

FOUND = "found"  # key of a recipe's options for what the action found


def found_of(recipe: Recipe | None) -> Mapping[str, Any]:
    """What the action of a recipe found; nothing where there is no recipe, or it is damaged there."""
    options = None if recipe is None else recipe.options
    found = options.get(FOUND) if isinstance(options, Mapping) else None
    return found if isinstance(found, Mapping) else {}


A = TypeVar("A", bound="Action[Any]")
R = TypeVar("R", bound="Report")


@dataclass(frozen=True, kw_only=True)
class Job:
    """What an action gets for its work."""

    out: Path
    watch: Watch
    recipe: Callable[..., Recipe]  # of `out`: job.recipe(quality=...) with what was found; or of a changed action


class Action(ABC, Generic[R]):
    """Base of all actions."""

    verb: ClassVar[str]
    summary: ClassVar[str]
    remote: ClassVar[bool] = False  # a server does it for others
    own_flags: ClassVar[tuple[str, ...]] = ()  # fields whose flags `add_flags` adds, and `line_values` reads

    @classmethod
    def add_flags(cls, parser: Any) -> None:
        """Add flags to the command's parser that are not a field each."""

    @classmethod
    def line_values(cls, arguments: Any, values: dict[str, Any]) -> dict[str, Any]:
        """The values of all fields, with those of flags that are not a field each.

        :param arguments: what was parsed
        :param values: those of the recipe that is edited, with those given as fields of their own
        :raises InputError: flags that don't go together
        """
        return values

    @property
    def base(self) -> Path:
        """The first file that it works on.

        :raises InputError: there is none
        """
        first = next(field for field in fields_of(type(self)) if field.role == "source")
        value = getattr(self, first.name)
        if not value:
            raise InputError(first.shown, f"none given, expected {first.help.split(';')[0]}")
        return Path(value[0] if isinstance(value, tuple) else value)

    @property
    def further_files(self) -> tuple[Path, ...]:
        """What the result is made of beside its sources: files that these name."""
        return ()

    def check(self) -> None:
        """Check what can be checked before any file is read.

        :raises InputError: options out of range, or that don't go together
        """
        check_ranges(self)

    def missed(self, report: R) -> bool:
        """Whether a check or threshold was missed, though the result is written: what a report has as `missed`."""
        return bool(getattr(report, "missed", ()))

    def text(self, report: R, out: Path) -> str:
        """The report for people."""
        return report.as_text(out)


class StageAction(Action[R]):
    """Base of the actions that make a face stage of others: a layer over `base`, with a recipe."""

    exported: ClassVar[
        Mapping[str, Any]
    ] = {}  # options of the format where an exporter writes the result, if it has them

    @classmethod
    def replaced(cls, arguments: Any) -> Collection[str]:
        """Fields of the recipe that the line leaves out, beside those that it gives: their files may be lost.

        :param arguments: what was parsed
        """
        return ()

    def made_base(self) -> Face | tuple[FaceParts, tuple[str, ...]] | None:
        """The face to put the layer over where that is no file's, and warnings of it; None: it is that of `base`.

        That of `base` itself where it has been opened: a head's stage opens in a tenth of a second.
        """
        return None

    @abstractmethod
    def author(self, face: Face, job: Job) -> R:
        """Do the work on `face`, a layer over the base that is saved when this ends well.

        :raises FacepipeError: what can't be read or done; then nothing is written
        """


class FileAction(Action[R]):
    """Base of the actions that make a file of files; it has no recipe."""

    output: ClassVar[str]  # what it is, for the help
    suffixes: ClassVar[tuple[str, ...]]  # that it may have
    alone: ClassVar[bool] = False  # others who change the file wait, from before anything is read

    @classmethod
    def with_it(cls, out: Path) -> tuple[Path, ...]:
        """Files that may be written with `out`, named after it."""
        return ()

    @abstractmethod
    def write(self, job: Job) -> R:
        """Do the work, write ``job.out`` whole or not at all.

        :raises FacepipeError: what can't be read, done or written
        """


class FolderAction(FileAction[R]):
    """Base of the actions that make a folder of files with report.json in it; it has no recipe."""

    suffixes = ()
    holds: ClassVar[str]  # pattern of the names in it: a folder with others is never replaced


class InPlaceAction(FileAction[R]):
    """Base of the actions that change `base` itself, unless they are asked for another file."""

    output = "write another file (default: in place)"
    alone = True


class Inspector(Action[R]):
    """Base of the actions that look at files and write none."""

    @abstractmethod
    def look(self, watch: Watch) -> R:
        """Do the work; `text` has `base` for its file.

        :raises FacepipeError: what can't be read
        """


def action(verb: str, summary: str, *, remote: bool = False) -> Callable[[type[A]], type[A]]:
    """Declares an action: `facepipe VERB`; `summary` is its line in `facepipe --help`.

    :param remote: `facepipe serve` does it for others: it makes a face, of files that they send or have there
    """

    def declare(kind: type[A]) -> type[A]:
        kind.verb, kind.summary, kind.remote = verb, summary, remote
        return kind

    return declare
