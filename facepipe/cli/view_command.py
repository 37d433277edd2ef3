"""Look at a face in the browser: sliders, shapes, bones, regions, distances, a second face beside it.

FACE is a face stage, or a GLB as it is (with --onnx its sliders too). A second one is compared with the first. A face
that `facepipe blend` made shows its weights, and is blended again while they are moved. The page is served to this
machine alone, until Ctrl-C. With --edit it is the studio, which keeps faces in a folder: `facepipe serve FOLDER`.

examples:
  facepipe view head.usdc
  facepipe view head.usdc other.usdc --port 8000
  facepipe view head.glb --onnx sliders.onnx --no-browser
  facepipe view studio.usdc --basis studio.fpbasis
  facepipe view --edit faces
"""

from __future__ import annotations

import argparse
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

from facepipe import registry
from facepipe.cli.parser import Parser, add_options, options_from
from facepipe.cli.show import progress
from facepipe.core.errors import InputError

if TYPE_CHECKING:
    from subprocess import Popen

_HOST = "view"


def configure(parser: argparse.ArgumentParser, words: list[str]) -> None:
    """Add the arguments."""
    parser.add_argument("face", type=Path, nargs="?", metavar="FACE", help="face stage, .glb or .vrm")
    parser.add_argument("other", type=Path, nargs="?", metavar="OTHER", help="another to compare it with")
    parser.add_argument("--onnx", type=Path, metavar="ONNX", help="sliders of a .glb, of `facepipe export --sliders`")
    parser.add_argument(
        "--basis",
        type=Path,
        metavar="BASIS",
        help="of persons (.fpb) that are opened in the page, of `facepipe basis` (default the built-in head's)",
    )
    text = "edit and keep faces in a folder, which `facepipe serve` has too, in place of FACE"
    parser.add_argument("--edit", type=Path, metavar="FOLDER", help=text)
    parser.add_argument("--no-browser", action="store_true", help="open no browser, only print where the page is")
    add_options(parser, registry.host(_HOST).Options)


def run(arguments: argparse.Namespace) -> int:
    """Make the files, serve, open."""
    host = registry.host(_HOST)
    if (arguments.face is None) == (arguments.edit is None):
        given = "none given" if arguments.face is None else "given with --edit"
        raise InputError("FACE", f"{given}, expected a face or --edit FOLDER")
    if arguments.edit is not None:
        return _edit(arguments, options_from(arguments, host.Options).port)
    faces = [arguments.face, *([arguments.other] if arguments.other else [])]
    try:
        options = options_from(arguments, host.Options)
        with ExitStack() as serving:
            with progress("view", 1) as bar:
                page = serving.enter_context(host.view(faces, options, arguments.onnx, arguments.basis))
                bar.update()
            print(f"{page.url}  (Ctrl-C ends)", flush=True)
            if not arguments.no_browser:
                _open(page.url)
            page.serve()
    except KeyboardInterrupt:
        pass
    return 0


def _edit(arguments: argparse.Namespace, port: int) -> int:
    """The studio over a folder, as the command of that wing serves it."""
    from facepipe.cli import command_module

    words = [str(arguments.edit), "--port", str(port)]
    serve, parser = command_module("serve"), Parser()
    serve.configure(parser, words)
    if not arguments.no_browser:
        parser.set_defaults(ready=_open)
    return int(serve.run(parser.parse_args(words)))


def _open(url: str) -> Popen[bytes]:
    """By Python's own list of browsers, which looks for programs where PATH says: in a process of its own."""
    from subprocess import DEVNULL

    from facepipe.core.policy import children

    return children.start(children.python("webbrowser", url), stdout=DEVNULL)  # it rings the terminal's bell
