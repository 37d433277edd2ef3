"""What docs/features.md says is what the code does."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest
from feature_graphs import arcface_like, save
from pages import blocks
from places import REPOSITORY
from with_torch import torch

from facepipe.core.errors import InputError
from facepipe.geometry.face_crops import ARCFACE_TEMPLATE, TEMPLATE
from facepipe.networks.onnx_file import (
    CELEBAMASK,
    CLASSES,
    DEFAULT_SIZES,
    DEFAULTS,
    KINDS,
    class_matrix,
    describe,
)
from facepipe.photo.features.extractor import load_extractor
from facepipe.photo.features.operators import OPERATORS

pytestmark = pytest.mark.needs_torch

TEXT = (REPOSITORY / "docs/features.md").read_text(encoding="utf-8")
EXAMPLES = blocks(TEXT, "json")


def test_figures_of_the_template() -> None:
    rows = re.findall(r"(?<=\| )(\d+) \| ([\d.]+) \| ([\d.]+)", TEXT)
    found = {int(number): (float(x), float(y)) for number, x, y in rows}
    np.testing.assert_allclose([found[number] for number in range(68)], TEMPLATE, atol=1e-9)


def test_figures_of_the_five_points() -> None:
    pairs = re.findall(r"\((\d\d\.\d{4}), (\d\d\.\d{4})\)", TEXT)
    np.testing.assert_allclose(np.array(pairs, dtype=float) + 0.5, ARCFACE_TEMPLATE)


def test_classes_are_named_in_their_order() -> None:
    sentence = TEXT[TEXT.index("The classes are") : TEXT.index("Left and right are")]
    assert tuple(re.findall(r"`(\w+)`", sentence)) == CLASSES


@pytest.mark.parametrize("number", range(len(EXAMPLES)))
def test_examples_are_descriptions(number: int, tmp_path: Path) -> None:
    (tmp_path / "network.onnx.json").write_text(EXAMPLES[number])
    found = describe(tmp_path / "network.onnx", None, None)
    assert found.size == json.loads(EXAMPLES[number])["size"]
    assert class_matrix(found.labels or CLASSES).any(axis=1).all()


def test_the_first_example_is_the_default_and_the_second_names_all_classes(tmp_path: Path) -> None:
    path = tmp_path / "arcface.onnx"
    usual = describe(path, None, "identity")
    path.with_name("arcface.onnx.json").write_text(EXAMPLES[0])
    spelt = describe(path, None, "identity")
    assert (spelt.mean, spelt.std, spelt.crop, spelt.order) == (usual.mean, usual.std, usual.crop, usual.order)
    assert tuple(json.loads(EXAMPLES[1])["labels"]) == CELEBAMASK


def test_defaults_are_those_of_the_table() -> None:
    for kind in KINDS:
        row = next(
            line for line in TEXT.splitlines() if line.startswith(f"| `{kind}`") and "0." in line and "(" not in line
        )
        usual = DEFAULTS[kind]
        shown = [
            str(DEFAULT_SIZES[kind]),
            " ".join(map(str, usual.mean)),
            " ".join(map(str, usual.std)),
            f"`{usual.crop}`",
        ]
        assert [cell.strip() for cell in row.strip("|").split("|")][1:] == shown


def test_networks_of_whole_numbers_as_described(tmp_path: Path) -> None:
    """0..255 by the figures that the page gives."""
    factor = float(re.search(r"`\"std\"` of ([\d.]+)", TEXT).group(1))
    path = save(arcface_like(16), tmp_path / "bytes.onnx")
    plain = load_extractor(path, "identity")
    path.with_name("bytes.onnx.json").write_text(json.dumps({"mean": [0, 0, 0], "std": [factor] * 3}))
    image = torch.rand(1, 3, 16, 16, generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(
        load_extractor(path, "identity")(image / 255 * 2 - 1 / 255), plain(image), atol=1e-4, rtol=1e-4
    )


def test_operators_as_described() -> None:
    table = TEXT[TEXT.index("| | operators |") : TEXT.index("Windows are of two axes")]
    assert sorted(re.findall(r"`(\w+)`", table)) == sorted(["Constant", *OPERATORS])


def test_operator_sets_as_described(tmp_path: Path) -> None:
    oldest, newest = map(int, re.search(r"operator sets (\d+) to (\d+)", TEXT).groups())
    for opset in (oldest - 1, newest + 1):
        with pytest.raises(InputError, match=f"expected one from {oldest} to {newest}"):
            load_extractor(save(arcface_like(16, opset=opset), tmp_path / "x.onnx"), "identity")
