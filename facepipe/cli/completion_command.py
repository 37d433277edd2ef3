"""Print a script that completes commands, flags, choices and files of facepipe in a shell.

It is made of what this installation declares, plug-ins included: print it again after an update.

examples:
  eval "$(facepipe completion bash)"                                     # in ~/.bashrc
  facepipe completion zsh > ~/.zfunc/_facepipe                           # in a folder of $fpath
  facepipe completion fish > ~/.config/fish/completions/facepipe.fish
"""

from __future__ import annotations

import argparse
import shlex
from collections.abc import Iterable
from typing import Literal, NamedTuple

from facepipe.cli.parser import Parser
from facepipe.core.errors import InputError


class _Line(NamedTuple):
    """A command, or an action of one, and what it takes: its flags, and the first word that stands alone."""

    verb: str
    summary: str
    flags: tuple[argparse.Action, ...]


def configure(parser: argparse.ArgumentParser, words: list[str]) -> None:
    """Add the arguments."""
    parser.add_argument("shell", choices=tuple(_SCRIPTS), metavar="SHELL", help=" ".join(_SCRIPTS))


def run(arguments: argparse.Namespace) -> int:
    """Print the script: of every command, and of every action of those that have some."""
    from facepipe.actions import summaries
    from facepipe.cli import commands_of

    lines = []
    for command, summary in commands_of().items():
        lines.append(_Line(command, summary, _flags(command, "--help")))
        lines += [_Line(verb, text, _flags(*verb.split())) for verb, text in summaries(f"{command} ").items()]
    print(_SCRIPTS[arguments.shell](lines))
    return 0


def _flags(command: str, word: str) -> tuple[argparse.Action, ...]:
    """What the command takes, or its action called `word`; nothing of plug-ins that can't be used."""
    from facepipe.cli import command_module

    parser: argparse.ArgumentParser = Parser(prog=command)
    try:
        command_module(command).configure(parser, [word])
    except InputError:
        return ()
    for actions in parser._actions:
        if isinstance(actions, argparse._SubParsersAction) and word in actions.choices:
            parser = actions.choices[word]
    return tuple(
        action
        for action in parser._actions
        if action.help != argparse.SUPPRESS and (action.option_strings or action.choices)
    )


def _choices(flag: argparse.Action) -> str:
    """Its values, where they are few."""
    return " ".join(map(str, flag.choices or ()))


def _value(flag: argparse.Action) -> Literal["nothing", "word", "file"]:
    """What follows it; a word is no file."""
    if flag.nargs == 0:
        return "nothing"
    return "word" if getattr(flag.type, "__name__", "") in ("int", "float") or flag.choices else "file"


def _cases(lines: Iterable[_Line]) -> str:
    """Shell code that sets `values`, what may follow the flag `before`, and `flags`, those of the command `verb`."""
    values, flags = [], []
    for line in lines:
        last = line.verb.rpartition(" ")[2]
        for flag in line.flags:
            words = _choices(flag) or ("-" if _value(flag) == "word" else "")
            if words:
                names = "|".join(f'"{line.verb} {name}"' for name in flag.option_strings or (last,))
                values.append(f'        {names}) values="{words}" ;;')
        names = " ".join(name for flag in line.flags for name in flag.option_strings)
        flags.append(f'        "{line.verb}") flags="{names}" ;;')
    return "\n".join(['    case "$verb $before" in', *values, "    esac", '    case "$verb" in', *flags, "    esac"])


def _groups(lines: Iterable[_Line]) -> str:
    """A pattern of the commands that have actions, and of no action yet."""
    groups = dict.fromkeys(line.verb.split()[0] for line in lines if " " in line.verb)
    return "|".join(f"{name},*" for name in groups) or "-"


