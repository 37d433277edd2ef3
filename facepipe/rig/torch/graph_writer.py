"""Trained networks as ONNX graphs, and the residual block that they are made of.

He et al., "Deep Residual Learning for Image Recognition", CVPR 2016.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor, nn

from facepipe.onnx_graph import Nodes, Shapes


class Block(nn.Module):  # type: ignore[misc]
    """Two convolutions of 3 by 3 beside a shortcut."""

    def __init__(self, before: int, after: int, stride: int = 1) -> None:
        super().__init__()
        self.first = nn.Conv2d(before, after, 3, stride, 1, bias=False)
        self.first_norm = nn.BatchNorm2d(after)
        self.second = nn.Conv2d(after, after, 3, 1, 1, bias=False)
        self.second_norm = nn.BatchNorm2d(after)
        self.shortcut = nn.Conv2d(before, after, 1, stride) if before != after or stride > 1 else None

    def forward(self, values: Tensor) -> Tensor:
        """(b, after, h / stride, w / stride) of (b, before, h, w)."""
        inner = torch.relu(self.first_norm(self.first(values)))
        inner = self.second_norm(self.second(inner))
        return torch.relu(inner + (values if self.shortcut is None else self.shortcut(values)))


class GraphWriter(Nodes):
    """Adds layers of torch too; what a layer gives is called as it is."""

    def linear(self, name: str, source: str, layer: nn.Linear) -> str:
        """A layer of all inputs."""
        inputs = [self.constant(f"{name}_{part}", getattr(layer, part).detach()) for part in ("weight", "bias")]
        return self.add("Gemm", source, *inputs, name=name, transB=1)

    def conv(self, name: str, source: str, conv: nn.Conv2d, norm: nn.BatchNorm2d | None = None) -> str:
        """A convolution with the normalisation after it folded in."""
        weight = conv.weight.detach().double()
        bias = torch.zeros(len(weight)) if conv.bias is None else conv.bias.detach().double()
        # g (W x + b - m) / sqrt(v + eps) + beta, as one convolution; in double, rounded once.
        if norm is not None:
            scale = norm.weight.detach().double() / (norm.running_var.double() + norm.eps).sqrt()
            weight = weight * scale[:, None, None, None]
            bias = norm.bias.detach().double() + (bias - norm.running_mean.double()) * scale
        inputs = (self.constant(f"{name}_weight", weight), self.constant(f"{name}_bias", bias))
        sizes = {"strides": list(conv.stride), "pads": [*conv.padding, *conv.padding]}
        return self.add("Conv", source, *inputs, name=name, **sizes)

    def block(self, name: str, source: str, block: Block) -> str:
        """A residual block."""
        inner = self.add("Relu", self.conv(f"{name}_first", source, block.first, block.first_norm))
        inner = self.conv(f"{name}_second", inner, block.second, block.second_norm)
        beside = source if block.shortcut is None else self.conv(f"{name}_shortcut", source, block.shortcut)
        return self.add("Relu", self.add("Add", inner, beside), name=name)

    def to_bytes(
        self,
        name: str,
        inputs: Mapping[str, Sequence[int]],
        outputs: Mapping[str, Sequence[int]],
        properties: Mapping[str, str],
    ) -> bytes:
        """The bytes of a model of any batch, the same for the same nodes.

        :param inputs: name -> shape without the batch
        :param properties: its metadata
        :raises ExportError: numbers beyond float32
        """
        from onnx import checker, helper

        ends: list[Shapes] = [{one: ("batch", *shape) for one, shape in side.items()} for side in (inputs, outputs)]
        model = self.model(name, name, *ends)
        helper.set_model_props(model, dict(properties))
        checker.check_model(model, full_check=True)
        return bytes(model.SerializeToString(deterministic=True))
