"""The rendered world against analytic spheres and ray casting."""

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh

from facerelight.bootstrap.dataset import BootstrapDataset, open_renderer
from facerelight.bootstrap.domain import Domain, Material
from facerelight.bootstrap.effects import EFFECTS, Scene, highlight, highlight_reach
from facerelight.bootstrap.heads import Head, MakeHumanHeads
from facerelight.bootstrap.heads.meshes import MeshFolder
from facerelight.bootstrap.look.skin import Look
from facerelight.bootstrap.posture import PIVOT, place_in_frame, rotate, stand
from facerelight.bootstrap.renderer import MeshRenderer
from facerelight.bootstrap.shading import plan_effects, shade
from facerelight.bootstrap.surface import view_surface
from facerelight.geometry.alignment import CropFrame
from facerelight.geometry.lights import even_hemisphere, light_from_angles

FRAME = CropFrame(64, 56, 0.25)


def sphere_surface(renderer: MeshRenderer):
    mesh = trimesh.creation.icosphere(5, radius=20)
    zeros = np.zeros(len(mesh.vertices), np.float32)
    head = Head(mesh.vertices, mesh.faces, np.array(mesh.vertices) / 20 + (0, 0, 5), zeros, np.zeros((3, 3)))
    look = Look.random(np.random.default_rng(0), Domain(texture=0.0))
    return view_surface(renderer, head, look)


@pytest.fixture(scope="module")
def dataset() -> BootstrapDataset:
    return BootstrapDataset(MakeHumanHeads(0), 5, even_hemisphere(40), CropFrame(96, 84, 0.25))


def test_normals_of_a_sphere() -> None:
    with MeshRenderer(64, 64, extent=40) as renderer:
        surface = sphere_surface(renderer)
    exact = torch.nn.functional.normalize(surface.position, dim=-1)
    angle = torch.rad2deg(torch.acos((surface.normal * exact).sum(-1).clamp(-1, 1)))
    assert abs(len(surface.pixel) - np.pi * 400) < 20
    assert angle.median() < 0.1
    assert (surface.position.norm(dim=-1) - 20).abs().max() < 0.1


def test_a_sphere_has_attached_shadow_only() -> None:
    light = light_from_angles(60.0, 20.0)
    with MeshRenderer(64, 64, extent=40) as renderer:
        surface = sphere_surface(renderer)
        matte = Material(specular=0.0, roughness=0.3, fill=0.0)
        work: Counter[str] = Counter()
        image = shade(surface, light, matte, plan_effects(surface, light, matte, "all"), renderer, work)
    expected = surface.albedo * (surface.normal @ light).clamp_min(0)
    assert (image.flatten()[surface.pixel] - expected).abs().max() < 1e-3


def test_scenes_run_only_the_passes_they_call_for() -> None:
    frontal, side = torch.tensor([0.0, 0.0, 1.0]), light_from_angles(60.0, 0.0)
    with MeshRenderer(64, 64, extent=40) as renderer:
        surface = sphere_surface(renderer)
        shiny, matte = Material(0.05, 0.3, 0.1), Material(0.0, 0.3, 0.0)
        assert plan_effects(surface, frontal, matte).effects <= {"attached"}
        assert plan_effects(surface, side, matte).effects == {"attached", "cast"} - (
            {"cast"} if not EFFECTS["cast"].where(Scene(surface, side, matte)).any() else set()
        )
        assert {"specular", "ambient"} <= plan_effects(surface, side, shiny).effects
        work: Counter[str] = Counter()
        for light in (frontal, side):
            shade(surface, light, matte, plan_effects(surface, light, matte), renderer, work)
        assert work["specular passes run"] == work["ambient passes run"] == 0
        assert work["specular passes skipped"] == 2
        assert work["cast passes skipped"] >= 1
        forced = plan_effects(surface, side, matte, ["specular"])
        assert forced.effects == {"specular"}
        with pytest.raises(ValueError, match="choose 'auto', 'all'"):
            plan_effects(surface, side, matte, "glow")


@pytest.mark.parametrize("shape", ["fin", "wire", "ribbon"])
@pytest.mark.parametrize("shift", [0.0, 0.11, 0.21])
def test_the_plan_sees_occluders_a_third_of_a_pixel_thin(shape: str, shift: float) -> None:
    """On a mesh of the user's own: thinner than what the plan's depth pass samples, not than the shadow's own map."""
    sizes = {"fin": (0.33, 10, 6), "wire": (0.33, 0.33, 6), "ribbon": (0.33, 14, 0.02)}
    height = {"fin": 20.5, "wire": 21.5, "ribbon": 23.0}[shape]
    thin = trimesh.creation.box(sizes[shape])
    thin.apply_translation((3 + shift, 0.17, height))
    mesh = trimesh.util.concatenate([trimesh.creation.icosphere(5, radius=20), thin])
    zeros = np.zeros(len(mesh.vertices), np.float32)
    head = Head(mesh.vertices, mesh.faces, np.array(mesh.vertices) / 20 + (0, 0, 5), zeros, np.zeros((3, 3)))
    matte = Material(specular=0.0, roughness=0.3, fill=0.0)
    shadowed = 0
    with MeshRenderer(64, 64, extent=140) as renderer:
        surface = view_surface(renderer, head, Look.random(np.random.default_rng(0), Domain(texture=0.0)))
        for light in even_hemisphere(8):
            auto, full = (
                shade(surface, light, matte, plan_effects(surface, light, matte, effects), renderer)
                for effects in ("auto", "all")
            )
            assert (auto - full).abs().max() < 1e-4
            plain = shade(surface, light, matte, plan_effects(surface, light, matte, ["attached"]), renderer)
            shadowed += int((plain - full > 0.05).sum())
    assert shadowed > 0


