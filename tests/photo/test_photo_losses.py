"""The joint loss of photo fits: what each term measures, and its gradient."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import feature_graphs
import numpy as np
import pytest
from photo_people import SMILE, Portrait, joint_loss, moved, portrait, subject
from with_torch import tensor, torch

from facepipe.photo.descent.joint_loss import FeatureLosses, attributes, color_loss, content, identity
from facepipe.photo.descent.landmark_fit import Priors
from facepipe.photo.descent.subject import FOCAL
from facepipe.photo.features.extractor import Extractor, load_extractor

pytestmark = pytest.mark.needs_torch

ALONE = {
    "landmarks": 0.0,
    "color": 0.0,
    "content": 0.0,
    "identity": 0.0,
    "attributes": 0.0,
    "sparsity": 0.0,
    "expression_sparsity": 0.0,
    "hue": 0.0,
}
NETWORKS = {
    "content": lambda: feature_graphs.bisenet_like(32),
    "identity": lambda: feature_graphs.arcface_like(32),
    "attributes": lambda: feature_graphs.attribute_net(32),
}


@pytest.fixture(scope="module")
def extractors(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Extractor]:
    folder = tmp_path_factory.mktemp("networks")
    return {
        kind: load_extractor(feature_graphs.save(make(), folder / f"{kind}.onnx"), kind)  # type: ignore[arg-type]
        for kind, make in NETWORKS.items()
    }


# Colours


@cache
def pictures(height: int = 37, width: int = 53) -> tuple[torch.Tensor, torch.Tensor]:
    """Smooth random pictures in float64, and whole coverage."""
    coarse = torch.rand((1, 3, 6, 8), generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    image = torch.nn.functional.interpolate(coarse, (height, width), mode="bicubic")[0].permute(1, 2, 0)
    return 0.2 + 0.6 * image.clamp(0, 1), torch.ones((height, width), dtype=torch.float64)


def test_equal_pictures_cost_nothing_and_all_else_does() -> None:
    picture, whole = pictures()
    changes = {
        "brighter": picture + 0.1,
        "a stronger contrast": 1.2 * (picture - 0.5) + 0.5,
        "a channel": picture + tensor([0.05, 0, 0]),
        "channels swapped": picture.flip(2),
        "a pixel to the right": picture.roll(1, 1),
        "upside down": picture.flip(0),
        "one pixel": picture.index_put((torch.tensor([9]), torch.tensor([20])), tensor([0.0, 0.0, 0.0])),
    }
    assert color_loss(picture, picture, whole).item() == 0
    costs = {name: color_loss(other, picture, whole).item() for name, other in changes.items()}
    assert min(costs.values()) > 1e-4, costs
    for name, other in changes.items():
        assert color_loss(picture, other, whole).item() == pytest.approx(costs[name]), "as far there as back"


def test_small_differences_count_by_their_square_large_ones_no_more_than_by_their_size() -> None:
    picture, whole = pictures()
    noise = torch.randn(picture.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    small, doubled, large, larger = (
        color_loss(picture + size * noise, picture, whole).item() for size in (1e-4, 2e-4, 50.0, 100.0)
    )
    assert doubled / small == pytest.approx(4, rel=1e-3)
    assert small < large <= larger <= 2.01 * large


def test_fine_detail_costs_more_than_slow_shading_of_its_size() -> None:
    picture, whole = pictures(64, 64)
    y, x = torch.meshgrid(torch.arange(64), torch.arange(64), indexing="ij")
    checks = 0.05 * (1 - 2 * ((x // 2 + y // 2) % 2).double())[..., None]
    slope = 0.05 * (x / 31.5 - 1).double()[..., None]
    fine, slow = (color_loss(picture + each, picture, whole).item() for each in (checks, slope))
    assert checks.square().mean() > 2 * slope.square().mean()
    assert fine / checks.square().mean() > 2 * slow / slope.square().mean()


@pytest.mark.parametrize("size", [(16, 16), (17, 11), (8, 9)])
def test_color_gradients_are_those_of_finite_differences(size: tuple[int, int]) -> None:
    picture, whole = pictures(*size)
    other = picture + 0.3 * torch.rand(picture.shape, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    assert torch.autograd.gradcheck(lambda own: color_loss(own, picture, whole), (other.requires_grad_(),))


def test_color_counts_by_covered_pixel() -> None:
    """The same difference on a quarter of the coverage weighs four times."""
    picture, whole = pictures(64, 64)
    other = picture + 0.05
    quarter = whole.clone()
    quarter[:, 16:] = 0
    once, four = (color_loss(other, picture, each).item() for each in (whole, quarter))
    assert four == pytest.approx(4 * once)
    assert np.isfinite(color_loss(other, picture, 0 * whole).item())


# Terms of networks


def test_identity_is_the_angle_between_embeddings() -> None:
    """[0162]-[0163]: 0 for one direction of whatever length, 1 for right angles, 2 for opposite ones."""
    one = tensor([[3.0, 4.0, 0.0]])
    for other, expected in (([[6.0, 8.0, 0.0]], 0), ([[4.0, -3.0, 0.0]], 1), ([[-3.0, -4.0, 0.0]], 2)):
        assert identity(one, tensor(other)).item() == pytest.approx(expected)


def test_attributes_are_apart_by_their_root_mean_square() -> None:
    assert attributes(tensor([[0.1, 0.9, 0.5, 0.5]]), tensor([[0.4, 0.5, 0.5, 0.5]])).item() == pytest.approx(0.25)
    same = tensor([[0.3, 0.7]]).requires_grad_()
    attributes(same, tensor([[0.3, 0.7]])).backward()
    assert same.grad.isfinite().all()


def test_content_adds_relative_differences_of_all_depths() -> None:
    """[0158]: whatever the size of a layer's features, and however many it has."""
    rng = np.random.default_rng(0)
    seen = (tensor(rng.random((1, 4, 8, 8))), tensor(rng.random((1, 11, 16, 16))))
    found = (1.1 * seen[0], 1.3 * seen[1])
    assert content(found, seen).item() == pytest.approx(0.4)
    assert content((1e3 * found[0], found[1]), (1e3 * seen[0], seen[1])).item() == pytest.approx(0.4)
    assert content(seen, seen).item() == 0


