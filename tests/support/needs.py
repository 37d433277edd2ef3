"""What tests need that the extra [dev] lacks: they are marked `needs_NAME`, and left out where it is missing."""

from __future__ import annotations

import ast
import importlib.util
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import pytest


class Need(NamedTuple):
    """Modules of an extra."""

    modules: tuple[str, ...]
    extra: str  # empty for what conflicts with the others, and needs an environment of its own

    @property
    def is_met(self) -> bool:
        """Whether all are installed."""
        return all(importlib.util.find_spec(module) for module in self.modules)


NEEDS = {
    "needs_torch": Need(("torch",), "train"),
    "needs_scan": Need(("pycolmap", "cv2"), "scan"),
    "needs_mediapipe": Need(("mediapipe",), ""),
}
MISSING = {name: need for name, need in NEEDS.items() if not need.is_met}


TORCH_ROOMS = (  # which can't be imported without it
    *("facepipe.rig.torch", "facepipe.neural.learning"),
    *("facepipe.photo.amortised", "facepipe.photo.descent", "facepipe.photo.features", "facepipe.photo.renderer"),
)


class LeftOut(pytest.Module):
    """The tests of a file that can't even be imported without what it needs: one for each function."""

    def collect(self) -> Iterator[pytest.Item]:
        """Items that are skipped."""
        text = self.path.read_text(encoding="utf-8")
        for node in ast.parse(text).body:
            if isinstance(node, ast.FunctionDef) and node.name.startswith("test_"):
                item = _Unread.from_parent(self, name=node.name)
                marks = " ".join(map(ast.unparse, node.decorator_list)) + _marks_of(text)
                for mark in (*NEEDS, "slow", "gate"):
                    if re.search(rf"mark\.{mark}\b", marks):
                        item.add_marker(mark)
                yield item

    def _getobj(self) -> Any:
        return None


class _Unread(pytest.Item):
    def runtest(self) -> None:
        """It never runs: it is skipped."""

    def reportinfo(self) -> tuple[Path, int, str]:
        """For the log."""
        return self.path, 0, self.name


def left_out(path: Path, parent: pytest.Collector) -> LeftOut | None:
    """The collector of a file that needs what is missing; None for others."""
    marks = _marks_of(path.read_text(encoding="utf-8"))
    if any(re.search(rf"mark\.{name}\b", marks) for name in MISSING):
        collector: LeftOut = LeftOut.from_parent(parent, path=path)
        return collector
    return None


def _marks_of(text: str) -> str:
    """The marks of a whole file."""
    return "".join(re.findall(r"^pytestmark = .*$", text, re.MULTILINE))


def skip(items: list[pytest.Item]) -> None:
    """Skip those that need what is missing."""
    for item in items:
        for name in MISSING:
            if item.get_closest_marker(name):
                item.add_marker(pytest.mark.skip(reason=name))


def summary(skipped: list[str]) -> Iterator[str]:
    """Lines that say how many tests were left out, and what runs them too.

    :param skipped: the reasons of skips
    """
    missing = {name: skipped.count(name) for name in MISSING if name in skipped and MISSING[name].extra}
    if missing:
        extras = ",".join(("dev", *(MISSING[name].extra for name in missing)))
        counts = " and ".join(f"{count} tests ({name})" for name, count in missing.items())
        words = f"-m '({' or '.join(missing)}) and not slow'"
        yield f"left out: {counts}; to run them too: pip install -e '.[{extras}]' && python -m pytest -n auto {words}"
    others = sorted({reason for reason in skipped if reason not in missing})
    yield from (f"left out: {skipped.count(reason)} tests: {reason}" for reason in others)