def test_auto_equals_all(dataset: BootstrapDataset) -> None:
    everything = BootstrapDataset(dataset.source, 5, dataset.lights, dataset.frame, effects="all")
    run: Counter[str] = Counter()
    for index in range(2):
        auto, full = dataset[index], everything[index]
        assert (auto.images - full.images).abs().max() < 1e-5
        run.update(auto.work)
        assert all(full.work[f"{effect} passes run"] == 40 for effect in EFFECTS)
    assert run["cast pixels skipped"] > 0.2 * run["cast pixels run"]
    assert run["specular pixels skipped"] > 0
    everything.close()


def test_shadows_match_ray_casting(dataset: BootstrapDataset) -> None:
    """Light through the shadow map against rays through the mesh, on a head; pixels at the edge of the surface count
    too."""
    pytest.importorskip("embreex", reason="ray casting needs embreex")
    head = place_in_frame(dataset.source.head(1), dataset.frame)
    mesh = trimesh.Trimesh(head.vertices, head.triangles, process=False)
    matte = Material(0.0, 0.3, 0.0)
    look = Look.random(np.random.default_rng(1), Domain())
    with open_renderer(dataset.frame) as renderer:
        surface = view_surface(renderer, head, look)
        for azimuth, elevation in ((50, 0), (-35, 30), (20, -40), (75, 10)):
            light = light_from_angles(float(azimuth), float(elevation))
            image = shade(surface, light, matte, plan_effects(surface, light, matte), renderer).flatten()[surface.pixel]
            facing = (surface.normal @ light).clamp_min(0)
            seen = image / (surface.albedo * facing).clamp_min(1e-6)
            lit = facing > 0.1
            start = (surface.position + 0.6 * light)[lit]
            blocked = mesh.ray.intersects_any(start.numpy(), np.repeat(light.numpy()[None], len(start), 0))
            agree = (seen[lit] < 0.5) == torch.from_numpy(blocked)
            assert agree.float().mean() > 0.97


def test_light_comes_from_where_the_convention_says(dataset: BootstrapDataset) -> None:
    left, right, above, below = (
        dataset_image(dataset, azimuth, elevation) for azimuth, elevation in ((60, 0), (-60, 0), (0, 60), (0, -60))
    )
    columns, rows = left.shape[1] // 2, left.shape[0] // 2
    assert left[:, :columns].mean() > 1.5 * left[:, columns:].mean()
    assert right[:, columns:].mean() > 1.5 * right[:, :columns].mean()
    assert above[:rows].mean() > below[:rows].mean()


def dataset_image(dataset: BootstrapDataset, azimuth: float, elevation: float) -> torch.Tensor:
    one = BootstrapDataset(dataset.source, 1, light_from_angles(float(azimuth), float(elevation))[None], dataset.frame)
    image = one[0].images[0]
    one.close()
    return image


def test_heads_are_seeded_and_aligned() -> None:
    source = MakeHumanHeads(3)
    first, again, other = source.head(4), MakeHumanHeads(3).head(4), source.head(5)
    assert np.array_equal(first.vertices, again.vertices)
    assert not np.allclose(first.vertices, other.vertices)
    assert np.allclose(first.landmarks[:2].mean(0), 0, atol=1e-6)
    placed = place_in_frame(first, FRAME)
    centre = ((FRAME.width - 1) / 2, (FRAME.height - 1) / 2)
    pixels = placed.landmarks[:, :2] * (1, -1) + centre
    assert np.abs(pixels - FRAME.landmarks.numpy()).max() < 2.5
    turned = rotate(first, 30, 0)
    assert turned.landmarks[0, 2] > turned.landmarks[1, 2]  # the eye at image-left has come nearer


def test_expressions() -> None:
    source = MakeHumanHeads(0)
    assert len(source.expressions) == 52
    moved = MakeHumanHeads(0, expression={source.expressions[0]: 1.0}).head(0)
    assert not np.allclose(moved.vertices, source.head(0).vertices)
    with pytest.raises(ValueError, match="choose from"):
        MakeHumanHeads(0, expression={"frown hard": 1.0})


