"""People enrolled from photographs on disk, and strangers' photographs identified among them."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file

from facerelight.inference.detail import keep_detail
from facerelight.inference.relighter import StatisticalRelighter
from facerelight.model.file import replacing
from facerelight.photo import PhotoRelighter, crop_frame
from facerelight.photo.files.disk import read_photo
from facerelight.recognition.exemplars import exemplar_lights
from facerelight.recognition.pca import IndividualPCAClassifier
from facerelight.recognition.photometric import Inside, make_normalizer
from facerelight.recognition.subspaces import Subspace

__all__ = ["Gallery", "Identification"]

GALLERY_VERSION = 3  # says which statistics and crop it belongs to
FACE = 0.95  # of the outline; hair and background are left out of the comparison


class Identification(NamedTuple):
    """``name``, None for a stranger; ``errors``: 1 minus the cosine of :class:`IndividualPCAClassifier` by name,
    smallest first."""

    name: str | None
    errors: dict[str, float]


class Gallery:
    """Individual PCA subspaces (6.1) of relit photos that keep their fine detail, one a person.

    Args:
        relighter: renders each photo under the lights of :func:`exemplar_lights`.
        photometric: one of :data:`facerelight.recognition.photometric.NORMALIZERS`.
        dimension: of each subspace.
        shift: pixels of the crop by which landmarks may be off.
    """

    def __init__(
        self, relighter: StatisticalRelighter, photometric: str = "weber_fine", dimension: int = 9, shift: int = 2
    ) -> None:
        self.relighter, self.photometric, self.dimension = relighter, photometric, dimension
        face = (crop_frame(relighter).oval() < FACE).float()
        normalizer = Inside(make_normalizer(photometric), face)
        self.classifier = IndividualPCAClassifier(dimension, normalizer=normalizer, metric="cosine", shift=shift)

    def enroll(self, name: str, photos: list[Path]) -> None:
        """Add a person from one or more photos, or replace them; their landmarks are found."""
        self.add(name, [self._open(path) for path in photos])

    def add(self, name: str, photos: Sequence[PhotoRelighter]) -> None:
        """:meth:`enroll` for photos that are opened already, with landmarks given, say."""
        if not name or not isinstance(name, str):
            raise ValueError(f"name: expected that of the person, got {name!r}")
        if not photos:
            raise ValueError(f"photos: expected one or more of {name}, got none")
        lights, _ = exemplar_lights()
        exemplars = []
        for photo in photos:
            exemplars += [keep_detail(photo.crops(lights), photo.luminance, 1.0), photo.luminance[None]]
        self.classifier.partial_fit(torch.cat(exemplars), name)

    def identify(self, photo: str | Path) -> Identification:
        """Who is in ``photo``; its landmarks are found."""
        return self.compare(self._open(Path(photo)))

    def compare(self, photo: PhotoRelighter) -> Identification:
        """:meth:`identify` for a photo that is opened already."""
        if not self.classifier.classes_:
            raise ValueError("gallery: expected people in it, got none; enroll them first")
        image = photo.luminance[None]
        scores = self.classifier.decision_function(image)[0]
        names = [str(name) for name in self.classifier.classes_ or []]
        errors = sorted(zip((1 - scores).tolist(), names, strict=True))
        best = self.classifier.predict(image)[0]
        return Identification(None if best is None else str(best), {name: round(error, 5) for error, name in errors})

    def _open(self, path: Path) -> PhotoRelighter:
        try:
            return PhotoRelighter(read_photo(path).rgb, None, self.relighter)
        except RuntimeError as error:
            raise ValueError(f"{path}: {error}") from error

    def save(self, path: str | Path) -> None:
        """Write ``path`` (safetensors) and beside it the names, as ``.json``."""
        path = Path(path)
        path.parent.mkdir(parents=True, exist_ok=True)
        state = self.classifier
        tensors = {"means": state.means, "bases": state.bases, "dimensions": state.dimensions}
        header = {
            "format": "facerelight-gallery",
            "version": GALLERY_VERSION,
            "names": state.classes_,
            "photometric": self.photometric,
            "dimension": self.dimension,
            "shift": self.classifier.shift,
            "reject": state.threshold_,
            **self._belongs(),
        }
        with replacing(path) as partial, replacing(path.with_suffix(".json")) as notes:
            save_file({k: v.contiguous() for k, v in tensors.items()}, partial)
            notes.write_text(json.dumps(header, indent=2))

    def _belongs(self) -> dict[str, object]:
        """What subspaces of one gallery have in common: the statistics and the crop that they were rendered with."""
        frame = crop_frame(self.relighter)
        crop = [frame.height, frame.width, frame.margin]
        return {"statistics": self.relighter.statistics.key, "crop": crop}

    @classmethod
    def load(cls, path: str | Path, relighter: StatisticalRelighter) -> Gallery:
        """Read what :meth:`save` wrote.

        Raises:
            ValueError: a file that is missing, damaged, of another version, or made with other statistics.
        """
        path = Path(path)
        try:
            header = json.loads(path.with_suffix(".json").read_text())
            tensors = load_file(path)
            if header["format"] != "facerelight-gallery" or header["version"] != GALLERY_VERSION:
                raise ValueError(f"expected version {GALLERY_VERSION}, got {header.get('version')}")
            gallery = cls(relighter, header["photometric"], header["dimension"], header["shift"])
            state = gallery.classifier
            means, bases, sizes = (tensors[name] for name in ("means", "bases", "dimensions"))
            state.threshold_ = header["reject"]
            height, width = relighter.statistics.size
            people, pixels = len(header["names"]), height * width
            fits = bases.dim() == 3 and bases.shape[:2] == means.shape == (people, pixels) and len(sizes) == people
            if not fits or not torch.isfinite(bases).all() or not torch.isfinite(means).all():
                raise ValueError(
                    f"expected finite bases of {people} people at {height} x {width}, got {tuple(bases.shape)}"
                )
            spaces = [
                Subspace(mean, basis[:, :k], torch.ones(k))
                for mean, basis, k in zip(means, bases, sizes.tolist(), strict=True)
            ]
            wanted, found = gallery._belongs(), {name: header[name] for name in ("statistics", "crop")}
            if wanted != found:
                raise ValueError(f"one of {found} for a relighter of {wanted}")
            state.fit_subspaces(spaces, header["names"])
            state.size_ = (height, width)
        except (OSError, KeyError, TypeError, ValueError, AttributeError, SafetensorError) as error:
            raise ValueError(
                f"{path}: expected a gallery and its .json, got {error}; enroll anew with `facerelight recognize`"
            ) from error
        return gallery
