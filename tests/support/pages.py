"""Code in pages of documentation."""

from __future__ import annotations

import re


def blocks(page: str, kind: str) -> list[str]:
    """The blocks of a language."""
    return re.findall(rf"```{kind}\n(.*?)```", page, re.DOTALL)
