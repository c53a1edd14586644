"""Pictures of what the package does: contact sheets, the meaning of the light angles, needle maps."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from torch import Tensor

try:
    import matplotlib
    from matplotlib.figure import Figure
except ModuleNotFoundError as error:
    raise RuntimeError('pictures need matplotlib, which is not installed; pip install "facerelight[plot]"') from error

__all__ = ["contact_sheet", "needle_map"]

matplotlib.rcParams["figure.dpi"] = 110


def contact_sheet(
    images: Sequence[Sequence[np.ndarray]], titles: Sequence[Sequence[str]], path: str | Path, height: float = 1.9
) -> None:
    """Rows of pictures ``(H, W, 3)`` or grey ``(H, W)`` in 0..255 or 0..1, each under its title, written to
    ``path``."""
    rows, columns = len(images), max(len(row) for row in images)
    first = images[0][0]
    figure = Figure(
        figsize=(columns * height * first.shape[1] / first.shape[0], rows * (height + 0.25)), layout="constrained"
    )
    axes = figure.subplots(rows, columns, squeeze=False)
    for row, names, line in zip(images, titles, axes, strict=True):
        for axis in line:
            axis.axis("off")
        for picture, name, axis in zip(row, names, line, strict=False):
            axis.imshow(picture, cmap="gray", vmin=0, vmax=1 if picture.dtype.kind == "f" else 255)
            axis.set_title(name, fontsize=8, pad=2)
    figure.savefig(path)


def needle_map(normals: Tensor, path: str | Path, step: int = 4) -> None:
    """Surface normals ``(3, H, W)`` as little arrows over their albedo (figure 4.7), written to ``path``."""
    field = normals.numpy()
    _, height, width = field.shape
    y, x = np.mgrid[step // 2 : height : step, step // 2 : width : step]
    figure = Figure(figsize=(4, 4 * height / width), layout="constrained")
    axis = figure.subplots()
    axis.imshow(np.linalg.norm(field, axis=0), cmap="gray")
    axis.quiver(x, y, field[0, y, x], field[1, y, x], color="tab:orange", width=0.003)
    axis.axis("off")
    figure.savefig(path)
