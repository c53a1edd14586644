"""What a training run is: heads, lights, crop, paint and how to fit; read from YAML and from command-line flags
alike."""

from __future__ import annotations

import hashlib
import json
import os
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Literal

import torch
from platformdirs import user_cache_path
from torch import Tensor

from facerelight import __version__
from facerelight.bootstrap.domain import Domain
from facerelight.geometry.alignment import CropFrame
from facerelight.geometry.lights import even_hemisphere, light_from_angles, merge_repeats, thesis_grid
from facerelight.model.file import FORMAT_VERSION
from facerelight.model.learning import FitOptions

__all__ = [
    "DEFAULT_CONFIG",
    "PACKAGED",
    "QUALITIES",
    "TrainConfig",
    "cache_folder",
    "default_statistics_folder",
    "find_statistics",
    "quality_config",
]

PACKAGED = Path(__file__).parent / "data" / "standard"
"""The statistics of :data:`DEFAULT_CONFIG` that the package brings; ``scripts/data/pack_statistics.py`` makes them."""


FIRST_RELEASE = "0.1"
SOURCES = ("ict", "makehuman")  # of heads that come with the package
MESH_FILES = (".obj", ".ply", ".glb", ".txt")  # meshes and their marked points


@dataclass(frozen=True)
class TrainConfig:
    """One training run.

    Args:
        heads: how many people to render.
        source: "ict" (scanned identities) or "makehuman" (people of morph targets), both of the package; a folder of
            meshes; or the path of ``ict_heads.npz``.
        lights: how many, spread evenly over the hemisphere; "paper" (the thesis's 10 x 10 angles and the frontal
            light); or a list of (azimuth, elevation) in degrees, such as the lights of a certain rig.
        height, width, margin: the crop; margin is a fraction of the canonical crop added on every side.
        supersample: rendered samples a pixel along each side.
        seed: of the heads and their paint.
        effects: "auto" simulates what each scene calls for, "all" everything; the images are the same.
        domain: the rendered world.
        choose_rank: choose the whole-face rank and temper by cross-validation over the rendered people, instead of
            taking those of ``fit``.
        fit: how statistics are learned.
    """

    heads: int = 80
    source: str = "ict"
    lights: int | Literal["paper"] | list[tuple[float, float]] = 64
    height: int = 128
    width: int = 112
    margin: float = 0.25
    supersample: int = 2
    seed: int = 0
    effects: Literal["auto", "all"] = "auto"
    choose_rank: bool = False
    domain: Domain = field(default_factory=Domain)
    fit: FitOptions = field(default_factory=lambda: FitOptions(face_rank=40, brightness=True))

    def __post_init__(self) -> None:
        least = {"heads": 2, "height": 16, "width": 16, "supersample": 1, "seed": 0}
        for name, smallest in least.items():
            value = getattr(self, name)
            if not isinstance(value, int) or value < smallest:
                raise ValueError(f"{name}: expected an integer of at least {smallest}, got {value!r}")
        listed = isinstance(self.lights, list) and len(self.lights) >= 4 and all(len(pair) == 2 for pair in self.lights)
        if self.lights != "paper" and not listed and (not isinstance(self.lights, int) or self.lights < 4):
            raise ValueError(f"lights: expected 'paper', at least 4, or as many pairs of angles, got {self.lights!r}")
        if not isinstance(self.margin, int | float) or not 0 <= self.margin <= 2:
            raise ValueError(f"margin: expected a fraction from 0 to 2, got {self.margin!r}")
        if self.effects not in ("auto", "all"):
            raise ValueError(f"effects: expected 'auto' or 'all', got {self.effects!r}")
        if not self.source:
            raise ValueError(
                "source: expected 'ict', 'makehuman', a folder of meshes or a path to ict_heads.npz, got nothing"
            )
        if not isinstance(self.domain, Domain) or not isinstance(self.fit, FitOptions):
            raise ValueError("domain, fit: expected mappings of options")

    @property
    def frame(self) -> CropFrame:
        """The crop that is rendered and relit."""
        return CropFrame(self.height, self.width, self.margin)

    def directions(self) -> Tensor:
        """Distinct bootstrap lights, ``(J, 3)``."""
        if isinstance(self.lights, list):
            angles = torch.tensor(self.lights, dtype=torch.float64)
            lights = light_from_angles(angles[:, 0], angles[:, 1]).float()
        else:
            lights = thesis_grid() if self.lights == "paper" else even_hemisphere(int(self.lights))
        return merge_repeats(lights)[0]

    def identity(self) -> dict[str, object]:
        """All that images and statistics of this config depend on: its fields, the meshes as they are on disk, and the
        package's minor version (patches change no picture; that of the first release goes without saying)."""
        fields: dict[str, object] = asdict(self)
        place = Path(self.source)
        if self.source not in SOURCES:
            files = sorted(p for p in place.glob("*") if p.suffix.lower() in MESH_FILES) if place.is_dir() else [place]
            sizes = [(p.name, p.stat().st_size, p.stat().st_mtime_ns) for p in files if p.is_file()]
            fields |= {"source": str(place.resolve()), "meshes": sizes}
        minor = __version__.rpartition(".")[0]
        return fields if minor == FIRST_RELEASE else {**fields, "version": minor}

    def key(self) -> str:
        """A short name that changes whenever the statistics would."""
        text = json.dumps([FORMAT_VERSION, self.identity()], sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()[:12]


DEFAULT_CONFIG = TrainConfig()
QUALITIES = {
    "draft": TrainConfig(
        heads=40, lights=32, height=96, width=84, supersample=1, fit=FitOptions(face_rank=20, basis=12, brightness=True)
    ),
    "standard": DEFAULT_CONFIG,
    "reference": TrainConfig(
        heads=240, lights=100, height=192, width=168, fit=FitOptions(face_rank=80, brightness=True)
    ),
}
"""Three points on the frontier of accuracy and time (``configs/draft.yaml``, ``default.yaml`` and
``reference.yaml``)."""


def quality_config(quality: str) -> TrainConfig:
    """The training config behind "draft", "standard" or "reference"."""
    if quality not in QUALITIES:
        raise ValueError(f"quality: expected one of {', '.join(QUALITIES)}, got {quality!r}")
    return QUALITIES[quality]


def cache_folder() -> Path:
    """The package's folder in the user's cache; the environment variable FACERELIGHT_CACHE overrides it."""
    return Path(os.environ.get("FACERELIGHT_CACHE") or user_cache_path("facerelight"))


def default_statistics_folder(config: TrainConfig = DEFAULT_CONFIG, cache: str | Path | None = None) -> Path:
    """Where the statistics of ``config`` are cached, under ``cache`` (default: :func:`cache_folder`)."""
    return Path(cache or cache_folder()) / "statistics" / config.key()


def find_statistics(config: TrainConfig = DEFAULT_CONFIG, cache: str | Path | None = None) -> Path | None:
    """The folder with statistics of ``config``, or None where they have to be trained.

    The packaged ones for the default config, so that it gives everyone the same pictures; else what is cached. Of a
    ``cache`` that is named only that.
    """
    if cache is None and config == DEFAULT_CONFIG:
        return PACKAGED
    folder = default_statistics_folder(config, cache)
    return folder if (folder / "statistics.safetensors").exists() else None
