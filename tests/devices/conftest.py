"""Cases that readers of all languages judge."""

from __future__ import annotations

from pathlib import Path

import person_corpus
import pytest


@pytest.fixture(scope="session")
def corpus_of_20_000(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of the whole corpus, whose verdicts take Python half a minute."""
    folder = tmp_path_factory.mktemp("corpus")
    assert sum(person_corpus.write(folder, 20_000).values()) == 20_000
    return folder
