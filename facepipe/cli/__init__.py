"""The command line: one file a command, the only printing and exit codes.

Exit 0: done. 1: done, but a check or threshold was missed. 2: bad input or usage, one line on stderr.
"""

from __future__ import annotations

import argparse
import atexit
import contextlib
import dataclasses
import gc
import importlib
import logging
import os
import signal
import sys
import threading
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from facepipe.cli.parser import Parser
from facepipe.cli.show import note, quiet_libraries, speaking
from facepipe.core import __version__
from facepipe.core.errors import FacepipeError
from facepipe.core.policy.paths import PROJECT, Trust, roots_in, trust, trusting
from facepipe.core.reading import check_input
from facepipe.registry import manifest

if TYPE_CHECKING:
    from facepipe.core.project import Project

_log = logging.getLogger(__name__)

# command -> what it does; its module is facepipe.cli.<command>, with configure(parser) and run(arguments) -> exit code;
# the manifest has those of the wings
COMMANDS = {
    "demo": "a sample face from USD to validated GLB, ONNX and pictures",
    "import": "make a face stage from a file of another program",
    "validate": "check a face, GLB or ONNX file",
    "export": "write a GLB, glTF or ONNX file for the engine",
    "apply-bones": "rebuild a face from bone coefficients",
    "view": "look at a face in the browser",
    "regions": "list regions, or author them from a painted map",
    "sliders": "list, author or set sliders",
    "cook": "make results anew whose sources have changed",
    "blender-addon": "build the add-on for Blender",
    "schema-path": "print the folder of the USD schemas",
    "completion": "print a script that completes commands, flags and choices in a shell",
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; the exit code."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    if arguments is None:
        _as_program()
    try:
        with _ending(), quiet_libraries():
            return _run(words)
    except FacepipeError as error:
        print(f"facepipe: {error}", file=sys.stderr)
        return 2
    except _Terminated:
        print("facepipe: terminated", file=sys.stderr)
        return 143
    except KeyboardInterrupt:
        print("facepipe: interrupted", file=sys.stderr)
        return 130
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except (OSError, MemoryError, UnicodeError, RecursionError) as error:
        # what the machine or the terminal refuses is not our fault: one line, as for bad input; of ASCII, as the
        # terminal may hold no other
        said = f"{type(error).__name__}: {ascii(str(error) or 'no memory left')[1:-1]}"
        if isinstance(error, OSError) and error.filename and error.strerror:
            name = str(error.filename)
            said = ascii(f"{name if len(name) < 200 else f'{name[:80]}...'}: {error.strerror.lower()}")[1:-1]
        print(f"facepipe: {said}", file=sys.stderr)
        return 2


def _as_program() -> None:
    """What is quicker where the process is ours.

    One thread of OpenBLAS, unless asked for more: products here are small, and its threads spin for 0.1 s as they start
    and after each. Of README's commands none takes less processor time with two: `sample` 2.8 s, else 2.4. And Python
    looks for circles among all objects as it ends, 0.09 s.
    """
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    atexit.register(gc.freeze)


class _Terminated(KeyboardInterrupt):
    """SIGTERM, handled as Ctrl-C is."""


@contextlib.contextmanager
def _ending() -> Iterator[None]:
    """SIGTERM ends the block as Ctrl-C does: temporary files are removed."""

    def end(*_: object) -> None:
        raise _Terminated

    ours = threading.current_thread() is threading.main_thread() and signal.getsignal(signal.SIGTERM) is signal.SIG_DFL
    if ours:  # else it is ignored, or a host's
        signal.signal(signal.SIGTERM, end)
    try:
        yield
    finally:
        if ours:
            signal.signal(signal.SIGTERM, signal.SIG_DFL)


def _run(words: list[str]) -> int:
    command = next((word for word in words if not word.startswith("-")), None)
    module = None if command is None else command_module(command)
    if command is None or module is None:
        return _help(words, command)
    place = words.index(command)
    rest = [*words[:place], *words[place + 1 :]]  # -v and -q may stand before it
    project = None if {"-h", "--help"} & {*rest} else _project()
    line = rest
    if project is not None:
        finder = Parser(add_help=False, common=False, prog=f"facepipe {command}")
        finder.add_argument("--root", action="append", default=argparse.SUPPRESS)
        # files that the project names may lie below roots of the line
        with trusting(_trust_of(finder.parse_known_args(rest)[0], project)):
            line = in_project(project, [command, *rest], Path.cwd())[1:]
    parser = Parser(prog=f"facepipe {command}", description=module.__doc__)
    module.configure(parser, line)
    parsed = parser.parse_args(line)
    with speaking(getattr(parsed, "loudness", "usual")), trusting(_trust_of(parsed, project)):
        _log.debug("facepipe %s, Python %s: %s", __version__, sys.version.split()[0], " ".join([command, *line]))
        if project is not None:
            _log.debug("project file %s", project.file)
            if project.roots and not project.trusted:
                untrusted = f"expected FACEPIPE_PROJECT={project.file} if you trust them"
                note(f"warning: roots of {project.file} are left out, {untrusted}")
        for path in paths_in(list(vars(parsed).values())):
            check_input(path)
        code = int(module.run(parsed))
        _log.debug("exit code %d", code)
        return code


def _project() -> Project | None:
    """The project around the working folder."""
    folder = Path.cwd()
    named = "FACEPIPE_PROJECT" in os.environ
    if not named and not any((one / PROJECT).is_file() for one in (folder, *folder.parents)):
        return None
    from facepipe.core.project import project_around

    return project_around(folder)


def in_project(project: Project, words: Sequence[str], folder: Path, out: str = "") -> list[str]:
    """As `facepipe.cli.project_words.with_project`, of the commands of this package."""
    from facepipe.cli.project_words import with_project

    return with_project(project, words, command_module, folder, out)


def command_module(command: str) -> Any:
    """The module or action that configures and runs a command; None for no command."""
    if command in COMMANDS:
        return importlib.import_module(f"facepipe.cli.{command.replace('-', '_')}_command")
    if command in manifest()["commands"]:
        return importlib.import_module(manifest()["commands"][command]["module"])
    from facepipe.actions import find_action, groups
    from facepipe.cli.action_line import ActionGroup, ActionLine

    kind = find_action(command)
    if kind is not None:
        return ActionLine(kind)
    return ActionGroup(command) if command in groups() else None


def paths_in(values: Iterable[object]) -> Iterator[Path]:
    """All paths among what was parsed."""
    for value in values:
        if isinstance(value, Path):
            yield value
        elif isinstance(value, list | tuple):
            yield from paths_in(value)


def _trust_of(parsed: argparse.Namespace, project: Project | None) -> Trust:
    """The trust policy of the line and the project, on top of one that a host which calls `main` may have set."""
    old = trust()
    roots, urls = roots_in(parsed.root) if "root" in parsed else (old.roots, old.urls)
    folders = () if project is None or old.confined else project.folders
    return dataclasses.replace(
        old, roots=roots, urls=urls, project=folders, models=old.models or "trust_models" in parsed
    )


def commands_of() -> dict[str, str]:
    """Every command -> what it does."""
    from facepipe.actions import groups, summaries

    found = {verb: text for verb, text in summaries().items() if " " not in verb}
    found |= {name: one["summary"] for name, one in manifest()["commands"].items()}
    found |= {name: f"{text[0].lower()}{text[1:].splitlines()[0].rstrip('.')}" for name, text in groups().items()}
    return COMMANDS | {verb: found[verb] for verb in sorted(found) if verb not in COMMANDS}


def _help(words: list[str], command: str | None) -> int:
    commands = commands_of()
    width = max(map(len, commands))
    listing = "\n".join(f"  {name:{width}}  {text}" for name, text in commands.items())
    parser = Parser(
        common=False,
        prog="facepipe",
        usage="facepipe COMMAND ...",
        description="Face assets from a DCC to a game engine.",
        epilog=f"commands:\n{listing}\n\n`facepipe COMMAND --help` shows options and an example.",
    )
    parser.add_argument("--version", action="version", version=f"facepipe {__version__}")
    if command is not None:
        from facepipe.core.names import did_you_mean

        near = did_you_mean(command, commands) or f", expected one of {', '.join(commands)}"
        parser.error(f"'{command[:40]}' is no command{near}")
    parser.parse_args(words)
    parser.print_help()
    return 0
