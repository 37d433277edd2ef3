"""The colours of scans on the textures of a face: as scanned where the scan shows them, evened, and without a seam."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path

import numpy as np
import pytest
import small_head
import trimesh
from command_line import Capsys, done, run
from node import validate
from scipy.spatial import cKDTree

import facepipe
from facepipe.core.arrays import BoolArray, FloatArray
from facepipe.core.errors import TopologyError
from facepipe.geometry.colors import from_srgb, to_srgb
from facepipe.geometry.polygons import point_normals
from facepipe.geometry.similarity import Similarity
from facepipe.geometry.texels import Texels, spread
from facepipe.heads.assembly import make
from facepipe.heads.skin import jpeg, to_bytes
from facepipe.importers.scan_file import read_scan
from facepipe.importers.scan_landmarks import write_scan_landmarks
from facepipe.parts import FaceParts, Mesh, TextureInput
from facepipe.scanning.database import create_database, save_database
from facepipe.scanning.rebuild.template import Template
from facepipe.scanning.texture import (
    ScanTextures,
    bake_scan,
    baked_relief,
    is_finer,
    lay_on,
    median_edge,
    scan_samples,
    under_hair,
)
from facepipe.scans import Scan, ScanLandmarks
from facepipe.stage import save_parts
from facepipe.textures.bake import Baker
from facepipe.textures.evened import inner
from facepipe.textures.skin_surface import SkinSurface, skin_of
from facepipe.verbs.whole_faces import Topology, whole_face, whole_points

SIZE, FINE = 128, 256  # texels
CENTIMETRES = Similarity(rotation=np.eye(3), translation=np.zeros(3), scale=10.0)
AS_IT_IS = Similarity(rotation=np.eye(3), translation=np.zeros(3))


@dataclass(frozen=True)
class Actor:
    """A person of the small head, whose skin was scanned, and the template on that person's shape."""

    folder: Path
    head: Callable[..., FaceParts] = small_head.make

    @cached_property
    def person(self) -> FaceParts:
        made = self.head(21, textures=SIZE)
        return replace(made, meshes=made.meshes[:1], sliders=(), animations=(), played=None)

    @cached_property
    def template(self) -> SkinSurface:
        parts = self.head(0, textures=SIZE)
        return skin_of(replace(parts, meshes=parts.meshes[:1]), whole_points(self.person), None)

    @cached_property
    def truth(self) -> SkinSurface:
        return skin_of(self.person, whole_points(self.person), None)

    @cached_property
    def scan(self) -> Scan:
        return self.scanned(self.person, "scan")

    @cached_property
    def lit(self) -> Scan:
        """The same in the light of a lamp from one side and above."""
        normals = point_normals(self.truth.points, self.truth.triangles)
        return self.dyed("lit", 0.7 + 0.25 * normals @ (0.6, 0.5, 0.6))

    @cached_property
    def browed(self) -> Scan:
        """The same with brows, which the head in the box has on cards."""
        skin = self.truth
        brows = skin.points[skin.landmarks[17:27]] - [0.0, 3.0, 0.0]  # mm
        return self.dyed("browed", 1 - 0.6 * (cKDTree(brows).query(skin.points)[0] < 5.0))

    def dyed(self, name: str, shares: FloatArray) -> Scan:
        """The scan with its colours times shares (n,) of the skin's points."""
        materials = {material.name: material for material in self.person.materials}
        for texture, colors in zip(self.truth.textures, true_colors(self.truth), strict=True):
            picture = np.zeros((SIZE**2, 3))
            picture[texture.texels.at] = to_srgb(colors * texture.texels.carried(shares[:, None]))
            image = jpeg(name, to_bytes(picture.reshape(SIZE, SIZE, 3)))
            for material in texture.materials:
                source = replace(texture.source, texture=replace(image, name=f"{material}.jpg"))
                materials[material] = replace(materials[material], diffuse_color=source)
        return self.scanned(replace(self.person, materials=tuple(materials.values())), name)

    def scanned(self, parts: FaceParts, name: str) -> Scan:
        save_parts(parts, self.folder / f"{name}.usda")
        return read_scan(self.folder / f"{name}.usda")


