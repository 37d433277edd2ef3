"""The differentiable rig against facepipe.rig, and its gradients against finite differences."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import numpy as np
import pytest
from faces import tiny_face, with_meshes
from import_data import shared
from oracle import random_coefficients
from small_head import make
from with_torch import torch

from facepipe.core.errors import InputError
from facepipe.importers import load
from facepipe.parts import FaceParts, Slider
from facepipe.rig import Rig, build, slide
from facepipe.rig.torch.rig import DifferentiableRig, FixedMatrix

pytestmark = pytest.mark.needs_torch


@cache
def sample() -> FaceParts:
    return make(0)


@cache
def makehuman() -> FaceParts:
    return load("makehuman", shared("makehuman/makehuman_head.npz")).parts


def bent() -> tuple[Slider, ...]:
    """Sliders of the tiny face with every kind of entry: straight, curved, both halves, outside their range."""
    return (
        Slider(
            name="chin",
            minimum=-1,
            channels=(("root/jaw", "tx", 0.5), ("root/jaw", "rz", -0.3), ("root/jaw", "tx", 0.2)),
            channel_curves=(None, ((-0.5, -1.0), (0.25, 0.0), (0.5, 2.0)), ((-3.0, 4.0), (0.1, 1.0), (7.0, -1.0))),
            shapes=(("mouthSmileLeft", 0.4), ("jawOpen", 0.7), ("jawOpen", 0.5)),
            shape_curves=(((-1.0, 1.0), (0.0, 0.0)), None, ((0.0, 0.0), (1.0, 1.0))),
        ),
        Slider(name="size", minimum=0.5, maximum=2.0, default=1.0, channels=(("root", "sx", 1.0), ("root", "sy", 0.5))),
        Slider(name="fixed", minimum=0.3, maximum=0.3, default=0.3, value=0.3, shapes=(("jawOpen", 1.0),),
               shape_curves=(((0.0, 1.0), (1.0, 2.0)),)),
    )  # fmt: skip


def pose(rig: Rig, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Bone coefficients (j, 9) and shape weights, some of them beyond 0..1."""
    rng = np.random.default_rng(seed)
    size = float(np.ptp(rig.points[:, 1])) / 30
    return random_coefficients(rng, len(rig.joints), size), rng.uniform(-0.5, 1.5, len(rig.shapes))


FACES: dict[str, Callable[[], FaceParts]] = {"tiny": tiny_face, "sample": sample, "makehuman": makehuman}
TYPES = [("float32", 1e-5), ("float64", 1e-12)]


@pytest.mark.parametrize(("kind", "bound"), TYPES)
@pytest.mark.parametrize("name", FACES)
def test_a_batch_of_poses_as_the_rig(name: str, kind: str, bound: float) -> None:
    rig = build(FACES[name]())
    poses = [pose(rig, seed) for seed in range(4)]
    learned = DifferentiableRig(rig, dtype=getattr(torch, kind))
    coefficients, weights = (torch.tensor(np.stack(each)).to(learned.dtype) for each in zip(*poses, strict=True))
    found = learned(weights=weights.reshape(2, 2, -1), coefficients=coefficients.reshape(2, 2, -1, 9))
    expected = np.stack([rig.evaluate(own, coefficients=bones) for bones, own in poses])
    height = np.ptp(rig.points[:, 1])
    assert found.dtype == learned.dtype
    assert found.shape == (2, 2, len(rig.points), 3)
    assert np.abs(found.reshape(4, -1, 3).numpy() - expected).max() <= bound * height


@pytest.mark.parametrize(("kind", "bound"), TYPES)
@pytest.mark.parametrize("name", ["tiny", "sample"])
def test_sliders_as_the_rig(name: str, kind: str, bound: float) -> None:
    parts = FACES[name]()
    sliders = bent() if name == "tiny" else parts.sliders
    rig = build(parts)
    learned = DifferentiableRig(rig, sliders, dtype=getattr(torch, kind))
    rng = np.random.default_rng(0)
    lower, upper = (np.array([getattr(slider, side) for slider in sliders]) for side in ("minimum", "maximum"))
    values = rng.uniform(lower - 0.5, upper + 0.5, (20, len(sliders)))
    values[:3] = np.stack([lower, upper, np.zeros(len(sliders))])
    own = rng.uniform(0, 1, len(rig.shapes))
    found = learned(torch.tensor(values).to(learned.dtype), torch.tensor(own).to(learned.dtype))
    for number, row in enumerate(values):
        coefficients, driven = slide(sliders, rig.joints, dict(zip(learned.sliders.names, row, strict=True)))
        expected = rig.evaluate(rig.weight_vector(driven) + own, coefficients=coefficients)
        assert np.abs(found[number].numpy() - expected).max() <= bound * np.ptp(rig.points[:, 1])
    assert learned.sliders.value.tolist() == pytest.approx(
        [slider.default if slider.value is None else slider.value for slider in sliders]
    )


@pytest.mark.parametrize("last", [False, True])
def test_gradients_as_finite_differences(last: bool) -> None:
    rig = build(tiny_face())
    learned = DifferentiableRig(rig, bent(), expressions_last=last, dtype=torch.float64)
    coefficients, weights = (torch.tensor(each, requires_grad=True) for each in pose(rig, 3))
    values = torch.tensor([[-0.7, 0.9, 0.3], [0.37, 1.2, 0.3]], dtype=torch.float64, requires_grad=True)
    world = torch.tensor(np.eye(4) + 0.1 * np.random.default_rng(0).normal(size=(4, 4)), requires_grad=True)
    free = values[:, :2].detach().requires_grad_()

    def slid(own: torch.Tensor, beta: torch.Tensor) -> torch.Tensor:
        return learned(torch.cat([own, values[:, 2:].detach()], dim=1), beta)

    def posed(bones: torch.Tensor, beta: torch.Tensor, root: torch.Tensor) -> torch.Tensor:
        return learned(weights=beta, coefficients=bones, parent_world=root)

    assert torch.autograd.gradcheck(slid, (free, weights))
    assert torch.autograd.gradcheck(posed, (coefficients, weights, world))


