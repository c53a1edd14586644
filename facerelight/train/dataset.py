"""The people of a training config, ready to be rendered."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from torch import Tensor

from facerelight.config import TrainConfig

if TYPE_CHECKING:
    from facerelight.bootstrap.dataset import BootstrapDataset

__all__ = ["make_dataset"]


def make_dataset(
    config: TrainConfig,
    lights: Tensor | None = None,
    pose: tuple[float, float] = (0.0, 0.0),
    expression: dict[str, float] | None = None,
) -> BootstrapDataset:
    """The people of a config as a torch dataset, under its own lights from the front unless told otherwise."""
    from facerelight.bootstrap.dataset import BootstrapDataset  # OpenGL starts here and not before
    from facerelight.bootstrap.heads import HeadSource, IctHeads, MakeHumanHeads
    from facerelight.bootstrap.heads.meshes import MeshFolder

    source: HeadSource
    if expression and config.source != "makehuman":
        raise ValueError(
            f"expression: expected source 'makehuman', whose heads have expressions, got {config.source!r}"
        )
    if config.source == "makehuman":
        source = MakeHumanHeads(config.seed, expression=expression)
    elif config.source == "ict":
        source = IctHeads(None, config.seed)
    elif Path(config.source).is_dir():
        source = MeshFolder(config.source)
        if len(source) < config.heads:
            raise ValueError(f"heads: expected at most the {len(source)} meshes in {config.source}, got {config.heads}")
    elif config.source.endswith(".npz"):
        source = IctHeads(config.source, config.seed)
    else:
        raise ValueError(
            f"source: expected 'makehuman', 'ict', a folder of meshes or a path to ict_heads.npz, got {config.source!r}"
        )
    seen = config.directions() if lights is None else lights
    return BootstrapDataset(
        source, config.heads, seen, config.frame, config.domain, config.seed, config.effects, config.supersample, pose
    )
