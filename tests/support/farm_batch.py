"""facepipe's command line, whose processes do the made-up lines of `farm_child`."""

from __future__ import annotations

import sys

import farm_child

from facepipe.cli import main
from facepipe.tasks import child

if __name__ == "__main__":
    child.PROGRAM = farm_child.__name__
    sys.exit(main(sys.argv[1:]))
