"""Ground truth for portraits: a scanned head with painted hair and shirt, ray traced under known lamps.

Light adds up and skin scales it channel by channel, so what a lamp does is kept apart from albedo: irradiance by
channel and the highlight, worked out once for each lamp and turn of the head, and kept on disk.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import platformdirs

from facerelight.geometry.lights import even_hemisphere, light_from_angles
from facerelight.geometry.sources import Lamp
from facerelight.model.file import replacing

__all__ = ["HEIGHT", "TONES", "WIDTH", "LampImage", "ScannedHead", "decode_srgb", "encode_srgb", "lamp_points"]

WIDTH, HEIGHT = 560, 640  # pixels of the picture
UNITS = 8.1 / HEIGHT  # of the scan, a pixel
TOP = 4.35  # of the picture, in units of the scan
TONES = {"fair": (1.0, 1.0, 1.0), "tan": (0.62, 0.50, 0.42), "deep": (0.30, 0.20, 0.15)}
EYES_AND_MOUTH = np.array([[222.5, 207.0], [320.5, 207.0], [272.0, 306.0]])  # pixels, at yaw 0
HAIR, SHIRT = (0.045, 0.028, 0.018), (0.12, 0.18, 0.34)
BLEEDING = ((3.2, 0.55), (1.6, 0.35), (1.0, 0.25))  # of red, green, blue in skin: sigma in pixels, share that spreads
ROUGHNESS, REFLECTANCE = 0.35, 0.04
FILL_STRENGTH = 1.9
VERSION = 1  # of what is kept on disk


def decode_srgb(coded: np.ndarray) -> np.ndarray:
    """Linear float32 of sRGB values in 0..1."""
    return np.where(coded <= 0.04045, coded / 12.92, ((coded + 0.055) / 1.055) ** 2.4).astype(np.float32)


def encode_srgb(linear: np.ndarray) -> np.ndarray:
    """sRGB values in 0..1 of linear ones, float32."""
    linear = np.clip(linear, 0, 1)
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055).astype(np.float32)


def lamp_points(lamp: Lamp) -> np.ndarray:
    """A lamp's disc as ``(n, 3)`` unit vectors of equal weight, spread on the plane that touches the sphere there.

    Kept apart from :meth:`Lamp.light`, so that the truth stays the same whatever the package does.
    """
    count = 1 if lamp.size < 2 else 7 if lamp.size < 8 else 13 if lamp.size < 25 else 24
    towards = light_from_angles(float(lamp.azimuth), float(lamp.elevation)).numpy().astype(np.float64)
    across = np.cross([0.0, 1.0, 0.0] if abs(towards[1]) < 0.95 else [1.0, 0.0, 0.0], towards)
    across /= np.linalg.norm(across)
    along = np.cross(towards, across)
    index = np.arange(count)
    radius = np.tan(np.deg2rad(lamp.size)) * np.sqrt((index + 0.5) / count) * (count > 1)
    turn = index * math.pi * (3 - math.sqrt(5))
    points = towards + radius[:, None] * (np.cos(turn)[:, None] * across + np.sin(turn)[:, None] * along)
    return points / np.linalg.norm(points, axis=1, keepdims=True)


class LampImage(NamedTuple):
    """The head under a light of strength 1, on its ``P`` pixels: ``irradiance (P, 3)`` by channel, as skin or hair
    receives it, and ``highlight (P,)``; ``lit (P,)`` bool: which pixels the first direction of the light reaches."""

    irradiance: np.ndarray
    highlight: np.ndarray
    lit: np.ndarray


class ScannedHead:
    """Lee Perry-Smith's head, turned by ``yaw``, under any lamps.

    Args:
        folder: with ``lps_head.npz`` (``vertices (V, 3)``, ``triangles (T, 3)``, ``uv (V, 2)``) and ``color.jpg``.
        yaw: degrees by which the head turns.
        cache: where traced light is kept; default: in the user's cache.

    Raises:
        FileNotFoundError: the folder lacks a file.
    """

    def __init__(self, folder: str | Path, yaw: float = 0.0, cache: str | Path | None = None) -> None:
        self.folder, self.yaw = Path(folder), float(yaw)
        digest = hashlib.sha256()
        for name in ("lps_head.npz", "color.jpg"):
            if not (self.folder / name).is_file():
                raise FileNotFoundError(f"{self.folder}: expected the scan's lps_head.npz and color.jpg, got no {name}")
            digest.update((self.folder / name).read_bytes())
        self._key = f"{VERSION} {digest.hexdigest()} {self.yaw:.4f}"
        self._cache = Path(cache) if cache else platformdirs.user_cache_path("facerelight") / "portrait"
        angle = np.deg2rad(self.yaw)
        cos, sin = np.cos(angle), np.sin(angle)
        self._turn = np.array([[cos, 0, sin], [0, 1, 0], [-sin, 0, cos]])
        self._seen: dict[str, LampImage] = {}
        surface = self._kept("surface", self._trace_surface)
        self.pixels: np.ndarray = surface["pixels"]  # (P,) index in the picture
        self.place, self.normal, self.facet = surface["place"], surface["normal"], surface["facet"]  # (P, 3) each
        self.landmarks: np.ndarray = surface["landmarks"]  # (3, 2) pixels
        self._colour: np.ndarray = surface["colour"]  # (P, 3) linear, of the scan's own skin
        self._paint()

    # -- what is kept on disk -----------------------------------------------------------------------------------------
    def _kept(self, what: str, make: Callable[[], dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
        """``make()``, or what it gave in an earlier run."""
        name = hashlib.sha256(f"{self._key} {what}".encode()).hexdigest()[:16]
        path = self._cache / f"{name}.npz"
        if path.is_file():
            with np.load(path) as stored:
                return {key: stored[key] for key in stored.files}
        arrays = make()
        path.parent.mkdir(parents=True, exist_ok=True)
        with replacing(path) as partial, partial.open("wb") as file:
            np.savez(file, **arrays)  # type: ignore[arg-type]
        return arrays

    @cached_property
    def _mesh(self) -> Any:
        import trimesh

        with np.load(self.folder / "lps_head.npz") as scan:
            vertices, triangles, self._uv = scan["vertices"].astype(float), scan["triangles"], scan["uv"].astype(float)
        return trimesh.Trimesh(vertices @ self._turn.T, triangles, process=False)

    # -- surface ------------------------------------------------------------------------------------------------------
    def _trace_surface(self) -> dict[str, np.ndarray]:
        """What each pixel sees, and where the three landmarks are."""
        import trimesh
        from PIL import Image
        from scipy.ndimage import map_coordinates

        mesh = self._mesh
        vertex_normals, triangles = np.array(mesh.vertex_normals), mesh.faces
        x = (np.arange(WIDTH) + 0.5) * UNITS - WIDTH * UNITS / 2
        y = (np.arange(HEIGHT) + 0.5) * -UNITS + TOP
        across, up = np.meshgrid(x, y)
        place, pixels, triangle = _towards_head(mesh, across.ravel(), up.ravel())
        corners = trimesh.triangles.points_to_barycentric(mesh.triangles[triangle], place)[..., None]  # (P, 3, 1)
        normal = (vertex_normals[triangles[triangle]] * corners).sum(1)
        uv = (self._uv[triangles[triangle]] * corners).sum(1)
        skin = decode_srgb(np.asarray(Image.open(self.folder / "color.jpg").convert("RGB")).astype(np.float32) / 255)
        at = [(1 - uv[:, 1]) * skin.shape[0] - 0.5, uv[:, 0] * skin.shape[1] - 0.5]
        return {
            "pixels": pixels,
            "place": place,
            "normal": normal / np.linalg.norm(normal, axis=1, keepdims=True),
            "facet": mesh.face_normals[triangle],
            "colour": np.stack([map_coordinates(skin[..., c], at, order=1, mode="nearest") for c in range(3)], -1),
            "landmarks": self._turned_landmarks(),
        }

    def _turned_landmarks(self) -> np.ndarray:
        """The landmarks of the head that looks at the camera, put on the mesh and turned with it; ``(3, 2)`` pixels."""
        import trimesh

        frontal = trimesh.Trimesh(self._mesh.vertices @ self._turn, self._mesh.faces, process=False)
        x = (EYES_AND_MOUTH[:, 0] + 0.5) * UNITS - WIDTH * UNITS / 2
        found, ray, _ = _towards_head(frontal, x, (EYES_AND_MOUTH[:, 1] + 0.5) * -UNITS + TOP)
        points = np.empty((3, 3))
        points[ray] = found
        points = points @ self._turn.T
        return np.stack([(points[:, 0] + WIDTH * UNITS / 2) / UNITS - 0.5, (TOP - points[:, 1]) / UNITS - 0.5], -1)

    def _paint(self) -> None:
        """Hair and a shirt, which the scan lacks: how much of each a pixel shows, and how bright each hair is."""
        x, y, z = (self.place @ self._turn).T  # of the head that looks at the camera
        line = 2.85 - 0.45 * (x / 1.2) ** 2
        top = 1 / (1 + np.exp(-(y - line) / 0.05))
        side = 1 / (1 + np.exp((z - 0.25) / 0.06)) * (y > 0.9)
        ear = (np.abs(x) > 1.75) & (y < 1.2)
        self.hair = np.maximum(top, side * ~ear) * (y > 0.4)  # (P,)
        self.shirt = 1 / (1 + np.exp((y + 2.35 - 0.18 * np.abs(x)) / 0.03))  # (P,)
        noise = np.random.default_rng(0).standard_normal(len(x))
        self._strands = (1 + 0.21 * np.sin(60 * x + 9 * np.sin(7 * y)) + 0.25 * noise).clip(0.3, 2)

    def albedo(self, tone: str) -> np.ndarray:
        """Diffuse reflectance, ``(P, 3)`` linear, of one of :data:`TONES`."""
        if tone not in TONES:
            raise ValueError(f"tone: expected one of {', '.join(TONES)}, got {tone!r}")
        albedo = self._colour * np.array(TONES[tone]) * 1.15
        for share, paint in ((self.hair, self._strands[:, None] * np.array(HAIR)), (self.shirt, np.array(SHIRT))):
            albedo = albedo * (1 - share[:, None]) + share[:, None] * paint
        return albedo

    def picture(self, values: np.ndarray) -> np.ndarray:
        """Values of the head's pixels, ``(P, ...)``, on the picture, ``(HEIGHT, WIDTH, ...)``; 0 or False around it."""
        out = np.zeros((HEIGHT * WIDTH, *values.shape[1:]), bool if values.dtype == bool else np.float32)
        out[self.pixels] = values
        return out.reshape(HEIGHT, WIDTH, *values.shape[1:])

    # -- light --------------------------------------------------------------------------------------------------------
    def lamp(self, lamp: Lamp) -> LampImage:
        """The head under a lamp, as if of power 1 and white."""
        what = f"lamp {lamp.azimuth:.4f} {lamp.elevation:.4f} {lamp.size:.4f}"
        points = lamp_points(lamp)
        return self._light(what, points, np.full(len(points), 1 / len(points)))

    def dome(self) -> LampImage:
        """The head under light from all around, brighter above, as strong on the face as a lamp at the camera."""
        points = even_hemisphere(24).numpy().astype(np.float64)
        weights = 0.6 + 0.4 * points[:, 1]
        return self._light("dome", points, FILL_STRENGTH * weights / weights.sum())

    def radiance(self, albedo: np.ndarray, lamps: Sequence[Lamp], fill: float) -> np.ndarray:
        """Linear RGB of the picture under white ``lamps`` at ``1 - fill`` of their power and a dome at ``fill``."""
        parts = [(self.lamp(lamp), (1 - fill) * lamp.power) for lamp in lamps]
        if fill > 0:
            parts.append((self.dome(), fill))
        diffuse = sum(weight * image.irradiance for image, weight in parts)
        highlight = sum(weight * image.highlight for image, weight in parts)
        return self.picture(albedo * diffuse + np.asarray(highlight)[:, None])

    def _light(self, what: str, points: np.ndarray, weights: np.ndarray) -> LampImage:
        def trace() -> dict[str, np.ndarray]:
            irradiance: Any = 0.0
            highlight: Any = 0.0
            for direction, weight in zip(points, weights, strict=True):
                one = self._trace(direction)
                irradiance, highlight = irradiance + weight * one.irradiance, highlight + weight * one.highlight
            lit = self._trace(points[0]).lit if len(points) > 1 else one.lit
            return {"irradiance": irradiance.astype(np.float16), "highlight": highlight.astype(np.float16), "lit": lit}

        if what not in self._seen:
            kept = self._kept(what, trace)
            irradiance, highlight = (kept[name].astype(np.float32) for name in ("irradiance", "highlight"))
            self._seen[what] = LampImage(irradiance, highlight, kept["lit"])
        return self._seen[what]

    def _trace(self, light: np.ndarray) -> LampImage:
        """The head under one distant point: cast shadows, light spread in skin, Torrance and Sparrow's highlight."""
        towards = self.facet @ light
        start = self.place + self.facet * (4e-3 * np.sign(towards))[:, None]
        blocked = self._mesh.ray.intersects_any(start, np.tile(light, (len(start), 1)))
        lit = ~blocked & (towards > 0)
        cosine = (self.normal @ light).clip(0)
        plain = cosine * lit
        image, there = self.picture(plain), self.picture(np.ones(len(plain)))
        spread = []
        for sigma, share in BLEEDING:
            inside = np.maximum(cv2.GaussianBlur(there, (0, 0), sigma), 1e-3)
            blurred = cv2.GaussianBlur(image, (0, 0), sigma) / inside
            spread.append(((1 - share) * image + share * blurred).ravel()[self.pixels])
        skin = 1 - np.maximum(self.hair, self.shirt)
        irradiance = skin[:, None] * np.stack(spread, -1) + (1 - skin[:, None]) * plain[:, None]
        half = light + np.array([0.0, 0.0, 1.0])
        half /= np.linalg.norm(half)
        off, view = (self.normal @ half).clip(1e-3), self.normal[:, 2]
        facets = np.exp(-(off**-2 - 1) / ROUGHNESS**2) / (ROUGHNESS**2 * off**4)  # Beckmann
        mirror = REFLECTANCE + (1 - REFLECTANCE) * (1 - half[2]) ** 5  # Schlick
        shadowing = np.minimum(1, 2 * off * np.minimum(cosine, view.clip(0.05)) / max(half[2], 0.1))
        highlight = mirror * facets / (4 * view.clip(0.1)) * shadowing * lit * (skin + 0.6 * self.hair) * 0.9
        return LampImage(irradiance, highlight, lit)


def _towards_head(mesh: Any, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Where rays along the camera's axis through ``x, y (N,)`` first meet the mesh: places (P, 3), ray, triangle."""
    start = np.stack([x, y, np.full_like(x, 10.0)], -1)
    down = np.tile([0.0, 0.0, -1.0], (len(start), 1))
    place, ray, triangle = mesh.ray.intersects_location(start, down, multiple_hits=False)
    return place, ray, triangle
