"""The bootstrap subjects' images, kept while statistics are learned: in memory, or one file a subject in a folder."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from facerelight.model.file import replacing

__all__ = ["ImageStore"]


class ImageStore:
    """Images of subjects under the same J lights, ``(J, H, W)`` each, readable by blocks of pixels.

    With a ``folder`` every subject is one ``.npy`` file, written atomically: memory stays flat in the number of
    subjects, an interrupted run goes on where it stopped, and several processes may fill one folder. A missing image is
    all NaN.

    Args:
        folder: where the files live; created if needed. None keeps the images in memory.
    """

    def __init__(self, folder: str | Path | None = None) -> None:
        self.folder = None if folder is None else Path(folder)
        self._images: list[np.ndarray] = []
        if self.folder is not None:
            self.folder.mkdir(parents=True, exist_ok=True)

    def _paths(self) -> list[Path]:
        return sorted(self.folder.glob("subject_*.npy")) if self.folder is not None else []

    def __len__(self) -> int:
        return len(self._images) if self.folder is None else len(self._paths())

    def __contains__(self, subject: int) -> bool:
        """Whether subject number ``subject`` is already in the folder, whole; what is left of a damaged file is
        removed."""
        if self.folder is None:
            return False
        path = self.folder / f"subject_{subject:06d}.npy"
        if not path.exists():
            return False
        try:
            np.load(path, mmap_mode="r")
        except (OSError, ValueError):
            path.unlink()
            return False
        return True

    def add(self, images: Tensor, subject: int | None = None) -> None:
        """Keep one subject's ``images`` ``(J, H, W)``; ``subject`` numbers its file (default: the number after
        the highest; several processes that fill one folder number their own)."""
        array = images.detach().cpu().numpy().astype(np.float32)
        if self.folder is None:
            self._images.append(array)
            return
        number = self._next() if subject is None else subject
        with replacing(self.folder / f"subject_{number:06d}.npy") as partial, partial.open("wb") as file:
            np.save(file, array)

    def _next(self) -> int:
        """The number after the highest: a folder may have gaps."""
        return max((int(path.stem.removeprefix("subject_")) for path in self._paths()), default=-1) + 1

    def __iter__(self) -> Iterator[np.ndarray]:
        """Every subject's images ``(J, H, W)``, one after the other; memory-mapped where they are files, and then to be
        let go."""
        if self.folder is None:
            yield from self._images
        else:
            for path in self._paths():
                yield np.load(path, mmap_mode="r")

    @property
    def shape(self) -> tuple[int, ...]:
        """``(J, H, W)`` of the first subject."""
        return next(iter(self)).shape

    def block(self, start: int, stop: int) -> Tensor:
        """Pixels ``start:stop`` (row-major) of all subjects, ``(N, J, stop - start)``."""
        rows = torch.empty(len(self), self.shape[0], stop - start)
        for row, array in zip(rows, self, strict=True):
            row.numpy()[:] = array.reshape(len(array), -1)[:, start:stop]
        return rows
