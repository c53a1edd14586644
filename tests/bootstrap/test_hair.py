"""Hair in volume: where it may be, where it must not, and what it does to light."""

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
import torch

from facerelight.bootstrap.dataset import BootstrapDataset, open_renderer
from facerelight.bootstrap.domain import Domain, Material
from facerelight.bootstrap.heads import Head, IctHeads, MakeHumanHeads
from facerelight.bootstrap.heads.meshes import MeshFolder
from facerelight.bootstrap.look.hair import BALD, SIDES, Hairstyle, hair_depth, tint
from facerelight.bootstrap.look.scalp import Scalp, grow_hair
from facerelight.bootstrap.look.skin import Look
from facerelight.bootstrap.posture import place_in_frame
from facerelight.bootstrap.shading import plan_effects, shade
from facerelight.bootstrap.surface import view_surface
from facerelight.geometry.alignment import CropFrame
from facerelight.geometry.lights import even_hemisphere, light_from_angles

FRAME = CropFrame(96, 84, 0.25)
LOOK = Look.random(np.random.default_rng(0), Domain())
NAPE = ((130.0, -1.0), (180.0, -1.2))
FRINGE = Hairstyle(
    ((0, 0.5), (44, 0.45), *SIDES[2:], *NAPE),
    0.18,
    0.1,
    ragged=0.05,
    overhang=0.8,
    beard=0.08,
    moustache=0.04,
    brows=0.03,
    seed=4,
)
LONG = Hairstyle(((0, 1.0), (40, 1.0), (58, 0.7), (64, 0.3), (66, -0.3), (65, -3.0)), 0.2, hem=-2.0, seed=5)
SOURCES = {"ict": IctHeads(None, 0), "makehuman": MakeHumanHeads(0)}


@pytest.fixture(scope="module")
def scalps() -> dict[str, Scalp]:
    return {name: Scalp.fit(source.head(0)) for name, source in SOURCES.items()}


