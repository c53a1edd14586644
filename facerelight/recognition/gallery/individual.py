"""The thesis's recogniser in use: a subspace a person and module of the face, of relit pictures of one photograph.

The face is divided into modules (modular eigenspaces, Pentland et al. 1994), for landmarks that are found lie a little
off and faces are not rigid: a probe is compared at turns, scales and shifts, as a whole and each module on its own.
"""

from __future__ import annotations

import itertools

import cv2
import numpy as np
import torch
from torch import Tensor, nn

from facerelight.geometry.alignment import CropFrame, fit_similarity, warp_to_crop
from facerelight.inference.detail import keep_detail
from facerelight.inference.relighter import StatisticalRelighter
from facerelight.numerics.luminance import LUMINANCE
from facerelight.photo import PhotoRelighter, crop_frame
from facerelight.photo.colour import to_scene
from facerelight.photo.faces.landmarks import Face
from facerelight.recognition.classifier import moved
from facerelight.recognition.embedding import warp
from facerelight.recognition.exemplars import exemplar_lights
from facerelight.recognition.gallery.calibration import PRIOR_PEOPLE
from facerelight.recognition.gallery.recognizer import Levels, Template
from facerelight.recognition.photometric import WeberFaces
from facerelight.recognition.subspaces import principal_subspace

__all__ = ["IndividualRecognizer", "NearestPhotoRecognizer", "SubspaceIndex", "leave_out_shared"]

VERSION = 5
PROBE = CropFrame(240, 210, 0.125)  # a pixel of the canonical crop each, with room to move
FINE = CropFrame(128, 112)  # two thirds of that: where pictures are compared
FINEST = 2 / 3  # pixels of FINE: the finest contrast that counts
MODULES = (6, 5)  # down, across
DIMENSION = 4
TURNS, SCALES, SHIFT = (-1.5, 0.0, 1.5), (0.975, 1.0, 1.025), 2  # degrees, factors, pixels of FINE
FACE = 0.95  # of the outline; hair and background are left out ...
LEAST = 0.3  # ... and modules of which less than that is face
TOGETHER = 64  # templates compared at once
STRANGERS = 0.188  # cosine of different people of CMU PIE, for where few are enrolled
PIE_LEVELS = Levels(0.0, 0.015, 1.56, -3.22)


class IndividualRecognizer:
    """Individual PCA (6.1) of relit pictures that keep the photograph's fine detail, by modules.

    Args:
        relighter: renders every enrolled face under the lights of :func:`exemplar_lights`.
        levels: of its scores, see :class:`Levels`.
    """

    name = "individual_pca"
    personal = True

    def __init__(self, relighter: StatisticalRelighter, levels: Levels = PIE_LEVELS) -> None:
        self.relighter, self.levels = relighter, levels
        self._features = WeberFaces(FINEST)

    def key(self) -> dict[str, object]:
        """See :class:`facerelight.recognition.gallery.recognizer.Recognizer`."""
        frame = crop_frame(self.relighter)
        crop = [frame.height, frame.width, frame.margin]
        return {"model": f"individual_pca of {self.relighter.statistics.key}", "crop": crop, "version": VERSION}

    def describe(self, photo: np.ndarray, face: Face) -> Tensor:
        """Scene radiance of the aligned face, ``(240, 210)``; beyond the picture its border is repeated."""
        matrix = fit_similarity(torch.from_numpy(np.asarray(face.landmarks, np.float64)), PROBE.landmarks).numpy()
        coded = warp(photo, matrix, PROBE.height)[:, : PROBE.width]
        return torch.from_numpy(to_scene(coded.astype(np.float32) / 255) @ np.array(LUMINANCE, np.float32))

    def enroll(self, photo: np.ndarray, face: Face) -> Template:
        """``mean (1, B, D)`` and ``basis (1, B, D, k)`` of B modules; ``probe``, see :meth:`describe`."""
        probe = self.describe(photo, face)
        rows = _modules(self._features(self._exemplars(photo, face, _placed(probe, 0.0, 1.0))))
        spaces = [principal_subspace(own, DIMENSION) for own in rows]
        bases = [nn.functional.pad(space.basis, (0, DIMENSION - space.basis.shape[1])) for space in spaces]
        mean = torch.stack([space.mean for space in spaces])
        return {"probe": probe[None], "mean": mean[None], "basis": torch.stack(bases)[None]}

    def _exemplars(self, photo: np.ndarray, face: Face, fine: Tensor) -> Tensor:
        """The face under many lights, ``(Q, 128, 112)``, the last as photographed, ``fine (128, 112)``."""
        lights, _ = exemplar_lights()
        relit = PhotoRelighter(photo, None, self.relighter, face=face).crops(lights).clamp_min(0)
        up = fit_similarity(crop_frame(self.relighter).landmarks, FINE.landmarks)
        relit = warp_to_crop(relit[None], up[None], FINE)[0]
        return torch.cat((keep_detail(relit, fine, 1.0), fine[None]))

    def index(self, templates: Template, owners: Tensor) -> SubspaceIndex:
        """All are compared."""
        return SubspaceIndex(templates, owners, self._features)