def _bash(lines: list[_Line]) -> str:
    verbs = " ".join(line.verb for line in lines if " " not in line.verb)
    return f"""# facepipe in bash: eval "$(facepipe completion bash)"
_facepipe() {{
    local word="${{COMP_WORDS[COMP_CWORD]}}" before="${{COMP_WORDS[COMP_CWORD-1]}}" verb="" values="" flags="" i
    COMPREPLY=()
    for ((i = 1; i < COMP_CWORD; i++)); do
        case "$verb,${{COMP_WORDS[i]}}" in
        *,-*) ;;
        ,*) verb="${{COMP_WORDS[i]}}" ;;
        {_groups(lines)}) verb="$verb ${{COMP_WORDS[i]}}" ;;
        esac
    done
    if [[ -z $verb ]]; then
        COMPREPLY=($(compgen -W "{verbs} --help --version --verbose --quiet" -- "$word"))
        return
    fi
    [[ $before == "=" ]] && before="${{COMP_WORDS[COMP_CWORD-2]}}"
    [[ $word == "=" ]] && word=""
{_cases(lines)}
    if [[ $word == -* ]]; then
        COMPREPLY=($(compgen -W "$flags" -- "$word"))
    elif [[ -n $values ]]; then
        compopt +o default 2>/dev/null
        [[ $values == "-" ]] || COMPREPLY=($(compgen -W "$values" -- "$word"))
    fi
}}
complete -o bashdefault -o default -F _facepipe facepipe"""


def _zsh(lines: list[_Line]) -> str:
    named = (f"{line.verb}:{line.summary.replace(':', ' ')}" for line in lines if " " not in line.verb)
    return f"""#compdef facepipe
_facepipe() {{
    local word="$words[CURRENT]" before="$words[CURRENT-1]" verb="" values="" flags="" i
    local -a commands=({" ".join(map(shlex.quote, named))})
    for ((i = 2; i < CURRENT; i++)); do
        case "$verb,$words[i]" in
        *,-*) ;;
        ,*) verb="$words[i]" ;;
        {_groups(lines)}) verb="$verb $words[i]" ;;
        esac
    done
    if [[ -z $verb ]]; then
        _describe command commands
        if [[ $word == -* ]]; then compadd -- --help --version --verbose --quiet; fi
        return
    fi
    if [[ $word == --*=* ]]; then
        before="${{word%%=*}}"
        compset -P '*='
    fi
{_cases(lines)}
    if [[ $word == -* && $word != *=* ]]; then
        compadd -- ${{=flags}}
    elif [[ -n $values ]]; then
        if [[ $values != "-" ]]; then compadd -- ${{=values}}; fi
    else
        _files
    fi
}}
compdef _facepipe facepipe"""


def _fish(lines: list[_Line]) -> str:
    rows = ["# facepipe in fish: facepipe completion fish > ~/.config/fish/completions/facepipe.fish"]
    rows += [f"complete -c facepipe -n __fish_use_subcommand -l {one}" for one in ("version", "verbose", "quiet")]
    for line in lines:
        group, _, action = line.verb.partition(" ")
        seen = f"__fish_seen_subcommand_from {group}"
        where = "__fish_use_subcommand"
        if action:
            where, seen = seen, f"{seen}; and __fish_seen_subcommand_from {action}"
        rows.append(f"complete -c facepipe -f -n '{where}' -a {action or group} -d {_fish_quoted(line.summary)}")
        for flag in line.flags:
            names = "".join(
                f" -l {one[2:]}" if one.startswith("--") else f" -s {one[1:]}" for one in flag.option_strings
            )
            takes = {"nothing": "", "word": " -x", "file": " -r"}[_value(flag)] if names else " -f"
            choices = f" -a '{_choices(flag)}'" if flag.choices else ""
            help = _fish_quoted((flag.help or "").replace("%%", "%").partition("; ")[0])
            rows.append(f"complete -c facepipe -n '{seen}'{names}{takes}{choices} -d {help}")
    return "\n".join(rows)


def _fish_quoted(text: str) -> str:
    return "'" + text.replace("\\", "\\\\").replace("'", "\\'") + "'"


_SCRIPTS = {"bash": _bash, "zsh": _zsh, "fish": _fish}
