"""`facepipe sliders FACE --from-network`: a learned network beside the sliders of a face."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from facepipe.parts import SliderNetwork
    from facepipe.processors.sliders import AuthorNetworkReport


def network_text(out: Path, report: AuthorNetworkReport) -> str:
    """The report for people."""
    layers = " -> ".join(map(str, report.layers))
    replaced = ", in place of another" if report.replaced else ""
    return f"{out}: a network {layers}{replaced}, over {report.channels} channels and {report.shapes} shapes"


def network_json(network: SliderNetwork) -> dict[str, Any]:
    """What the list of sliders says of a face's network, for machines."""
    return {
        "activation": network.activation,
        "channels": [list(one) for one in network.channels],
        "info": dict(network.info),
        "layers": [len(network.sliders), *(len(bias) for bias in network.biases)],
        "shapes": list(network.shapes),
        "sliders": list(network.sliders),
    }


def listed(network: SliderNetwork) -> str:
    """What the list of sliders says of a face's network."""
    layers = " -> ".join(map(str, (len(network.sliders), *(len(bias) for bias in network.biases))))
    what = f"{len(network.channels)} channels and {len(network.shapes)} shapes"
    return f"learned network {layers} ({network.activation}) adds to {what}"
