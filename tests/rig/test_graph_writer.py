"""Graphs of trained networks: layer by layer what torch gives, and the same bytes again."""

from __future__ import annotations

import numpy as np
import pytest
from with_torch import torch

from facepipe.rig.torch.graph_writer import Block, GraphWriter

pytestmark = pytest.mark.needs_torch


def given(write: GraphWriter, output: str, shape: tuple[int, ...], images: torch.Tensor) -> np.ndarray:
    """The value `output` in onnxruntime."""
    import onnxruntime

    content = write.to_bytes("one", {"image": images.shape[1:]}, {output: shape}, {"note": "{}"})
    return np.asarray(onnxruntime.InferenceSession(content).run(None, {"image": images.numpy()})[0])


def trained(module: torch.nn.Module, images: torch.Tensor) -> torch.nn.Module:
    """With means, deviations, weights and offsets of the normalisations that are not those of a new one."""
    for norm in (one for one in module.modules() if isinstance(one, torch.nn.BatchNorm2d)):
        torch.nn.init.uniform_(norm.weight, 0.5, 1.5)
        torch.nn.init.uniform_(norm.bias, -1, 1)
    with torch.no_grad():
        module(images)
    return module.eval()


@pytest.mark.parametrize("bias", [False, True])
def test_normalisation_after_a_convolution_is_folded_into_it(bias: bool) -> None:
    torch.manual_seed(0)
    images = torch.rand(3, 2, 9, 7)
    both = trained(torch.nn.Sequential(torch.nn.Conv2d(2, 4, 3, 2, 1, bias=bias), torch.nn.BatchNorm2d(4)), images)
    write = GraphWriter()
    write.conv("folded", "image", *both)
    assert [node.op_type for node in write.nodes] == ["Conv"]
    with torch.no_grad():
        np.testing.assert_allclose(given(write, "folded", (4, 5, 4), images), both(images).numpy(), atol=1e-5)


@pytest.mark.parametrize(("after", "stride"), [(2, 1), (4, 2)])
def test_blocks_are_those_of_torch(after: int, stride: int) -> None:
    torch.manual_seed(1)
    images = torch.rand(3, 2, 8, 8)
    block = trained(Block(2, after, stride), images)
    write = GraphWriter()
    output = write.block("own", "image", block)
    with torch.no_grad():
        expected = block(images).numpy()
    np.testing.assert_allclose(given(write, output, expected.shape[1:], images), expected, atol=1e-5)


def test_the_same_nodes_are_the_same_bytes() -> None:
    torch.manual_seed(2)
    layer = torch.nn.Linear(5, 2)
    contents = []
    for _ in range(2):
        write = GraphWriter()
        write.linear("own", "image", layer)
        contents.append(write.to_bytes("one", {"image": (5,)}, {"own": (2,)}, {"b": "2", "a": "1"}))
    assert contents[0] == contents[1]