@pytest.fixture(scope="module")
def dressed() -> FaceParts:
    """The average head of the box with all its points, cards of hairs, and coarse textures."""
    return make(0, textures=16)


@pytest.fixture(scope="module")
def actor(tmp_path_factory: pytest.TempPathFactory) -> Actor:
    return Actor(tmp_path_factory.mktemp("actor"))


def true_colors(skin: SkinSurface) -> list[FloatArray]:
    """(m, 3) linear colours of the texels of each texture."""
    return [np.asarray(flat) for flat in Baker(skin).flats]


def off(actor: Actor, baked: ScanTextures, chosen: BoolArray) -> FloatArray:
    """(k, 3) sRGB differences from the truth, of texels at chosen points (n,)."""
    rows = []
    truth = zip(actor.truth.textures, true_colors(actor.truth), baked.pictures, strict=True)
    for texture, colors, picture in truth:
        here = chosen[texture.texels.corners].all(axis=1)
        rows.append(picture.reshape(-1, 3)[texture.texels.at[here]] - to_srgb(colors[here]))
    return np.concatenate(rows)


def test_a_textured_scan_gives_the_skin_its_own_colours(actor: Actor) -> None:
    laid = lay_on(actor.template, actor.scan, CENTIMETRES)
    skin, samples = actor.template.points[actor.template.outside], laid.samples.points
    assert np.abs(samples.min(axis=0) - skin.min(axis=0)).max() < 1.0  # mm: of all of it
    assert np.abs(samples.max(axis=0) - skin.max(axis=0)).max() < 1.0
    baked = bake_scan(laid, 0.0)
    assert baked.coverage > 0.98
    assert np.abs(off(actor, baked, actor.template.outside)).mean() < 0.006  # sRGB, 0..1
    template = ScanTextures(pictures=tuple(pictures_of(actor.template)), coverage=0.0, light=0.0)
    assert np.abs(off(actor, template, actor.template.outside)).mean() > 0.05  # it had another skin


def pictures_of(skin: SkinSurface) -> list[FloatArray]:
    shown = zip(skin.textures, Baker(skin).flats, strict=True)
    return [np.asarray(to_srgb(spread(texture.texels, flat)), np.float32) for texture, flat in shown]


def test_colours_at_points_do_where_there_is_no_texture(actor: Actor) -> None:
    dense = scan_samples(actor.scan, AS_IT_IS, np.full(3, -1e3), np.full(3, 1e3), 0.12)
    cloud = Scan(name="cloud", points=dense.points, normals=dense.normals, colors=dense.colors)
    baked = bake_scan(lay_on(actor.template, cloud, CENTIMETRES), 0.0)
    assert np.abs(off(actor, baked, actor.template.outside)).mean() < 0.012


def test_what_half_a_scan_shows_continues_without_a_seam(actor: Actor) -> None:
    kept = actor.scan.points[actor.scan.triangles][..., 0].mean(axis=1) < 0.5
    texture = actor.scan.texture
    assert texture is not None
    half = replace(actor.scan, triangles=actor.scan.triangles[kept], texture=texture.on_triangles(kept))
    baked = bake_scan(lay_on(actor.template, half, CENTIMETRES), 0.0)
    assert 0.4 < baked.coverage < 0.65
    skin = actor.template
    shown, hidden = skin.points[:, 0] < -10, skin.points[:, 0] > 10  # mm; between, confidence fades
    face = skin.outside & (inner(skin) > 0.5)
    assert np.abs(off(actor, baked, skin.outside & shown)).mean() < 0.006
    template = ScanTextures(pictures=tuple(pictures_of(skin)), coverage=0.0, light=0.0)
    follows, was = (np.abs(off(actor, one, face & hidden)).mean() for one in (baked, template))
    assert follows < 0.6 * was  # people are not alike on both sides
    front, picture = skin.textures[0], baked.pictures[0].reshape(-1, 3)
    wrong = picture[front.texels.at] - to_srgb(true_colors(actor.truth)[0])
    x, inside = (front.texels.carried(one[:, None])[:, 0] for one in (skin.points[:, 0], face * 1.0))
    columns = [wrong[(inside > 0.99) & (np.abs(x - at) < 2)].mean(axis=0) for at in range(-20, 24, 4)]  # 4 mm wide
    assert np.abs(np.diff(columns, axis=0)).max() < 0.02  # cut off, it would be 0.1