def test_meshes_of_the_users_own(tmp_path) -> None:
    """A head exported turned and scaled comes back in place."""
    head = MakeHumanHeads(0).head(0)
    points = np.vstack((head.landmarks, head.vertices[:5]))
    for name, scale in (("a", 1.0), ("b", 3.0)):
        turn = trimesh.transformations.rotation_matrix(0.4 * scale, (0, 1, 0))[:3, :3]
        trimesh.Trimesh(scale * head.vertices @ turn.T + 7, head.triangles, process=False).export(
            tmp_path / f"{name}.ply"
        )
        np.savetxt(tmp_path / f"{name}.points.txt", scale * points @ turn.T + 7)
    source = MeshFolder(tmp_path)
    assert len(source) == 2
    assert np.allclose(source.head(0).vertices, source.head(1).vertices, atol=1e-3)
    (tmp_path / "b.points.txt").write_text("1 2 3\n")
    with pytest.raises(ValueError, match="three or more"):
        MeshFolder(tmp_path).head(1)
    with pytest.raises(ValueError, match="found none"):
        MeshFolder(tmp_path / "nothing")


def test_least_squares_normals_follow_the_mesh(dataset: BootstrapDataset) -> None:
    """Footnote 2 of 4.2.1: n fitted to rendered images points where the mesh's normals do, but for shadows and
    highlights."""
    surface, _ = dataset.surface(0)
    images = dataset[0].images.flatten(1)[:, surface.pixel]
    fitted = torch.linalg.lstsq(dataset.lights, images).solution.T
    cosine = (torch.nn.functional.normalize(fitted, dim=-1) * surface.normal).sum(-1).clamp(-1, 1)
    front = surface.normal[:, 2] > 0.5
    assert torch.rad2deg(torch.acos(cosine[front])).median() < 15


def test_the_highlight_is_torrance_and_sparrow() -> None:
    """Against the formula written out pixel by pixel in float64, and nowhere visible where the plan says it cannot
    be."""
    generator = torch.Generator().manual_seed(0)
    normal = torch.nn.functional.normalize(
        torch.randn(500, 3, generator=generator) * torch.tensor((1.0, 1.0, 0.5)), dim=1
    )
    normal[:, 2] = normal[:, 2].abs()
    skin = Material(specular=0.05, roughness=0.35, fill=0.0)
    for azimuth, elevation in ((0.0, 0.0), (60.0, 10.0), (-100.0, 20.0)):
        light = light_from_angles(azimuth, elevation)
        half = (light + torch.tensor((0.0, 0.0, 1.0))).double()
        half = half / half.norm()
        got = highlight(normal, light, skin)
        for n, value in zip(normal.double(), got, strict=True):
            nh, nl, nv, vh = (
                max(float(n @ half), 1e-3),
                max(float(n @ light.double()), 0.0),
                max(float(n[2]), 0.05),
                float(half[2]),
            )
            beckmann = np.exp(-(1 / nh**2 - 1) / 0.35**2) / (
                0.35**2 * nh**4
            )  # times pi, as the white surface's radiance is
            fresnel = 0.05 / 0.028 * (0.028 + (1 - 0.028) * (1 - vh) ** 5)
            grooves = min(1.0, 2 * nh * nv / vh, 2 * nh * nl / vh)
            assert abs(float(value) - fresnel * beckmann * grooves / (4 * nv)) < 1e-4 * max(1.0, float(value))
        beyond = normal @ half.float() <= highlight_reach(skin)
        assert beyond.any()
        assert got[beyond].max() < 1e-6


def test_heads_stand_as_the_domain_says() -> None:
    upright = MakeHumanHeads(0).head(0)
    exact = Domain(pitch=0.0, turn=0.0, misalign=0.0)
    assert np.allclose(stand(upright, np.random.default_rng(0), exact).vertices, upright.vertices)
    up = stand(upright, np.random.default_rng(0), replace(exact, pitch=10.0))
    nose = upright.vertices[:, 2].argmax()
    assert up.vertices[nose, 1] > upright.vertices[nose, 1]  # who looks up lifts the nose
    several = [stand(upright, np.random.default_rng(i), replace(exact, turn=5.0, misalign=0.05)) for i in range(200)]
    sideways = np.rad2deg(
        [np.arcsin(np.clip((h.vertices[nose, 0]) / (upright.vertices[nose, 2] - PIVOT[2]), -1, 1)) for h in several]
    )
    assert 3.5 < sideways.std() < 5.5
    marks = np.stack([h.landmarks for h in several]) - np.stack([rotate_back(h, upright) for h in several])
    assert 0.04 < marks[..., :2].std() < 0.06
    assert np.abs(marks[..., 2]).max() < 1e-6


def rotate_back(turned: Head, upright: Head) -> np.ndarray:
    """Where a turned head's landmarks truly are, by the rotation that its vertices went through."""
    a, b = upright.vertices - PIVOT, turned.vertices - PIVOT
    u, _, vt = np.linalg.svd(b.T @ a)
    return (upright.landmarks - PIVOT) @ (u @ vt).T + PIVOT
