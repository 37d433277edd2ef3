"""Faults for the mutation run: each is one change of what a function computes, and nothing else is touched."""

from __future__ import annotations

import ast

import benchmark_modules  # noqa: F401  (finds the modules of benchmarks/)
from mutant_edits import edits

SOURCE = b'''"""A module of 1 + 1."""

LIMIT = 3 + 4


def area(width: float = 1.5, note: str = "\xc3\xa9") -> float:
    """Of 2 * 3."""
    if width < 0 and note:
        raise ValueError(f"width {width - 1}", 7)
    total = 2.0
    total += width
    return -total if not note else total * 2
'''


def test_faults_of_a_function() -> None:
    found = [(edit.line, edit.kind, edit.before, edit.after) for edit in edits(SOURCE)]
    assert found == [
        (8, "comparison", "width < 0", "(width <= 0)"),
        (8, "condition", "width < 0 and note", "(not (width < 0 and note))"),
        (8, "logic", "width < 0 and note", "(width < 0 or note)"),
        (8, "constant", "0", "(0 + 1)"),
        (10, "constant", "2.0", "3.0"),
        (11, "statement", "total += width", "pass"),
        (12, "sign", "-total", "(total)"),
        (12, "condition", "not note", "(not (not note))"),
        (12, "sign", "not note", "(note)"),
        (12, "arithmetic", "total * 2", "(total / 2)"),
        (12, "constant", "2", "(2 + 1)"),
    ]


def test_each_fault_is_another_program() -> None:
    programs = [ast.unparse(ast.parse(edit.apply(SOURCE))) for edit in edits(SOURCE)]
    assert ast.unparse(ast.parse(SOURCE)) not in programs
