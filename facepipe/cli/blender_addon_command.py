"""Build the Blender add-on: an extension for Blender 4.2 to 5.2 with all that Blender lacks.

Libraries come by pip, from the network or from a folder of wheels. In Blender: Preferences, Get Extensions, Install
from Disk.

examples:
  facepipe blender-addon -o facepipe.zip
  facepipe blender-addon -o facepipe.zip --blender 5.2 --platform windows-x64
"""

from __future__ import annotations

import argparse

from facepipe import registry
from facepipe.cli.parser import add_options, add_output, options_from, output_of
from facepipe.cli.show import emit, progress
from facepipe.core.errors import InputError

_HOST = "blender-addon"


def configure(parser: argparse.ArgumentParser, words: list[str]) -> None:
    """Add the arguments."""
    add_output(parser, "extension to write: .zip")
    parser.add_argument("--json", action="store_true", help="print the report as JSON")
    add_options(parser, registry.host(_HOST).Options)


def run(arguments: argparse.Namespace) -> int:
    """Download, pack, report."""
    host, out = registry.host(_HOST), output_of(arguments)
    if out.suffix.lower() != ".zip":
        raise InputError(out, f"suffix '{out.suffix}', expected .zip")
    with progress("blender-addon", 1) as bar:
        report = host.build(out, options_from(arguments, host.Options))
        bar.update()
    emit(report, f"{out}: {report.bytes:,} bytes, {report.counts['wheels']} wheels", as_json=arguments.json)
    return 0