class NearestPhotoRecognizer(IndividualRecognizer):
    """The same features and search, and nothing relit: each person is the one photograph. What relighting is worth is
    measured against it."""

    name = "nearest_photo"

    def key(self) -> dict[str, object]:
        """See :class:`facerelight.recognition.gallery.recognizer.Recognizer`."""
        return super().key() | {"model": "nearest_photo"}

    def _exemplars(self, photo: np.ndarray, face: Face, fine: Tensor) -> Tensor:
        return fine[None]


class SubspaceIndex:
    """Everybody's subspaces. Scores are cosines less what the probe has in common with others, see
    :func:`leave_out_shared`.

    Args:
        templates: "mean" and "basis", see :meth:`IndividualRecognizer.enroll`.
        owners: ``(M,)`` numbers, whose the templates are.
        features: of pictures ``(V, 128, 112)``.
    """

    def __init__(self, templates: Template, owners: Tensor, features: nn.Module) -> None:
        self.mean, self.basis, self._features = templates["mean"], templates["basis"], features
        self.owners = owners

    def cosines(self, probe: Tensor) -> Tensor:
        """Of a probe ``(240, 210)`` with every template, ``(M,)``."""
        views = _modules(self._features(_views(probe)))  # (B, V, D)
        parts = zip(self.mean.split(TOGETHER), self.basis.split(TOGETHER), strict=True)
        return torch.cat([_cosines(views, mean, basis) for mean, basis in parts])

    def search(self, probe: Tensor, count: int) -> tuple[Tensor, Tensor]:
        """See :class:`facerelight.recognition.gallery.recognizer.Index`."""
        scores = leave_out_shared(self.cosines(probe), self.owners)
        best = scores.topk(min(count, len(scores)))
        return best.values, best.indices


def leave_out_shared(cosines: Tensor, owners: Tensor) -> Tensor:
    """Less what a probe has in common with everybody but the likeliest person (T-norm, Auckenthaler et al. 2000): in
    hard light it resembles nobody, and in a soft one all.

    Args:
        cosines: ``(M,)`` of one probe with M templates.
        owners: ``(M,)`` numbers, whose the templates are.

    Example:
        >>> leave_out_shared(torch.tensor([0.7, 0.2, 0.3]), torch.arange(3))
        tensor([ 0.4943, -0.0057,  0.0943])
    """
    others = cosines[owners != owners[cosines.argmax()]]
    return cosines - (others.sum() + PRIOR_PEOPLE * STRANGERS) / (len(others) + PRIOR_PEOPLE)


def _cosines(views: Tensor, mean: Tensor, basis: Tensor) -> Tensor:
    """Of probe and person, both outside the person's subspace, ``(M,)``: the mean of the best view of the whole face
    and of the best views of its modules."""
    people, modules, size, k = basis.shape
    columns = basis.permute(1, 2, 0, 3).reshape(modules, size, people * k)
    inside = (views @ columns).unflatten(-1, (people, k))  # (B, V, M, k)
    offset = torch.einsum("mbdk,mbd->bmk", basis, mean)
    together = views @ mean.permute(1, 2, 0) - torch.einsum("bvmk,bmk->bvm", inside, offset)
    probe = views.square().sum(-1, keepdim=True) - inside.square().sum(-1)
    person = mean.square().sum(-1).T - offset.square().sum(-1)
    cosine = together / (probe.clamp_min(1e-9) * person.clamp_min(1e-9)[:, None]).sqrt()
    return (cosine.mean(0).amax(0) + cosine.amax(1).mean(0)) / 2


def _views(probe: Tensor) -> Tensor:
    """A probe at all turns, scales and shifts, ``(V, 128, 112)``."""
    placed = torch.stack([_placed(probe, turn, scale) for turn, scale in itertools.product(TURNS, SCALES)])
    steps = range(-SHIFT, SHIFT + 1)
    return torch.cat([moved(placed, down, right) for down in steps for right in steps])


def _placed(probe: Tensor, turn: float, scale: float) -> Tensor:
    """The face of a probe in :data:`FINE`, turned (degrees) and scaled about its middle."""
    matrix = fit_similarity(PROBE.landmarks, FINE.landmarks).numpy()
    centre, radians = FINE.landmarks.mean(0).numpy(), np.deg2rad(turn)
    more = scale * np.array(((np.cos(radians), -np.sin(radians)), (np.sin(radians), np.cos(radians))))
    matrix = np.column_stack((more @ matrix[:, :2], more @ (matrix[:, 2] - centre) + centre))
    smooth = cv2.GaussianBlur(probe.numpy(), (0, 0), 0.6)  # nothing aliases at two thirds of its size
    size = (FINE.width, FINE.height)
    return torch.from_numpy(cv2.warpAffine(smooth, matrix, size, borderMode=cv2.BORDER_REPLICATE))


def _modules(images: Tensor) -> Tensor:
    """``(M, H, W)`` to ``(B, M, D)``, the modules that are mostly face; what is no face is 0."""
    face = (FINE.oval() < FACE).float()
    share = _divided(face[None]).mean(-1)[:, 0]
    return _divided(images * face)[share > LEAST * share.max()]


def _divided(images: Tensor) -> Tensor:
    down, across = MODULES
    height, width = images.shape[1] // down, images.shape[2] // across
    parts = images[:, : down * height, : across * width].unflatten(1, (down, height)).unflatten(3, (across, width))
    return parts.permute(1, 3, 0, 2, 4).flatten(3).flatten(0, 1)