def test_network_terms_are_nothing_at_the_photo_and_have_its_gradients(extractors: dict[str, Extractor]) -> None:
    own = portrait()
    photo = torch.as_tensor(own.images[0])
    losses = FeatureLosses(extractors, [photo], own.landmarks)
    assert {kind: round(value.item(), 5) for kind, value in losses(photo, 0).items()} == dict.fromkeys(NETWORKS, 0.0)
    for one in extractors.values():
        one.double()
    try:
        exact = FeatureLosses(extractors, [photo.double()], own.landmarks)
        random = torch.Generator().manual_seed(0)
        other = (photo.double() + 0.2 * torch.rand(photo.shape, generator=random, dtype=torch.float64)).requires_grad_()
        step = torch.randn(photo.shape, generator=random, dtype=torch.float64)
        for kind in NETWORKS:
            (slope,) = torch.autograd.grad(exact(other, 0)[kind], other)
            with torch.no_grad():
                ahead, behind = (exact(other + sign * 1e-6 * step, 0)[kind] for sign in (1, -1))
            assert (slope * step).sum().item() == pytest.approx((ahead - behind).item() / 2e-6, rel=1e-3), kind
            assert (ahead + behind).item() > 0
    finally:
        for one in extractors.values():
            one.float()


def test_a_network_of_several_kinds_runs_once(tmp_path: Path) -> None:
    net = feature_graphs.Network()
    x = net.relu(net.conv("image", 3, 4, stride=4))
    flat = net.add("Reshape", net.add("ReduceMean", x, axes=[2, 3], keepdims=1), net.weight(np.array([0, -1])))
    net.add("MatMul", flat, net.random(4, 6), output="embedding")
    net.add("Sigmoid", net.add("MatMul", flat, net.random(4, 3)), output="values")
    path = feature_graphs.save(net.model(32, ["embedding", "values"]), tmp_path / "both.onnx")
    (tmp_path / "both.onnx.json").write_text('{"kinds": {"identity": ["embedding"], "attributes": ["values"]}}')
    both = load_extractor(path)
    own, calls = portrait(), []
    both.network.register_forward_hook(lambda *_: calls.append(1))
    photo = torch.as_tensor(own.images[0])
    losses = FeatureLosses({"identity": both, "attributes": both}, [photo], own.landmarks)
    assert len(calls) == 1
    assert sorted(losses(0.5 * photo, 0)) == ["attributes", "identity"]
    assert len(calls) == 2


