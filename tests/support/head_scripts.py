"""Lets tests import the modules of `samples/head/`: import this first."""

from __future__ import annotations

import sys

from places import REPOSITORY

sys.path.append(str(REPOSITORY / "samples" / "head"))
