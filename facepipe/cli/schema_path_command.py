"""Print the folder of the USD schemas, for PXR_PLUGINPATH_NAME of hosts that need it before they start.

example: PXR_PLUGINPATH_NAME=$(facepipe schema-path) usdview head.usdc
"""

from __future__ import annotations

import argparse


def configure(parser: argparse.ArgumentParser, words: list[str]) -> None:
    """There are no arguments."""


def run(arguments: argparse.Namespace) -> int:
    """Print it."""
    import facepipe_schemas

    print(facepipe_schemas.path())
    return 0