# The joint loss


def test_the_truth_costs_nothing_but_what_is_drawn_to_defaults() -> None:
    own = portrait(shadows=True)
    terms = joint_loss(own, color=1.0, sparsity=0.1, expression_sparsity=0.5)(own.truth)
    assert terms["landmarks"].item() < 1e-6
    assert terms["color"].item() < 0.02, "nothing but edges, which blend with a photo that blends them already"
    shares = own.state.shares - subject().default_shares
    assert terms["sparsity"].item() == pytest.approx(0.1 * np.abs(shares).sum(), rel=0.05)
    assert terms["expression_sparsity"].item() == pytest.approx(0.5 * sum(SMILE.values()))
    for name in ("shares", "expressions", "poses", "light", "tint"):
        generator = torch.Generator().manual_seed(3)
        value = getattr(own.truth, name)
        size = 0.3 if name in ("light", "tint") else 0.1
        off = moved(own.truth, name, size * torch.randn(value.shape, generator=generator, dtype=value.dtype))
        assert joint_loss(own, color=1.0)(off)["color"].item() > 2 * terms["color"].item(), name


def test_terms_are_weighted_switched_off_and_summed(extractors: dict[str, Extractor]) -> None:
    own = portrait()
    at = moved(own.truth, "light", 0.1 * torch.ones(1, 9, 3))
    at = moved(at, "poses", tensor([[0.01, 0.02, 0, 0.01, 0, 0.02, 0]]))
    at = moved(at, "key", tensor([[0, 0, 0, 0.1, 0.5, 0.9, 0, 0]]))
    weights = {name: 0.5 + number for number, name in enumerate(ALONE)}
    every = joint_loss(own, extractors, **weights)(at)
    assert sorted(every) == sorted([*ALONE, "prior", "total"])
    assert every["total"].item() == pytest.approx(sum(every[name].item() for name in [*ALONE, "prior"]), rel=1e-6)
    for name, weight in weights.items():
        single_term = joint_loss(own, extractors, **{**ALONE, name: 2 * weight})(at)
        assert sorted(single_term) == sorted([name, "prior", "total"])
        assert single_term[name].item() == pytest.approx(2 * every[name].item(), rel=1e-5), name
        assert every[name].item() > 0, name


def test_networks_of_terms_that_are_off_do_not_run(extractors: dict[str, Extractor]) -> None:
    own, calls = portrait(), []
    hook = extractors["identity"].network.register_forward_hook(lambda *_: calls.append(1))
    joint_loss(own, extractors, **{**ALONE, "landmarks": 1.0})(own.truth)
    joint_loss(own, extractors, **{**ALONE, "attributes": 1.0})(own.truth)
    assert not calls
    joint_loss(own, extractors, **{**ALONE, "identity": 1.0})(own.truth)
    hook.remove()
    assert len(calls) == 2, "the photo and the picture"


# Term, unknown: a step along the slope, and what rounding in float32 leaves, and that contours turn with expressions.
SLOPES = {
    ("landmarks", "shares"): (1e-3, 0.01),
    ("landmarks", "expressions"): (1e-3, 0.03),
    ("landmarks", "poses"): (1e-6, 1e-3),
    ("sparsity", "shares"): (1e-3, 0.01),
    ("expression_sparsity", "expressions"): (1e-3, 1e-3),
    ("color", "light"): (1e-3, 0.01),
    ("color", "tint"): (1e-3, 0.01),
    ("identity", "light"): (3e-3, 0.05),
    ("content", "tint"): (1e-3, 0.05),
    ("attributes", "light"): (3e-3, 0.05),
}


