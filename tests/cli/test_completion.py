"""What shells complete: asked of bash itself, and of zsh and fish where they are installed."""

from __future__ import annotations

import argparse
import os
import select
import shlex
import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest
from command_line import Capsys, done, failed
from places import REPOSITORY

from facepipe.cli import command_module, commands_of
from facepipe.cli.parser import Parser

pytestmark = pytest.mark.skipif(sys.platform == "win32" or shutil.which("bash") is None, reason="there is no bash")

LINES = {
    "facepipe exp": {"export"},
    "facepipe fit-": {"fit-bones", "fit-neutral", "fit-photo"},
    "facepipe --v": {"--version", "--verbose"},
    "facepipe import gl": {"gltf"},
    "facepipe -q import m": {"makehuman"},
    "facepipe blend --edges ": {"uniform", "cotangent"},
    "facepipe blend a.usda b.usda --edges c": {"cotangent"},
    "facepipe blend --regi": {"--region-width-mm"},
    "facepipe database ": {"add", "create", "info", "remove"},
    "facepipe neural-rig tr": {"train"},
    "facepipe neural-rig apply --fl": {"--flatten"},
    "facepipe completion ": {"bash", "zsh", "fish"},
    "facepipe sample --seed ": set(),  # a number
    "facepipe inspect --js": {"--json"},
}


@pytest.fixture(scope="module")
def scripts(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """The script of each shell."""
    folder = tmp_path_factory.mktemp("completion")
    found = {}
    for shell in ("bash", "zsh", "fish"):
        line = [sys.executable, "-m", "facepipe", "completion", shell]
        found[shell] = folder / f"facepipe.{shell}"
        found[shell].write_text(subprocess.run(line, capture_output=True, text=True, check=True).stdout)
    return found


def shell_output(program: str, *command: str) -> set[str]:
    """Lines that a shell prints."""
    if shutil.which(program) is None:
        pytest.skip(f"there is no {program}")
    ended = subprocess.run([program, *command], capture_output=True, text=True, check=False, cwd=REPOSITORY)
    assert (ended.returncode, ended.stderr) == (0, "")
    return {*ended.stdout.split()}


def in_bash(script: Path, *lines: str) -> list[set[str]]:
    """What bash's function for facepipe offers at the end of each line."""
    asked = [f"COMP_WORDS=({_bash_words(line)}) COMP_CWORD=$((${{#COMP_WORDS[@]}} - 1))" for line in lines]
    calls = "\n".join(f'{one}; _facepipe; echo "${{COMPREPLY[*]}}"' for one in asked)
    ended = subprocess.run(["bash", "-c", f"source {script}\n{calls}"], capture_output=True, text=True, check=False)
    assert (ended.returncode, ended.stderr) == (0, "")
    return [{*splitline.split(" ")} - {""} for splitline in ended.stdout.splitlines()]


def _bash_words(line: str) -> str:
    """The words as bash parts them: `=` is one of its own."""
    return " ".join(map(shlex.quote, line.replace("=", " = ").split(" ")))


def test_bash_offers_what_fits(scripts: dict[str, Path]) -> None:
    lines = [*LINES, "facepipe blend --edges=uni"]
    for line, offered, expected in zip(
        lines, in_bash(scripts["bash"], *lines), [*LINES.values(), {"uniform"}], strict=True
    ):
        assert offered == expected, line


def test_bash_offers_every_command_and_flag(scripts: dict[str, Path]) -> None:
    flags = {}
    for command in commands_of():
        parser = Parser(prog=command)
        command_module(command).configure(parser, ["--help"])
        shown = [action for action in parser._actions if action.help != argparse.SUPPRESS]
        flags[command] = {flag for one in shown for flag in one.option_strings}
    every, *offered = in_bash(scripts["bash"], "facepipe ", *(f"facepipe {command} -" for command in flags))
    assert every == {*flags, "--help", "--version", "--verbose", "--quiet"}
    assert dict(zip(flags, offered, strict=True)) == flags


def test_a_tab_in_bash_completes_flags_and_files(scripts: dict[str, Path], tmp_path: Path) -> None:
    """A real terminal: what is typed, and what the tab adds to it."""
    (tmp_path / "my head.usda").write_text("")
    for keys, wanted in {
        "facepipe blend --regi\t": "facepipe blend --region-width-mm",
        "facepipe inspect my\t": "facepipe inspect my\\ head.usda",
    }.items():
        assert wanted in typed(keys, wanted, scripts["bash"], tmp_path)


def typed(keys: str, wanted: str, script: Path, folder: Path) -> str:
    """What a terminal with bash in `folder` shows after `keys`, at the latest when it has what is wanted."""
    import pty

    child, terminal = pty.fork()
    if child == 0:
        os.chdir(folder)
        environment = {
            "PATH": os.environ["PATH"],
            "PS1": "",
            "TERM": "dumb",
            "INPUTRC": os.devnull,
            "HOME": str(folder),
        }
        os.execvpe("bash", ["bash", "--noprofile", "--norc", "-i"], environment)
    try:
        os.write(terminal, f"source {script}; stty cols 200; echo ready\n".encode())
        assert "ready\r\n" in _shown(terminal, "ready\r\n")
        os.write(terminal, keys.encode())
        return _shown(terminal, wanted)
    finally:
        os.write(terminal, b"\x03exit\n")
        os.close(terminal)
        os.waitpid(child, 0)


def _shown(terminal: int, awaited: str) -> str:
    """What is shown until `awaited` is there and nothing more comes, or for half a minute."""
    text, until = "", time.monotonic() + 30
    while time.monotonic() < until:
        if select.select([terminal], [], [], 0.1)[0]:
            text += os.read(terminal, 4096).decode()
        elif awaited in text:
            break
    return text


def test_zsh_offers_what_fits(scripts: dict[str, Path]) -> None:
    stubs = "compdef() { }; compset() { }; _files() { }; _describe() { print -l -- ${commands%%:*} }\n"
    stubs += "compadd() { shift; for one; do [[ $one == $words[CURRENT]* ]] && print -- $one; done; true }\n"
    for line, expected in LINES.items():
        words = " ".join(map(shlex.quote, line.split(" ")))
        call = f"words=({words}); CURRENT=$#words; _facepipe"
        offered = shell_output("zsh", "-fc", f"{stubs}source {scripts['zsh']}\n{call}")
        assert {one for one in offered if one.startswith(line.split(" ")[-1])} == expected, line


def test_fish_offers_what_fits(scripts: dict[str, Path]) -> None:
    for line, expected in LINES.items():
        call = f"source {scripts['fish']}; complete -C {shlex.quote(line)} | cut -f 1"
        offered = shell_output("fish", "--no-config", "-c", call)
        assert offered == expected, line


def test_a_shell_that_is_not_known_is_refused(capsys: Capsys, tmp_path: Path) -> None:
    assert "invalid choice: 'zhs', did you mean 'zsh'?" in failed(capsys, "completion", "zhs", folder=tmp_path)
    assert done(capsys, "completion", "bash").startswith("# facepipe in bash")
