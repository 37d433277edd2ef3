"""`python -m facepipe`."""

import sys

from facepipe.cli import main

sys.exit(main())