def slopes(own: Portrait, term: str, name: str, size: float, networks: dict[str, Extractor]) -> tuple[float, float]:
    """Slope of a term alone, near the truth, along its gradient: by itself, and by a step ahead and behind."""
    random, at = torch.Generator().manual_seed(5), own.truth
    for one in ("shares", "expressions", "light", "tint", "poses"):
        value = getattr(at, one)
        at = moved(at, one, 0.04 * torch.rand(value.shape, generator=random, dtype=value.dtype))
    loss = joint_loss(own, networks, **{**ALONE, term: 1.0, "size": own.images[0].shape[0] + 32})
    (slope,) = torch.autograd.grad(loss(at)[term], getattr(at, name))
    step = size * slope / slope.norm()
    with torch.no_grad():
        ahead, behind = (loss(moved(at, name, sign * step))[term].item() for sign in (1, -1))
    return slope.norm().item(), (ahead - behind) / (2 * size)


@pytest.mark.parametrize(("term", "name"), SLOPES)
def test_gradients_of_terms_are_those_of_finite_differences(
    term: str, name: str, extractors: dict[str, Extractor]
) -> None:
    size, bound = SLOPES[term, name]
    own, expected = slopes(portrait.__wrapped__(), term, name, size, extractors)  # its tensors are nobody else's
    assert own > 0
    assert own == pytest.approx(expected, rel=bound)


@pytest.mark.parametrize(("name", "size"), [("shares", 1e-2), ("expressions", 5e-2), ("poses", 3e-3)])
def test_color_has_slopes_along_which_it_falls(name: str, size: float) -> None:
    """What is behind what changes with every step: to a factor of 2, at the resolution that fits use."""
    own, real = slopes(portrait(size=224), "color", name, size, {})
    assert 0.5 < real / own < 2


def test_image_terms_of_several_photos_are_means() -> None:
    own = portrait(seed=2, views=2)
    at = moved(own.truth, "shares", 0.05 * torch.ones(len(own.state.shares)))
    both = joint_loss(own, sparsity=0.0, expression_sparsity=0.0)(at)
    alone = []
    for view in range(2):
        part = replace(
            own,
            images=own.images[view : view + 1],
            landmarks=own.landmarks[view : view + 1],
            spaces=own.spaces[:1],
            shadows=own.shadows[:1],
        )
        rows = {one: getattr(at, one)[view : view + 1] for one in ("expressions", "poses", "light", "key")}
        alone.append(joint_loss(part, sparsity=0.0, expression_sparsity=0.0)(replace(at, **rows)))
    for terms in (both, *alone):
        terms["others"] = terms["total"] - terms["prior"]
    for name in ("landmarks", "color", "others"):
        assert both[name].item() == pytest.approx((alone[0][name] + alone[1][name]).item() / 2, rel=1e-5)


# The prior


def prior(views: int, lens: float) -> tuple[float, float]:
    """That of a person in some photos by lenses of a focal length in sides of the photo, and that of the person alone.

    In units in which a landmark's error of one standard deviation is a half.
    """
    own = portrait(seed=1, views=views)
    loss = joint_loss(own)
    poses = own.truth.poses.detach().clone()
    poses[:, 6] = np.log(lens) - poses[:, 5]
    off = (own.state.shares - subject().default_shares) / loss.fit.priors.slider_sigma
    return 68 * float(loss(replace(own.truth, poses=poses))["prior"].detach()), float(off @ off) / 2


@pytest.mark.parametrize("views", [1, 3])
def test_a_person_counts_once_beside_the_sum_of_all_photos(views: int) -> None:
    """Image terms are means over photos."""
    found, person = prior(views, FOCAL)
    assert found == pytest.approx(person / views, rel=1e-4)


def test_lenses_that_are_no_portrait_lenses_cost_as_landmarks_have_it() -> None:
    spread = Priors().focal_sigma
    usual, *others = (prior(1, FOCAL * np.exp(off * spread))[0] for off in (0, 2, -2))
    assert np.array(others) - usual == pytest.approx([2**2 / 2] * 2, rel=1e-3)