def test_light_is_evened_but_not_the_persons_tone(actor: Actor) -> None:
    chosen = actor.template.outside & (inner(actor.template) > 0.5)
    raw, evened = (bake_scan(lay_on(actor.template, actor.lit, CENTIMETRES), even) for even in (0.0, 1.0))
    assert raw.light == 0.0 < evened.light

    def spread_of(baked: ScanTextures) -> float:
        """Standard deviation of the logarithm of what light is left."""
        logs = []
        for texture, colors, picture in zip(
            actor.truth.textures, true_colors(actor.truth), baked.pictures, strict=True
        ):
            here = chosen[texture.texels.corners].all(axis=1)
            shown = np.maximum(from_srgb(picture.reshape(-1, 3)[texture.texels.at[here]]), 0.004)
            logs.append(np.log(shown / colors[here]).mean(axis=1))
        return float(np.concatenate(logs).std())

    assert spread_of(evened) < 0.5 * spread_of(raw)
    flat = bake_scan(lay_on(actor.template, actor.scan, CENTIMETRES), 1.0)  # no light to even: hardly anything changes
    assert np.abs(off(actor, flat, chosen)).mean() < 0.02


@pytest.mark.slow
def test_brows_are_seen_where_a_scan_has_them(actor: Actor) -> None:
    """Cards of brows would lie on them once more."""
    without, with_them = (
        bake_scan(lay_on(actor.template, scan, CENTIMETRES), 1.0).brows for scan in (actor.scan, actor.browed)
    )
    assert without < 0.12
    assert with_them > 0.25


def test_the_scalp_under_hair_is_covered(dressed: FaceParts) -> None:
    points = whole_points(dressed)
    skin = skin_of(dressed, points, None)
    covered = under_hair(dressed, points, skin)
    top = skin.points[:, 1] > skin.points[skin.landmarks[17:27], 1].max() + 70.0  # mm
    assert covered[top & skin.outside].mean() > 0.9
    assert not covered[skin.landmarks[17:]].any()
    assert not under_hair(replace(dressed, meshes=dressed.meshes[:1]), points, skin).any()


def test_what_is_covered_stays_the_templates(actor: Actor) -> None:
    skin = actor.template
    covered = skin.points[:, 1] > skin.points[skin.landmarks[17:27], 1].max() + 30.0  # mm
    baked = bake_scan(lay_on(skin, actor.scan, CENTIMETRES, covered), 0.0)
    face = skin.outside & (inner(skin) > 0.9) & ~covered
    assert np.abs(off(actor, baked, face)).mean() < 0.006
    assert np.abs(off(actor, baked, covered)).mean() > 0.02


WAVE, HEIGHT = 6.0, 0.15  # mm, of ripples on a scan


def rippled(skin: SkinSurface) -> Scan:
    """The skin's face in triangles a fourth as long, with ripples across x."""
    front = skin.triangles[(skin.points[skin.triangles][..., 2] > 60).all(axis=1)]
    face = trimesh.Trimesh(skin.points, front, process=False).subdivide().subdivide()
    off = HEIGHT * np.sin(2 * np.pi / WAVE * face.vertices[:, :1])
    return Scan(
        name="rippled", points=face.vertices + off * point_normals(face.vertices, face.faces), triangles=face.faces
    )


