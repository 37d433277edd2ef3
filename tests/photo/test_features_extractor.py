"""Feature extractors: values as onnxruntime's, signatures and descriptions that are checked when a file is loaded."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from feature_graphs import Network, arcface_like, attribute_net, bisenet_like, make_model, reference, save
from onnx import TensorProto, helper
from with_torch import torch

from facepipe.core.errors import InputError
from facepipe.core.policy.paths import Trust, trusting
from facepipe.geometry.face_crops import TEMPLATE, arcface_crop, face_crop
from facepipe.networks.onnx_file import CELEBAMASK, CLASSES, class_matrix, describe
from facepipe.photo.features.extractor import load_extractor

pytestmark = pytest.mark.needs_torch

MEAN, STD = (0.4, 0.5, 0.6), (0.2, 0.25, 0.3)


def images(size: int, count: int = 2) -> torch.Tensor:
    return torch.rand(count, 3, size, size, generator=torch.Generator().manual_seed(0))


def described(model: Any, path: Path, **values: object) -> Path:
    """A model in a file that says `values` about itself."""
    model.metadata_props.add(key="facepipe.features", value=json.dumps(values))
    return save(model, path)


def tensors(parts: Any) -> list[torch.Tensor]:
    """The tensors of one kind of features."""
    return [parts] if torch.is_tensor(parts) else list(parts)


def beside(path: Path, **values: object) -> Path:
    """The same file, with `values` in the JSON file beside it."""
    path.with_name(f"{path.name}.json").write_text(json.dumps(values))
    return path


def test_identity_network_without_description_has_the_usual_one(tmp_path: Path) -> None:
    model = arcface_like(16)
    extractor = load_extractor(save(model, tmp_path / "face.onnx"), "identity")
    assert (extractor.kinds, extractor.size, extractor.crop) == (("identity",), 16, "arcface")
    image = images(16)
    expected = reference(model, {"image": ((image - 0.5) / 0.5).numpy()})[0]
    np.testing.assert_allclose(extractor(image).numpy(), expected, rtol=1e-4, atol=1e-5)


def test_a_description_that_is_a_link_out_of_the_folder_is_refused(tmp_path: Path) -> None:
    (tmp_path / "private").mkdir()
    (tmp_path / "sent").mkdir()
    (tmp_path / "private/a.json").write_text('{"kind": "content"}')
    net = tmp_path / "sent/net.onnx"
    net.with_name("net.onnx.json").symlink_to(tmp_path / "private/a.json")
    with pytest.raises(InputError, match="outside the roots"):
        describe(net, None, "content")
    with trusting(Trust(roots=(tmp_path,))):
        describe(net, None, "content")


def test_a_network_of_any_size_gets_the_usual_one(tmp_path: Path) -> None:
    model = arcface_like(112)
    for axis in model.graph.input[0].type.tensor_type.shape.dim[2:]:
        axis.dim_param = "side"
    assert load_extractor(save(model, tmp_path / "any.onnx"), "identity").size == 112


@pytest.mark.parametrize("order", ["RGB", "BGR"])
def test_pictures_are_normalised_as_described(order: str, tmp_path: Path) -> None:
    model, image = attribute_net(16), images(16)
    names = ["a", "b", "c", "d", "e"]
    path = described(model, tmp_path / "a.onnx", kind="attributes", mean=MEAN, std=STD, order=order, names=names)
    extractor = load_extractor(path, "attributes")
    normal = (image - torch.tensor(MEAN)[:, None, None]) / torch.tensor(STD)[:, None, None]
    expected = reference(model, {"image": (normal if order == "RGB" else normal.flip(1)).numpy()})[0]
    np.testing.assert_allclose(extractor(image).numpy(), expected, atol=1e-5)
    assert extractor.names == tuple(names)


def test_content_is_features_then_probabilities(tmp_path: Path) -> None:
    model, image = bisenet_like(32), images(32)
    extractor = load_extractor(described(model, tmp_path / "c.onnx", kind="content", size=32, mean=MEAN, std=STD))
    shallow, classes = extractor(image)
    normal = (image - torch.tensor(MEAN)[:, None, None]) / torch.tensor(STD)[:, None, None]
    for found, expected in zip((shallow, classes), reference(model, {"image": normal.numpy()}), strict=True):
        np.testing.assert_allclose(found.numpy(), expected, atol=1e-5)
    torch.testing.assert_close(classes.sum(dim=1), torch.ones(2, 32, 32))


def test_scores_of_nineteen_classes_become_probabilities_of_eleven(tmp_path: Path) -> None:
    model, image = bisenet_like(32, classes=19, softmax=False), images(32)
    classes = load_extractor(save(model, tmp_path / "bisenet.onnx"), "content")(image)[-1]
    usual = (image - torch.tensor([0.485, 0.456, 0.406])[:, None, None]) / torch.tensor([0.229, 0.224, 0.225])[
        :, None, None
    ]
    scores = torch.from_numpy(reference(model, {"image": usual.numpy()})[1])
    each = dict(zip(CELEBAMASK, scores.softmax(dim=1).unbind(1), strict=True))
    found = dict(zip(CLASSES, classes.unbind(1), strict=True))
    torch.testing.assert_close(found["nose"], each["nose"])
    torch.testing.assert_close(found["leftBrow"], each["l_brow"])
    torch.testing.assert_close(found["lowerLip"], each["l_lip"])
    torch.testing.assert_close(found["face"], sum(each[name] for name in ("skin", "eye_g", "l_ear", "r_ear", "ear_r")))
    torch.testing.assert_close(classes.sum(dim=1), torch.ones(2, 32, 32))


def test_every_class_of_others_is_one_of_the_eleven() -> None:
    for labels in (CLASSES, CELEBAMASK, CLASSES[::-1]):
        np.testing.assert_array_equal(class_matrix(labels).sum(axis=0), 1)
    np.testing.assert_array_equal(class_matrix(CLASSES[::-1]), np.eye(11)[::-1])


def test_classes_in_another_order_are_sorted(tmp_path: Path) -> None:
    path = save(bisenet_like(16), tmp_path / "c.onnx")
    plain, image = load_extractor(path, "content"), images(16)
    turned = load_extractor(beside(path, kind="content", labels=CLASSES[::-1]), "content")
    torch.testing.assert_close(turned(image)[-1], plain(image)[-1].flip(1))


def test_auxiliary_heads_are_left_out(tmp_path: Path) -> None:
    net = Network()
    for name in ("main", "second", "third"):
        net.add("Conv", "image", net.random(19, 3, 1, 1), output=name)
    path = save(net.model(8, ["main", "second", "third"]), tmp_path / "heads.onnx")
    assert len(load_extractor(path, "content")(images(8))) == 1
    assert len(load_extractor(beside(path, kinds={"content": ["third", 0]}), "content")(images(8))) == 2


def several(size: int = 16) -> Any:
    """All four kinds from one convolution."""
    net = Network()
    x = net.relu(net.conv("image", 3, 11))
    net.add("Softmax", x, axis=1, output="classes")
    pooled = net.add("Flatten", net.add("GlobalAveragePool", x))
    net.add("MatMul", pooled, net.random(11, 8), output="embedding")
    net.add("Sigmoid", net.add("MatMul", pooled, net.random(11, 4)), output="values")
    places = net.add("Sigmoid", net.add("MatMul", pooled, net.random(11, 136)))
    net.add("Reshape", places, net.weight(np.array([-1, 68, 2])), output="points")
    net.add("MatMul", pooled, net.random(11, 1), output="presence")
    return net.model(size, ["classes", "embedding", "values", "points", "presence"])


SEVERAL = {
    "content": ["v1", "classes"],
    "identity": ["embedding"],
    "attributes": ["values"],
    "landmarks": ["points", "presence"],
}


def test_one_forward_gives_several_kinds(tmp_path: Path) -> None:
    model = several()
    model.graph.output.pop()
    kinds = {**SEVERAL, "landmarks": ["points", "squashed"]}
    model.graph.node.append(helper.make_node("Sigmoid", ["presence"], ["squashed"]))
    extractor = load_extractor(described(model, tmp_path / "all.onnx", kinds=kinds, crop="face"))
    image = images(16).requires_grad_()
    found = extractor.features(image)
    assert extractor.kinds == tuple(found) == tuple(SEVERAL)
    shapes = {kind: [tuple(tensor.shape) for tensor in tensors(parts)] for kind, parts in found.items()}
    assert shapes == {
        "content": [(2, 11, 16, 16), (2, 11, 16, 16)],
        "identity": [(2, 8)],
        "attributes": [(2, 4)],
        "landmarks": [(2, 68, 2), (2, 1)],
    }
    for kind in SEVERAL:
        other = load_extractor(tmp_path / "all.onnx", kind)(image)
        torch.testing.assert_close(other, found[kind])
    for parts in found.values():
        (gradient,) = torch.autograd.grad(
            (parts if torch.is_tensor(parts) else parts[-1]).square().sum(), image, retain_graph=True
        )
        assert gradient.abs().sum() > 0


def test_scores_of_attributes_and_presence_are_squashed_where_they_are_said_to_be(tmp_path: Path) -> None:
    extractor = load_extractor(
        described(several(), tmp_path / "s.onnx", kinds={"landmarks": ["points", "presence"]}, logits=True)
    )
    presence = extractor(images(16))[1]
    assert ((presence > 0) & (presence < 1)).all()


def test_networks_for_one_picture_take_several(tmp_path: Path) -> None:
    image = images(16, 3)
    one = load_extractor(save(arcface_like(16, batch=1), tmp_path / "one.onnx"), "identity")
    any_count = load_extractor(save(arcface_like(16), tmp_path / "any.onnx"), "identity")
    torch.testing.assert_close(one(image), any_count(image))


def test_gradient_in_the_picture_is_that_of_finite_differences(tmp_path: Path) -> None:
    extractor = load_extractor(described(several(8), tmp_path / "all.onnx", kinds=SEVERAL, logits=True)).double()
    image = images(8, 1).double().requires_grad_()

    def flat(one: torch.Tensor) -> torch.Tensor:
        return torch.cat([value.flatten() for parts in extractor.features(one).values() for value in tensors(parts)])

    assert torch.autograd.gradcheck(flat, (image,), fast_mode=True)
    assert not any(one.requires_grad for one in [*extractor.parameters(), *extractor.buffers()])


def test_crop_is_the_one_that_the_network_wants(tmp_path: Path) -> None:
    marks = TEMPLATE * 300 + 20
    path = save(arcface_like(16), tmp_path / "face.onnx")
    np.testing.assert_array_equal(load_extractor(path, "identity").crop_matrix(marks), arcface_crop(marks, 16))
    beside(path, kind="identity", crop="face")
    np.testing.assert_array_equal(load_extractor(path, "identity").crop_matrix(marks), face_crop(marks, 16))


def test_pictures_of_another_size_are_refused(tmp_path: Path) -> None:
    extractor = load_extractor(save(arcface_like(16), tmp_path / "face.onnx"), "identity")
    with pytest.raises(InputError, match=r"shape \(1, 3, 17, 16\), expected \(b, 3, 16, 16\)"):
        extractor(torch.zeros(1, 3, 17, 16))


def constant() -> Any:
    """An output that the picture does not change."""
    net = Network()
    net.add("Identity", net.random(1, 8), output="embedding")
    return net.model(8, ["embedding"])


def chosen() -> Any:
    """Whole numbers, as floats."""
    net = Network()
    net.add("Cast", net.add("Cast", net.add("Flatten", "image"), to=7), to=1, output="embedding")
    return net.model(8, ["embedding"])


def undefined() -> Any:
    net = Network()
    less = net.add("Sub", "image", net.weight(np.float32(9)))
    net.add("Flatten", net.add("Sqrt", less), output="embedding")
    return net.model(8, ["embedding"])


def of_input(shape: list[int | str], kind: int = TensorProto.FLOAT, count: int = 1) -> Any:
    """Networks of other inputs."""
    names = [f"in{at}" for at in range(count)]
    nodes = [helper.make_node("Cast", [names[0]], ["cast"], to=1), helper.make_node("Flatten", ["cast"], ["embedding"])]
    model = make_model(nodes, dict.fromkeys(names, shape), {"embedding": TensorProto.FLOAT})
    for one in model.graph.input:
        one.type.tensor_type.elem_type = kind
    return model


WRONG = {
    "rank": ("identity", of_input([1, 3, 8]), r"input of shape \(1, 3, 8\), expected \(b, 3, S, S\)"),
    "channels": ("identity", of_input([1, 1, 8, 8]), r"\(1, 1, 8, 8\), expected \(b, 3, S, S\)"),
    "channels last": ("identity", of_input(["b", 8, 8, 3]), r"\(any, 8, 8, 3\), expected"),
    "not square": ("identity", of_input([1, 3, 8, 9]), "expected a square picture"),
    "several at once": ("identity", of_input([4, 3, 8, 8]), r"expected \(b, 3"),
    "bytes": ("identity", of_input([1, 3, 8, 8], TensorProto.UINT8), "'in0': of type 2, expected float32"),
    "two inputs": ("identity", of_input([1, 3, 8, 8], count=2), r"2 inputs \(in0, in1\), expected one picture"),
    "constant": ("identity", constant(), "'embedding': has no gradient"),
    "not differentiable": ("identity", chosen(), "'embedding': has no gradient"),
    "NaN": ("identity", undefined(), "'embedding': NaN or infinity for a grey picture"),
    "too many outputs": ("identity", bisenet_like(16), "2 outputs for identity .* name them as kinds in"),
    "classes": ("content", bisenet_like(16, classes=7), "last output of 7 channels, expected 11, or labels"),
    "no feature map": (
        "content",
        arcface_like(16),
        r"'embedding' of shape|of shape \(1, 8\) for one picture, expected",
    ),
    "range": ("attributes", attribute_net(16, sigmoid=False), "expected 0 to 1"),
    "landmarks": ("landmarks", arcface_like(16), "1 outputs for landmarks .* expected 2"),
}


@pytest.mark.parametrize("name", list(WRONG))
def test_wrong_signature_is_reported_when_the_file_is_loaded(name: str, tmp_path: Path) -> None:
    kind, model, what = WRONG[name]
    with pytest.raises(InputError, match=what) as caught:
        load_extractor(save(model, tmp_path / "wrong.onnx"), kind)
    assert str(caught.value).startswith(str(tmp_path / "wrong.onnx"))
    assert "\n" not in str(caught.value)


DESCRIPTIONS = {
    "other kind": ({"kind": "attributes"}, "gives attributes, expected identity"),
    "no such kind": ({"kind": "mood"}, "kind 'mood', expected one of"),
    "no kinds": ({"kinds": []}, 'neither "kind" nor "kinds"'),
    "outputs": ({"kinds": {"identity": "embedding"}}, "kinds -> identity: .* each is a text or a whole number"),
    "no such output": ({"kinds": {"identity": ["nose"]}}, "output 'nose'"),
    "no such position": ({"kinds": {"identity": [3]}}, "output 3, expected 0 to 0"),
    "size": ({"size": 3.5}, "size: 3.5, expected a whole number"),
    "huge": ({"size": 10**6}, "size: is 1000000, expected a number from 8 to 2048"),
    "another size": ({"size": 32}, "expected size 32"),
    "mean": ({"mean": [0, 1]}, r"mean: \[0, 1\], expected a list of 3 of which each is a finite number"),
    "std": ({"std": [1, 0, 1]}, r"std: \[1, 0, 1\], expected numbers above 0"),
    "order": ({"order": "GBR"}, "order: 'GBR', expected RGB, BGR"),
    "crop": ({"crop": ["face"]}, "crop: .* expected face, arcface"),
    "names": ({"names": "wide"}, "names: 'wide', expected a list of which each is a text"),
    "logits": ({"logits": 1}, "logits: 1, expected true or false"),
}


@pytest.mark.parametrize("name", list(DESCRIPTIONS))
def test_wrong_description_is_reported(name: str, tmp_path: Path) -> None:
    values, what = DESCRIPTIONS[name]
    path = beside(save(arcface_like(16), tmp_path / "face.onnx"), **values)
    with pytest.raises(InputError, match=what):
        load_extractor(path, "identity")


def test_the_file_beside_goes_before_the_metadata(tmp_path: Path) -> None:
    path = described(arcface_like(16), tmp_path / "face.onnx", kind="identity", trained_on="these")
    assert load_extractor(path).trained_on == "these"
    assert load_extractor(beside(path, kind="identity", trained_on="those")).trained_on == "those"


def test_metadata_that_cannot_be_read_is_reported(tmp_path: Path) -> None:
    model = arcface_like(16)
    with pytest.raises(InputError, match="does not say what it gives"):
        load_extractor(save(model, tmp_path / "silent.onnx"))
    model.metadata_props.add(key="facepipe.features", value="[" * 50)
    with pytest.raises(InputError, match=r"facepipe\.features: is not JSON"):
        load_extractor(save(model, tmp_path / "bad.onnx"))


def test_labels_and_names_that_do_not_fit_are_reported(tmp_path: Path) -> None:
    content = save(bisenet_like(16), tmp_path / "c.onnx")
    for labels, what in (
        (["nose"], "11 channels, expected 1 as its labels say"),
        (["beak"] * 11, "'beak', expected one"),
    ):
        with pytest.raises(InputError, match=what):
            load_extractor(beside(content, kind="content", labels=labels))
    values = beside(save(attribute_net(16), tmp_path / "a.onnx"), kind="attributes", names=["one"])
    with pytest.raises(InputError, match="5 values, expected 1 as its names say"):
        load_extractor(values)


class Embed(torch.nn.Module):
    """A network of torch, with dropout."""

    def __init__(self) -> None:
        super().__init__()
        self.conv = torch.nn.Conv2d(3, 6, 3, stride=2)
        self.norm = torch.nn.BatchNorm2d(6)
        self.drop = torch.nn.Dropout(0.5)
        self.dense = torch.nn.Linear(6, 8)

    def forward(self, image: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        x = self.drop(torch.relu(self.norm(self.conv(image))))
        return x, self.dense(x.mean(dim=(2, 3)))


def exported(
    path: Path, training: bool = False, image: torch.Tensor | None = None, dynamic: bool = False
) -> tuple[Any, Path]:
    torch.manual_seed(0)
    network = Embed().train(training)
    shapes = {"image": {0: torch.export.Dim("b")}} if dynamic else None
    torch.export.save(
        torch.export.export(network, (images(16) if dynamic else images(16, 1),), dynamic_shapes=shapes), path
    )
    return network, path


@pytest.fixture
def trusted() -> Iterator[None]:
    with trusting(Trust(models=True)):
        yield


def test_exported_program_is_not_loaded_unless_it_is_trusted(tmp_path: Path) -> None:
    _, path = exported(tmp_path / "net.pt2")
    with pytest.raises(
        InputError, match=r"net\.pt2: can run code as it is loaded, expected .onnx \(or --trust-models\)"
    ):
        load_extractor(beside(path, kinds={"identity": [1]}), "identity")


@pytest.mark.usefixtures("trusted")
@pytest.mark.parametrize("dynamic", [False, True])
def test_exported_program_gives_what_the_network_gives(dynamic: bool, tmp_path: Path) -> None:
    network, path = exported(tmp_path / "net.pt2", dynamic=dynamic)
    extractor = load_extractor(beside(path, kinds={"identity": [1]}), "identity")
    image = images(16, 3).requires_grad_()
    found, expected = extractor(image), network((image - 0.5) / 0.5)[1]
    torch.testing.assert_close(found, expected)
    gradients = [torch.autograd.grad(one.square().sum(), image)[0] for one in (found, expected)]
    torch.testing.assert_close(*gradients)
    assert not any(parameter.requires_grad for parameter in extractor.parameters())


@pytest.mark.usefixtures("trusted")
def test_exported_programs_that_cannot_be_used_are_reported(tmp_path: Path) -> None:
    _, path = exported(tmp_path / "net.pt2")
    with pytest.raises(InputError, match="2 outputs for identity"):
        load_extractor(path, "identity")
    with pytest.raises(InputError, match=r"output 'face', expected one of .* or a position"):
        load_extractor(beside(path, kinds={"identity": ["face"]}), "identity")
    cut = tmp_path / "cut.pt2"
    cut.write_bytes(path.read_bytes()[:1000])
    with pytest.raises(InputError, match=r"cut\.pt2: is damaged or no torch.export program"):
        load_extractor(cut, "identity")
    with pytest.raises(InputError, match="no such file"):
        load_extractor(tmp_path / "absent.pt2", "identity")
    with pytest.raises(InputError, match=r"suffix '.pth', expected .onnx or .pt2"):
        load_extractor(tmp_path / "net.pth", "identity")


@pytest.mark.usefixtures("trusted")
def test_exported_program_in_training_mode_is_refused(tmp_path: Path) -> None:
    _, path = exported(tmp_path / "net.pt2", training=True)
    with pytest.raises(InputError, match="expected a program exported in eval mode"):
        load_extractor(beside(path, kinds={"identity": [1]}), "identity")
