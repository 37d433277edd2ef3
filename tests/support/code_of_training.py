"""Lets tests import the modules of `training/`: import this first."""

from __future__ import annotations

import sys

from places import REPOSITORY

sys.path.append(str(REPOSITORY / "training"))