def seen(head: Head) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Depth (mesh units), reference and ``is_eye`` that the camera sees, NaN where nothing is; the placed head."""
    placed = place_in_frame(head, FRAME, head.landmarks)
    with open_renderer(FRAME) as renderer:
        features = np.concatenate((placed.reference, placed.is_eye[:, None]), 1)
        renderer.load(placed.vertices, placed.normals(), placed.triangles, features)
        geometry = renderer.geometry()
    depth = np.where(geometry.inside, geometry.position[..., 2], np.nan)
    return depth, geometry.attribute[..., :3], np.where(geometry.inside, geometry.attribute[..., 3], np.nan)


@pytest.mark.parametrize("name", SOURCES)
@pytest.mark.parametrize("style", [FRINGE, LONG], ids=["fringe", "long"])
def test_hair_lies_on_the_skin_and_leaves_the_eyes_free(name: str, style: Hairstyle, scalps: dict[str, Scalp]) -> None:
    bare = SOURCES[name].head(3)
    hairy = grow_hair(bare, scalps[name], replace(LOOK, style=style, brow_height=0.12, brow_width=0.09))
    skin, eyes = seen(bare)[::2]
    surface, reference, part = seen(hairy)
    pixel = np.linalg.norm(np.diff(FRAME.landmarks[:2].numpy(), axis=0))  # an eye distance
    both = ~np.isnan(skin)
    assert not np.isnan(surface[both]).any()  # no hole where skin was left out under hair
    assert (surface - skin)[both].min() > -0.02 * pixel
    assert np.array_equal(eyes > 0.5, part > 0.5)
    # wherever the surface stands out, it is painted as hair, but for a row of nodes at the rim
    raised = both & (surface - skin > 0.06 * pixel)
    points = torch.from_numpy(reference[raised])
    white = torch.ones(len(points))
    hangs = torch.from_numpy(-part[raised]).clamp_min(0)
    painted = tint(white, points, hangs, style, darkness=1.0)
    assert raised.sum() > 300
    assert (painted < 0.5).float().mean() > 0.97
    covered = both & (np.abs(surface - skin) < 1e-4) & (reference[..., 1] > -0.6)  # skin that is seen as before
    assert (hair_depth(torch.from_numpy(reference[covered]), style) < 0.1).float().mean() > 0.99


def test_bald_and_shaven_changes_nothing(scalps: dict[str, Scalp]) -> None:
    head = SOURCES["ict"].head(1)
    assert grow_hair(head, scalps["ict"], replace(LOOK, style=BALD)) is head
    albedo = torch.rand(5)
    assert torch.equal(tint(albedo, torch.randn(5, 3), torch.zeros(5), BALD, 0.5), albedo)
    shape = grow_hair(head, scalps["ict"], replace(LOOK, style=replace(BALD, beard=0.1)))
    assert np.array_equal(shape.triangles, head.triangles)
    moved = np.linalg.norm(shape.vertices - head.vertices, axis=1)
    assert 0.09 < moved.max() <= 0.1 + 1e-6  # eye distances
    assert moved[head.reference[:, 1] > 0].max() == 0
    assert moved[head.is_eye > 0.5].max() == 0
    lips = np.hypot(head.reference[:, 0] / 0.35, (head.reference[:, 1] + 1.1) / 0.1) < 1
    assert moved[lips & (head.reference[:, 2] > 0.2)].max() < 0.02


def test_styles_are_drawn_by_person_and_in_proportion() -> None:
    drawn = [Hairstyle.random(np.random.default_rng((0, index, 4))) for index in range(600)]
    assert drawn[7] == Hairstyle.random(np.random.default_rng((0, 7, 4)))
    share = {
        "bald": np.mean([not style.line for style in drawn]),
        "long": np.mean([style.hem is not None for style in drawn]),
        "beard": np.mean([style.beard > 0 for style in drawn]),
        "moustache alone": np.mean([style.moustache > 0 and not style.beard for style in drawn]),
        "fringe": np.mean([bool(style.line) and style.line[0][1] < 0.76 for style in drawn]),
    }
    expected = {"bald": 0.08, "long": 0.18, "beard": 0.11, "moustache alone": 0.035, "fringe": 0.165}
    assert all(abs(share[kind] - expected[kind]) < 0.03 for kind in expected), share
    dataset = BootstrapDataset(SOURCES["makehuman"], 2, even_hemisphere(3), FRAME)
    again = BootstrapDataset(SOURCES["makehuman"], 2, even_hemisphere(3), FRAME)
    assert dataset.look(1) == again.look(1)
    # the paint of the skin is drawn as it is without hair
    assert replace(dataset.look(1), style=BALD) == Look.random(np.random.default_rng((0, 1, 1)), Domain())
    assert torch.equal(dataset[1].images, again[1].images)
    dataset.close()
    again.close()


@pytest.mark.parametrize("name", SOURCES)
@pytest.mark.parametrize("style", [FRINGE, LONG], ids=["fringe", "long"])
def test_auto_equals_all_under_hair(name: str, style: Hairstyle, scalps: dict[str, Scalp]) -> None:
    look = replace(LOOK, style=style)
    head = grow_hair(SOURCES[name].head(2), scalps[name], look)
    run: Counter[str] = Counter()
    with open_renderer(FRAME) as renderer:
        surface = view_surface(renderer, place_in_frame(head, FRAME, head.landmarks), look)
        for light in even_hemisphere(24):
            auto = shade(surface, light, look.material, plan_effects(surface, light, look.material), renderer, run)
            full = shade(surface, light, look.material, plan_effects(surface, light, look.material, "all"), renderer)
            assert (auto - full).abs().max() < 1e-5
    assert run["cast pixels skipped"] > 0


@pytest.mark.parametrize("name", SOURCES)
def test_the_soft_edge_of_far_hair_is_no_surprise(name: str) -> None:
    """Under grazing light, hair a face's width away brushes rays that pass above it."""
    angles = ((0.858, 0.512, 0.021), (0.83, 0.557, 0.03), (0.755, 0.654, 0.05), (0.301, 0.953, 0.04))
    lights = torch.nn.functional.normalize(torch.tensor(angles), dim=1)
    dataset = BootstrapDataset(SOURCES[name], 1, lights, FRAME)
    assert dataset.look(0).style.hem is not None
    whole = BootstrapDataset(SOURCES[name], 1, lights, FRAME, effects="all")
    assert (dataset[0].images - whole[0].images).abs().max() < 1e-5
    dataset.close()
    whole.close()