def test_gradients_on_the_sample_as_finite_differences_of_the_rig() -> None:
    """Along a random direction, in all sliders and weights at once, against the numpy rig."""
    parts, rng = sample(), np.random.default_rng(1)
    rig = build(parts)
    learned = DifferentiableRig(rig, parts.sliders, dtype=torch.float64)
    values, weights = rng.uniform(0.1, 0.4, len(parts.sliders)), rng.uniform(0.1, 0.9, len(rig.shapes))
    by_value, by_weight = rng.normal(size=len(values)), rng.normal(size=len(weights))
    pull = rng.normal(size=rig.points.shape)

    def moved(step: float) -> float:
        own = dict(zip(learned.sliders.names, values + step * by_value, strict=True))
        coefficients, driven = slide(parts.sliders, rig.joints, own)
        beta = rig.weight_vector(driven) + weights + step * by_weight
        return float((pull * rig.evaluate(beta, coefficients=coefficients)).sum())

    inputs = [torch.tensor(each, requires_grad=True) for each in (values, weights)]
    (torch.tensor(pull) * learned(*inputs)).sum().backward()
    found = float(inputs[0].grad @ torch.tensor(by_value) + inputs[1].grad @ torch.tensor(by_weight))
    assert found == pytest.approx((moved(1e-5) - moved(-1e-5)) / 2e-5, rel=1e-6)


def test_at_a_bend_the_gradient_is_the_mean_of_both_sides() -> None:
    """A slider of two sculpts, one on each side of its default, may leave the default either way."""
    halves = Slider(
        name="smile", minimum=-1, shapes=(("jawOpen", 1.0), ("mouthSmileLeft", 1.0)),
        shape_curves=(((-1.0, 1.0), (0.0, 0.0)), ((0.0, 0.0), (1.0, 1.0))),
    )  # fmt: skip
    learned = DifferentiableRig(build(tiny_face()), [halves], dtype=torch.float64)
    value = torch.zeros(1, dtype=torch.float64, requires_grad=True)
    _, weights = learned.sliders(value)
    for weight, slope in zip(weights, (-0.5, 0.5), strict=True):
        (found,) = torch.autograd.grad(weight, value, retain_graph=True)
        assert found.item() == slope


def test_expressions_last_adds_them_to_the_skinned_points() -> None:
    """[0242]: V = skinned points + sum of beta delta, turned with the place of the skeleton alone."""
    parts = sample()
    rig = build(parts)
    coefficients, weights = pose(rig, 5)
    learned = DifferentiableRig(rig, expressions_last=True, dtype=torch.float64)
    found = learned(weights=torch.tensor(weights), coefficients=torch.tensor(coefficients)).numpy()
    expected = rig.evaluate(coefficients=coefficients) + rig.morph(weights) - rig.points
    assert np.abs(found - expected).max() <= 1e-12 * np.ptp(rig.points[:, 1])
    assert np.abs(found - rig.evaluate(weights, coefficients=coefficients)).max() > 1e-3


def test_a_face_without_joints_or_shapes_moves_with_its_parent() -> None:
    from dataclasses import replace

    from facepipe.parts import Skeleton

    rig = build(with_meshes(replace(tiny_face(), skeleton=Skeleton()), skin=None, blendshapes=()))
    world = np.eye(4)
    world[:3, 3] = (1, 2, 3)
    found = DifferentiableRig(rig, dtype=torch.float64)(parent_world=torch.tensor(world))
    np.testing.assert_allclose(found.numpy(), rig.points + world[:3, 3], atol=1e-12)


def test_what_does_not_fit_is_refused() -> None:
    rig = build(tiny_face())
    learned = DifferentiableRig(rig, bent())
    with pytest.raises(InputError, match=r"sliders of shape \(2,\), expected \(..., 3\)"):
        learned(torch.zeros(2))
    with pytest.raises(InputError, match=r"bone coefficients of shape \(9,\), expected \(..., 3, 9\)"):
        learned(coefficients=torch.zeros(9))
    with pytest.raises(InputError, match="only one"):
        learned(torch.zeros(3), coefficients=torch.zeros(3, 9))
    with pytest.raises(InputError, match="slider odd: no shape 'grin'"):
        DifferentiableRig(rig, [Slider(name="odd", shapes=(("grin", 1.0),))])
    with pytest.raises(InputError, match="slider odd: no joint 'root' with a channel 'tw'"):
        DifferentiableRig(rig, [Slider(name="odd", channels=(("root", "tw", 1.0),))])


@pytest.mark.parametrize("density", [0.0, 0.02, 0.5])
def test_fixed_matrices_multiply_either_way(density: float) -> None:
    from scipy import sparse

    rng = np.random.default_rng(0)
    matrix = sparse.csr_array(np.where(rng.random((40, 30)) < density, rng.normal(size=(40, 30)), 0.0))
    x = torch.tensor(np.random.default_rng(1).normal(size=(30, 5)), requires_grad=True)
    fixed = FixedMatrix(matrix, torch.float64, "cpu")
    np.testing.assert_allclose((fixed @ x).detach().numpy(), matrix @ x.detach().numpy(), atol=1e-13)
    assert torch.autograd.gradcheck(lambda one: fixed @ one, (x,))
    assert torch.autograd.gradgradcheck(lambda one: (fixed @ one) ** 2, (x,))
