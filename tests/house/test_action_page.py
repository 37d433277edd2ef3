"""docs/actions.md is what actions declare, and they declare each option once."""

from __future__ import annotations

import argparse
import re
import runpy
from typing import Any

import pytest
from places import REPOSITORY

from facepipe.actions import find_action, summaries
from facepipe.cli import command_module
from facepipe.cli.parser import Parser
from facepipe.declare import fields_of

PAGE = (REPOSITORY / "docs" / "actions.md").read_text(encoding="utf-8")
OF_ALL = {"--output", "--force", "--edit", "--flatten", "--json"}
LISTED = {"apply-bones": {"--info"}}  # what commands do beside their action
LAST = {"--help", "--verbose", "--quiet", "--root", "--trust-models"}  # of every command
LAST |= {"--replace"}  # of sources that are several


def test_the_page_is_what_its_script_makes() -> None:
    made = runpy.run_path(str(REPOSITORY / "docs" / "action_pages.py"))["page"](summaries())
    assert made == PAGE, "python docs/action_pages.py writes it"


@pytest.mark.parametrize("verb", summaries())
def test_the_page_has_every_flag_of_the_command(verb: str) -> None:
    section = re.split(r"^## ", PAGE, flags=re.MULTILINE)
    (text,) = (one for one in section if one.startswith(f"{verb}\n"))
    for flag in flags(verb) - OF_ALL - LAST - LISTED.get(verb, set()):
        assert f"| `{flag}` |" in text, flag


@pytest.mark.parametrize("verb", summaries())
def test_an_option_is_declared_once(verb: str) -> None:
    """As a field of one class, of which others may change the default; the command has no other flags."""
    kind: Any = find_action(verb)
    fields = fields_of(kind)
    for one in fields:
        holders = [base for base in kind.__mro__ if one.name in vars(base).get("__annotations__", {})]
        declared = {id(base.__dataclass_fields__[one.name].metadata["help"]) for base in holders}
        assert len(declared) == 1, one.name
    own = argparse.ArgumentParser(add_help=False)
    kind.add_flags(own)
    known = {field.shown for field in fields if not field.stands_alone} | {*own._option_string_actions}
    assert flags(verb) <= known | OF_ALL | LAST | LISTED.get(verb, set())


def flags(verb: str) -> set[str]:
    """All flags that its help shows, without those that turn one off."""
    command, *words = verb.split()
    parser = Parser(prog=command)
    module = command_module(command)
    assert module is not None
    module.configure(parser, words)
    for word in words:
        (group,) = (action for action in parser._actions if isinstance(action, argparse._SubParsersAction))
        parser = group.choices[word]
    shown = [action for action in parser._actions if action.option_strings and action.help != argparse.SUPPRESS]
    return {next(flag for flag in one.option_strings if flag.startswith("--")) for one in shown}