def test_ripples_that_the_mesh_is_too_coarse_for_go_to_the_normal_map(dressed: FaceParts) -> None:
    mesh, *_ = dressed.meshes
    skin = skin_of(replace(dressed, meshes=(mesh,)), 10.0 * mesh.points, FINE)  # mm
    scan = rippled(skin)
    on_scan, edge = lay_on(skin, scan, AS_IT_IS), median_edge(scan.points, scan.triangles)
    assert is_finer(skin, edge)
    assert not is_finer(skin, 4 * edge)  # as coarse as the mesh
    level = jpeg("level", np.full((FINE, FINE, 3), (128, 128, 255), np.uint8))
    own = TextureInput(texture=level, scale=(2.0, 2.0, 2.0, 1.0), bias=(-1.0, -1.0, -1.0, 0.0))
    texels, relief = skin.textures[0].texels, baked_relief(on_scan, 0, own, edge)
    within = on_scan.trust[texels.corners].min(axis=1) == 1
    within &= (point_normals(skin.points, skin.triangles)[texels.corners][..., 2] > 0.8).all(axis=1)
    part = texels.taken(np.flatnonzero(within))
    x, normal = part.carried(skin.points)[:, 0], part.carried(on_scan.normals)
    slope = HEIGHT * 2 * np.pi / WAVE * np.cos(2 * np.pi / WAVE * x)
    true = normal - slope[:, None] * ([1, 0, 0] - normal[:, :1] * normal)
    u, v = directions(mesh, skin, part)
    shown = relief.reshape(-1, 3)[part.at]
    shown = shown[:, :1] * u + shown[:, 1:2] * v + shown[:, 2:] * normal
    turned, missed = (angles(normals, true) for normals in (shown, normal))
    assert np.degrees(np.median(missed)) > 5.0  # without it
    assert np.median(turned) < 0.4 * np.median(missed)


def directions(mesh: Mesh, skin: SkinSurface, part: Texels) -> tuple[FloatArray, FloatArray]:
    """(m, 3) unit directions of growing u and v in the triangles of texels."""
    uvs = np.zeros((len(skin.points), 2))
    (uv,) = mesh.uv_sets
    uvs[mesh.face_vertex_indices] = np.asarray(uv.values)[uv.indices]
    (a, b, c), (ua, ub, uc) = ([values[corner] for corner in part.corners.T] for values in (skin.points, uvs))
    uv_sides = np.stack([ub - ua, uc - ua], axis=1)  # (m, side, u v)
    sides = np.stack([b - a, c - a], axis=1)
    along = np.linalg.solve(uv_sides, sides)  # (m, u v, x y z)
    along /= np.linalg.norm(along, axis=2, keepdims=True)
    return along[:, 0], along[:, 1]


def angles(some: FloatArray, others: FloatArray) -> FloatArray:
    """(m,) radians between vectors (m, 3)."""
    cosines = (some * others).sum(axis=1) / np.linalg.norm(some, axis=1) / np.linalg.norm(others, axis=1)
    return np.asarray(np.arccos(np.clip(cosines, -1, 1)))


def test_samples_lie_densely_on_the_surface_and_have_its_colours() -> None:
    corners = np.array([[0.0, 0, 0], [3, 0, 0], [0, 2, 0], [3, 2, 1]])
    scan = Scan(name="two", points=corners, triangles=np.array([[0, 1, 2], [1, 3, 2]]), colors=corners / 4)
    samples = scan_samples(scan, AS_IT_IS, np.full(3, -9.0), np.full(3, 9.0), 0.1)
    np.testing.assert_allclose(samples.colors, samples.points / 4, atol=1e-6)
    distances = cKDTree(samples.points).query(samples.points, k=2)[0][:, 1]
    assert distances.min() > 0
    assert distances.max() < 0.1
    whole = np.linalg.norm(np.cross([3, 0, 0], [0, 2, 0])) / 2
    first = samples.points[:, 2] == 0
    np.testing.assert_allclose(samples.points[first].mean(axis=0), corners[:3].mean(axis=0), atol=1e-9)
    assert first.sum() == pytest.approx(2 * whole / 0.1**2, rel=2)