@pytest.mark.parametrize("pose", [(45.0, 30.0), (0.0, 60.0), (-60.0, 40.0)])
def test_shoulders_may_lie_beyond_the_shadow_map(pose: tuple[float, float]) -> None:
    dataset = BootstrapDataset(SOURCES["ict"], 1, even_hemisphere(8), CropFrame(48, 42, 0.25), pose=pose)
    image = dataset[0].images
    assert image.isfinite().all()
    assert image.amax((1, 2)).min() > 0.05
    dataset.close()


def test_a_fringe_casts_a_shadow_on_the_forehead(scalps: dict[str, Scalp]) -> None:
    """Under a light from above, skin that is seen below the fringe lies in shadow, and is lit on the bald head."""
    light, matte = light_from_angles(0.0, 60.0), Material(0.0, 0.3, 0.0)
    light_seen, height = np.zeros((2, FRAME.height * FRAME.width)), np.full((2, FRAME.height * FRAME.width), np.nan)
    for k, style in enumerate((replace(FRINGE, brows=0.0), BALD)):
        look = replace(LOOK, style=style)
        head = grow_hair(SOURCES["ict"].head(0), scalps["ict"], look)
        with open_renderer(FRAME) as renderer:
            surface = view_surface(renderer, place_in_frame(head, FRAME, head.landmarks), look)
            image = shade(surface, light, matte, plan_effects(surface, light, matte), renderer).flatten()
        facing = (surface.albedo * (surface.normal @ light)).clamp_min(1e-3)
        light_seen[k, surface.pixel], height[k, surface.pixel] = image[surface.pixel] / facing, surface.position[:, 2]
    above = np.arange(FRAME.height * FRAME.width) // FRAME.width < float(FRAME.landmarks[0, 1]) - 8
    skin = above & (np.abs(height[0] - height[1]) < 1e-3) & (light_seen[1] > 0.9)
    assert skin.sum() > 200
    assert (light_seen[0][skin] < 0.5).sum() > 60  # a strip of about 40 x 3 pixels


def test_heads_of_the_users_own_keep_their_shape(tmp_path) -> None:
    import trimesh

    head = SOURCES["makehuman"].head(0)
    trimesh.Trimesh(head.vertices, head.triangles, process=False).export(tmp_path / "a.ply")
    np.savetxt(tmp_path / "a.points.txt", head.landmarks)
    own = MeshFolder(tmp_path)
    exact = Domain(pitch=0.0, turn=0.0, misalign=0.0)
    dataset = BootstrapDataset(own, 1, even_hemisphere(3), FRAME, exact)
    surface, _ = dataset.surface(0)
    placed = place_in_frame(own.head(0), FRAME)
    with open_renderer(FRAME) as renderer:
        expected = view_surface(renderer, placed, LOOK)
    assert torch.allclose(surface.position, expected.position, atol=1e-4)
    dataset.close()


def test_a_mesh_without_a_crown_is_refused() -> None:
    head = SOURCES["ict"].head(0)
    face = head._replace(triangles=head.triangles[(head.reference[head.triangles][..., 2] > -0.3).all(1)])
    with pytest.raises(ValueError, match="skin at the crown"):
        Scalp.fit(face)
