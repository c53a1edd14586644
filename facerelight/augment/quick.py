"""The fast path: batches of faces under new lights, each by a few small matrix products.

What :class:`~facerelight.inference.relighter.StatisticalRelighter` does exactly, with three liberties: maps are
averages over blocks of pixels; a crop's light is taken to the nearest of some dozens of cells, whose covariances are
known beforehand; and the deviation under a light is interpolated between the bootstrap's, so that a sum of lights costs
what one does.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from facerelight.augment.crop_relighter import UNSEEN, CropRelighter, Radiances, Source
from facerelight.augment.source import find_source_lights, front_lights
from facerelight.geometry.alignment import CropFrame
from facerelight.geometry.lights import even_hemisphere
from facerelight.geometry.sums import LightSum
from facerelight.inference.relighter import StatisticalRelighter
from facerelight.model.covariance import deviation_covariance, image_covariance, prior_mean
from facerelight.model.light_terms import light_terms, loadings_at
from facerelight.model.pooling import pooled_statistics
from facerelight.numerics.kernels import kernel_weights
from facerelight.photo.face_model import MISFIT, crop_frame, wobble

__all__ = ["QuickRelighter"]

CELLS_AT_ONCE = 8
REACH = 1.25  # of the face's outline: the code is told from inside


class QuickRelighter(CropRelighter):
    """Radiance of aligned faces under new lights, a batch at a time.

    Args:
        relighter: the exact model, with whole-face loadings.
        block: pixels of the exact model along each side of one of this.
        cells: lights of a hemisphere to which a crop's own light is taken.

    Buffers, which are made of the relighter's statistics and are no part of the state; P coarse pixels, of which the
    code is told from P', k loadings, J bootstrap lights, S cells, m functions of the light: ``average (J, P)``;
    ``prior (3 + J, P)``; ``loadings (k, 3 + m, P)``; ``places (P',)``; of each cell ``cells (S, 3)``, ``features
    (S, 3 + m)``, ``mean``, ``variance`` and ``wobble``, ``(S, P)`` each, ``codes (S, k, P')``, ``covariance
    (S, 3 + J, P)`` in bfloat16, ``gain_noise (S,)``.

    Example:
        >>> from facerelight.model.statistics import FaceStatistics
        >>> lights = even_hemisphere(6)
        >>> statistics = FaceStatistics.fit(torch.rand(5, 6, 16, 16), lights, rank=2, face_rank=2)
        >>> quick = QuickRelighter(StatisticalRelighter(statistics, "face"), block=2, cells=6)
        >>> target = LightSum(lights[:2].expand(4, 2, 3), torch.ones(4, 2))
        >>> quick(torch.rand(4, 16, 16), torch.ones(1, 16, 16), [target]).maps.shape
        torch.Size([4, 2, 8, 8])
    """

    lights: Tensor
    light_widths: Tensor
    average: Tensor
    prior: Tensor
    loadings: Tensor
    basis: Tensor
    places: Tensor
    cells: Tensor
    features: Tensor
    mean: Tensor
    variance: Tensor
    wobble: Tensor
    codes: Tensor
    covariance: Tensor
    gain_noise: Tensor

    def __init__(self, relighter: StatisticalRelighter, block: int = 2, cells: int = 128) -> None:
        if relighter.covariance != "face":
            raise ValueError(f"relighter: expected covariance='face', got {relighter.covariance!r}")
        if not isinstance(cells, int) or cells < 1:
            raise ValueError(f"cells: expected one light or more, got {cells!r}")
        statistics = pooled_statistics(relighter.statistics, block)
        face = statistics.face
        assert face is not None
        super().__init__(relighter.statistics.size, block, crop_frame(relighter).margin, statistics.n_mean)
        self.gain_spread = float(statistics.gain_spread)
        self.noise = math.hypot(relighter.noise, MISFIT) / 255
        places = _told_from(self.map_frame)
        self.temper = float(face.temper) * len(places) / int((self.map_frame.oval() < REACH).sum())
        towards = even_hemisphere(cells).to(statistics.lights)
        every = light_terms(statistics, face.residual, statistics.lights, face)
        root = face.residual.n_factor.flatten(2)  # (3, 3, P)
        parts: list[tuple[Tensor, ...]] = []
        for light in towards.split(CELLS_AT_ONCE):
            terms = light_terms(statistics, face.residual, light, face)
            of_n = torch.einsum("dcp,ecp,se->sdp", root, root, light)  # C_n s, (S', 3, P)
            of_v = deviation_covariance(statistics, face.residual, every, terms).permute(2, 1, 0)  # (S', J, P)
            own = image_covariance(statistics, face.residual, terms, terms).diagonal(dim1=1, dim2=2).T  # (S', P)
            parts.append(
                (
                    torch.cat((light, terms.weights @ face.basis.T), 1),
                    terms.mean,
                    own.to(root),
                    wobble(statistics, light),
                    loadings_at(face, terms)[..., places],
                    torch.cat((of_n, of_v.to(root)), 1).bfloat16(),
                    terms.weights @ statistics.gain_noise,
                )
            )
        of_cells = [torch.cat(part) for part in zip(*parts, strict=True)]
        names = ("features", "mean", "variance", "wobble", "codes", "covariance", "gain_noise")
        for name, buffer in (
            ("lights", statistics.lights.clone()),
            ("light_widths", statistics.light_widths.clone()),
            ("average", prior_mean(statistics, statistics.lights)),
            ("prior", torch.cat((statistics.n_mean, statistics.v_mean)).flatten(1)),
            ("loadings", torch.cat((face.n, face.v), 1).flatten(2)),
            ("basis", face.basis.clone()),
            ("places", places),
            ("cells", towards),
            *zip(names, of_cells, strict=True),
        ):
            self.register_buffer(name, buffer.contiguous(), persistent=False)

    def forward(
        self, luminance: Tensor, mask: Tensor, targets: list[LightSum], source: Source = "estimate"
    ) -> Radiances:
        """See :meth:`CropRelighter.forward`."""
        seen, shown = (self._pooled(part) for part in (luminance, mask))  # (B, P), (B or 1, P)
        find = front_lights if source == "front" else find_source_lights
        own = find(self.average.to(seen), self.lights.to(seen), seen, shown)
        cell = (own.direction @ self.cells.to(seen).T).argmax(1)  # (B,)
        strength = own.strength.clamp_min(1e-4)[:, None]
        single = self.mean[cell].to(seen)
        quotient = own.equivalent(self.average.to(seen), single) / strength
        equivalent = seen * quotient
        noise = (quotient * self.noise).square() + self.wobble[cell] + UNSEEN**2 * (1 - shown).clamp(0, 1)
        gain = self._gain(equivalent, single, shown, cell)[:, None]
        left = equivalent / gain - single
        spread = self.variance[cell] + noise / gain.square()  # (B, P)
        code = self._code(cell, left, shown / spread)
        person = (code @ self.loadings.to(code).flatten(1)).unflatten(1, self.loadings.shape[1:])  # (B, 3 + m, P)
        solved = (left - (self.features[cell].to(code)[:, None] @ person)[:, 0]) / spread
        vector, weights = self._lights(own.share, targets)
        features = torch.cat((vector, weights), 2)  # (B, Q, 3 + J)
        explained = features @ self.prior.to(seen)
        explained = explained + torch.cat((vector, weights @ self.basis.to(seen).T), 2) @ person
        maps = explained + self._deviations(features, cell) * solved[:, None]
        brightness = (gain * strength)[..., None]
        maps, explained = (
            (part * brightness).clamp_min(0).unflatten(2, self.size) for part in (maps, explained[:, :1])
        )
        return Radiances(maps, explained[:, 0], own.known)

    def _code(self, cell: Tensor, left: Tensor, trust: Tensor) -> Tensor:
        """The whole-face code, ``(B, k)``, from what is ``left (B, P)`` beside the average face."""
        loadings = self.codes[cell].to(left)  # (B, k, P')
        trusted = loadings * trust[:, None, self.places]
        precision = trusted @ loadings.mT + self.temper * torch.eye(loadings.shape[1]).to(loadings)
        return torch.linalg.solve(precision, trusted @ left[:, self.places, None])[..., 0]

    def _pooled(self, images: Tensor) -> Tensor:
        return torch.nn.functional.avg_pool2d(images[:, None], self.block).flatten(1)

    def _gain(self, images: Tensor, expected: Tensor, mask: Tensor, cell: Tensor) -> Tensor:
        """How bright each person is beside the average face, ``(B,)``; see :mod:`facerelight.model.brightness`."""
        if self.gain_spread == 0:
            return torch.ones_like(images[:, 0])
        power = (mask * expected.square()).sum(1).clamp_min(1e-12)
        read = ((mask * expected * images).sum(1) / power).clamp_min(1e-3).log()
        certain = self.gain_noise[cell].to(read).square().reciprocal()
        return (read * certain / (certain + self.gain_spread**-2)).exp()

    def _lights(self, share: Tensor, targets: list[LightSum]) -> tuple[Tensor, Tensor]:
        """What lights are in the model, the crops' own first: vectors ``(B, Q, 3)`` and weights ``(B, Q, J)``."""
        lights = self.lights.to(share)
        vectors, weights = [share @ lights], [share @ self._weights(lights)]
        for target in targets:
            amounts, directions = target.amounts.to(share), target.directions.to(share)
            vectors.append((amounts[:, None] @ directions)[:, 0])
            weights.append((amounts[:, None] @ self._weights(directions))[:, 0])
        return torch.stack(vectors, 1), torch.stack(weights, 1)

    def _weights(self, directions: Tensor) -> Tensor:
        """Kernel weights over the bootstrap lights, ``(..., 3)`` to ``(..., J)``."""
        squared = (directions[..., None, :] - self.lights.to(directions)).square().sum(-1)
        return kernel_weights(squared, self.light_widths.to(directions))

    def _deviations(self, features: Tensor, cell: Tensor) -> Tensor:
        """Covariances of pixels under lights of ``features (B, Q, 3 + J)`` and under the cells' light, ``(B, Q, P)``;
        cell by cell, so that no covariance is copied."""
        found = features.new_empty(*features.shape[:2], self.mean.shape[1])
        for one in cell.unique():
            members = (cell == one).nonzero()[:, 0]
            rows = features[members].flatten(0, 1) @ self.covariance[one].to(features)
            found = found.index_copy(0, members, rows.unflatten(0, (len(members), -1)))
        return found


def _told_from(frame: CropFrame) -> Tensor:
    """Every other pixel of the face, as on a chessboard: the code is told from these."""
    y, x = torch.meshgrid(torch.arange(frame.height), torch.arange(frame.width), indexing="ij")
    return (((x + y) % 2 == 0) & (frame.oval() < REACH)).flatten().nonzero()[:, 0]