def test_a_template_is_dressed_in_what_the_database_lacks(dressed: FaceParts) -> None:
    template = Template.of(dressed, "template")
    body = template.body(Topology.of(make(0)))
    assert {mesh.name for mesh in dressed.meshes} - set(body.topology.names) == {"Hair", "Brows", "Lashes"}
    way = np.array([3.0, -8, 5])
    moved = template.dressed(body, body.points + way)  # all goes with the skin
    np.testing.assert_allclose(moved, template.points + way, atol=1e-6)
    shapes = template.dressed_shapes(body, {"eyeBlinkLeft": np.ones_like(body.points)})
    own = whole_face(dressed, "template").deltas["eyeBlinkLeft"]
    known = (shapes["eyeBlinkLeft"] == 1).all(axis=1)
    assert known.sum() == len(body.points)
    np.testing.assert_array_equal(shapes["eyeBlinkLeft"][~known], own[~known])
    with pytest.raises(TopologyError, match="other meshes or faces than the database has"):
        body.body(template.topology)


@pytest.mark.slow
def test_one_command_makes_a_ready_head_of_a_scan_and_its_glb_is_valid(tmp_path: Path, capsys: Capsys) -> None:
    actor = Actor(tmp_path, make)
    people = (partial(whole_face, make(seed), f"{seed}") for seed in (1, 2, 3, 4))
    save_database(create_database(list(people)).database, tmp_path / "faces.fpdb")
    save_parts(make(0, textures=SIZE), tmp_path / "head.usda")
    save_parts(actor.person, tmp_path / "anna.usda")
    mesh = actor.person.meshes[0]
    marks = ScanLandmarks(points=np.asarray(mesh.points)[mesh.landmarks["multipie68"].indices])
    write_scan_landmarks(marks, tmp_path / "anna.landmarks.json")
    given = ("--template", tmp_path / "head.usda", "--database", tmp_path / "faces.fpdb", "--even", 0)
    out, glb = tmp_path / "fitted.usda", tmp_path / "fitted.glb"
    assert run(capsys, "fit-neutral", tmp_path / "anna.usda", *given, "-o", out)[0] < 2  # 1: few people, a lax fit
    done(capsys, "export", out, "-o", glb, quiet=False)
    fitted = facepipe.open(out).parts()
    (color,) = (material.diffuse_color for material in fitted.materials if material.name == "M_Face")
    assert isinstance(color, TextureInput)
    assert color.texture.name == "skin_face_scan.jpg"
    skin = skin_of(fitted, whole_points(fitted), None)
    baked = ScanTextures(pictures=tuple(pictures_of(skin)), coverage=1.0, light=0.0)
    assert (
        np.abs(off(actor, baked, skin.outside & (inner(skin) > 0.5))).mean() < 0.03
    )  # points slide, colours with them
    lids = fitted.meshes[0].points[np.asarray(fitted.meshes[0].landmarks["multipie68"].indices)[36:48]]
    for name, corners in (("EyeballRight", lids[:6]), ("EyeballLeft", lids[6:])):
        (ball,) = (mesh.points for mesh in fitted.meshes if mesh.name == name)
        assert np.linalg.norm(ball.mean(axis=0) - corners.mean(axis=0)) < 1.6  # cm: behind its lids
    assert {mesh.name for mesh in fitted.meshes} >= {"Teeth", "Lashes", "Hair"}
    assert len(fitted.skeleton.joints) == 44
    (report,) = validate([glb]).values()  # the Khronos validator's
    assert report["issues"]["numErrors"] == report["issues"]["numWarnings"] == 0
