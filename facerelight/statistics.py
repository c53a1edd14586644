"""What a bootstrap of other people's faces teaches: the Gaussian statistics of n and v at every pixel, and over the whole face.

The model (3.13) is ``i(x; s) = n(x)^T s + v(x; s)``: n is the albedo-scaled normal, v(s) the deviation from Lambert (shadows, highlights),
correlated over lights. Everything that is learned is a fixed linear function of the N subjects' images, so fitting runs in two passes over
blocks of pixels: one gathers N x N and J x J Gram matrices, one applies the N x N *subject operators* found from them.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path

import torch
from torch import Tensor, nn

from facerelight import gaussian
from facerelight.kernels import kernel_weights, neighbour_widths
from facerelight.lights import angular_distance, merge_repeats, unit_lights
from facerelight.statistics_file import read_tensors, write_tensors
from facerelight.store import ImageStore
from facerelight.subjects import (
    Brightness,
    FaceOperators,
    Grams,
    face_operators,
    fill_missing,
    fill_operators,
    gather_grams,
    interpolation_error,
    measure_brightness,
    total_gram,
)

__all__ = ["FaceStatistics", "FitOptions", "PixelStatistics"]

BLOCK_VALUES = 1_000_000  # images of all subjects in one block of pixels, 4 MB
NEGLIGIBLE = 1e-6  # kernel weights that no picture shows
GAP_SHRINK = 0.8  # leaving a light out widens the gap around it, and with it the best kernel


@dataclass(frozen=True)
class FitOptions:
    """How statistics are learned.

    Args:
        rank: columns of the correlation factor of v over the lights (8 hold 89 % of its trace on real faces, 16 hold 97 %).
        face_rank: loadings of the whole-face model; 0 leaves it out.
        basis: functions over the lights that the loadings of v share.
        temper: how many pixels count as one independent observation of the whole-face code.
        brightness: learn from faces brought to one brightness and treat a person's (or camera's) gain as an unknown of its own,
            ``i = g (n^T s + v)``; False is the thesis's model.
        kernel_width: width of the kernel over lights, in local light spacings; None chooses it by leaving lights out.
        nugget_width: width of the narrow kernel that makes the model exactly consistent, in spacings.
        floor: least standard deviation of v, in radiance; keeps pixels that never vary well-posed.
        block: most pixels solved at a time; fewer where there are many heads, so that memory stays flat.
    """

    rank: int = 12
    face_rank: int = 0
    basis: int = 24
    temper: float = 100.0
    brightness: bool = False
    kernel_width: float | None = None
    nugget_width: float = 0.35
    floor: float = 2e-3
    block: int = 1024

    def __post_init__(self) -> None:
        if self.rank < 0 or self.face_rank < 0 or self.basis < 1 or self.block < 1:
            raise ValueError(f"statistics: expected ranks >= 0 and basis, block >= 1, got {self}")
        widths = self.nugget_width > 0 and (self.kernel_width is None or self.kernel_width > 0)
        if not (self.temper >= 1 and widths and self.floor > 0):
            raise ValueError(f"statistics: expected temper >= 1 and widths, floor > 0, got {self}")


class PixelStatistics(nn.Module):
    """Second-order statistics of n and of v at the J bootstrap lights, pixel by pixel (4.3).

    Buffers: ``n_factor (3, 3, H, W)`` with ``C_n = L L^T``; ``v_std (J, H, W)``; ``v_factor (J, r, H, W)``, the factor F of the correlation
    ``F F^T + diag(1 - rowsum F^2)`` of v over the lights.
    """

    n_factor: Tensor
    v_std: Tensor
    v_factor: Tensor

    def __init__(self, n_factor: Tensor, v_std: Tensor, v_factor: Tensor) -> None:
        super().__init__()
        self.register_buffer("n_factor", n_factor)
        self.register_buffer("v_std", v_std)
        self.register_buffer("v_factor", v_factor)

    @staticmethod
    def learn(n: Tensor, v: Tensor, dof: float, options: FitOptions) -> tuple[Tensor, Tensor, Tensor]:
        """The three tensors of a block of pixels from centred ``n (N, 3, P)`` and ``v (N, J, P)``."""
        n_factor = gaussian.covariance_factor(n.permute(2, 0, 1), dof).permute(1, 2, 0)
        length = v.square().sum(0).sqrt()  # (J, P)
        v_std = (length / dof**0.5).clamp_min(options.floor)
        unit = torch.where(length > options.floor * dof**0.5, v / length.clamp_min(1e-30), torch.zeros_like(v))
        v_factor = gaussian.correlation_factor(unit.permute(2, 0, 1), options.rank).permute(1, 2, 0)
        return n_factor, v_std, v_factor


class FaceLoadings(nn.Module):
    """The low-rank part of the whole-face model: ``i = mu + (Lambda_n^T s + w(s).Lambda_v)^T c + e``, ``c ~ N(0, I_k)``.

    Buffers: ``n (k, 3, H, W)``; ``v (k, m, H, W)``, loadings of v in a basis over the lights; ``basis (m, J)``; ``v_power (J, H, W)``, the
    variance that the loadings give v at each light; ``temper ()``. ``residual`` holds the per-pixel statistics of e.
    """

    n: Tensor
    v: Tensor
    basis: Tensor
    v_power: Tensor
    temper: Tensor

    def __init__(
        self, n: Tensor, v: Tensor, basis: Tensor, v_power: Tensor, temper: Tensor, residual: PixelStatistics
    ) -> None:
        super().__init__()
        for name, tensor in (("n", n), ("v", v), ("basis", basis), ("v_power", v_power), ("temper", temper)):
            self.register_buffer(name, tensor)
        self.residual = residual


class FaceStatistics(nn.Module):
    """Statistics of n and v learned from a bootstrap, as registered buffers.

    Build them with :meth:`fit`, or subject by subject: ``FaceStatistics(lights)``, :meth:`update` for each, :meth:`solve`.

    Args:
        lights: unit vectors ``(J, 3)`` of the bootstrap lights; repeats are merged.
        options: how to learn.
        store: where the subjects' images are kept until solved (default: in memory).

    Buffers after :meth:`solve`: ``lights (J, 3)``, ``light_widths (J,)``, ``nugget_width ()``, ``gain_spread ()``, ``gain_noise (J,)``,
    ``n_mean (3, H, W)``, ``v_mean (J, H, W)``,
    the submodule ``pixel`` (:class:`PixelStatistics`) and, with a ``face_rank``, ``face`` (:class:`FaceLoadings`).
    """

    lights: Tensor
    light_widths: Tensor
    nugget_width: Tensor
    n_mean: Tensor
    v_mean: Tensor
    gain_spread: Tensor
    gain_noise: Tensor

    def __init__(self, lights: Tensor, options: FitOptions | None = None, store: ImageStore | None = None) -> None:
        super().__init__()
        self.options = options or FitOptions()
        self.store: ImageStore | None = ImageStore() if store is None else store
        self.metadata: dict[str, object] = {}
        distinct, self._light_index = merge_repeats(unit_lights(lights.detach().float()))
        if torch.linalg.matrix_rank(distinct.double(), rtol=1e-4) < 3:
            raise ValueError(
                f"lights: expected at least 3 linearly independent directions, got {len(distinct)} that are not"
            )
        self.register_buffer("lights", distinct)
        self.register_buffer("light_widths", torch.ones(len(distinct)))
        self.register_buffer("nugget_width", torch.tensor(1.0))
        self.register_buffer("gain_spread", torch.tensor(0.0))
        self.register_buffer("gain_noise", torch.ones(len(distinct)))
        self.register_buffer("n_mean", None)
        self.register_buffer("v_mean", None)
        self.pixel: PixelStatistics | None = None
        self.face: FaceLoadings | None = None

    @classmethod
    def fit(
        cls,
        images: Tensor,
        lights: Tensor,
        valid: Tensor | None = None,
        options: FitOptions | None = None,
        store: ImageStore | None = None,
        **overrides: object,
    ) -> FaceStatistics:
        """Learn from ``images (N, J, H, W)`` in linear radiance under ``lights (J, 3)``.

        Args:
            images: float, 1.0 = full scale; N >= 2 subjects.
            lights: bootstrap lights, rank 3.
            valid: ``(N, J)`` bool, False where an image does not exist; None: all do.
            options: see :class:`FitOptions`; ``overrides`` replace single fields of it (``rank=8``).
            store: where to keep the images.

        Example:
            >>> lights = torch.eye(3)
            >>> FaceStatistics.fit(torch.rand(4, 3, 8, 8), lights, rank=2).n_mean.shape
            torch.Size([3, 8, 8])
        """
        if images.dim() != 4 or images.shape[1] != len(lights):
            raise ValueError(f"images: expected (N, J, H, W) with J = {len(lights)} lights, got {tuple(images.shape)}")
        settings = {**asdict(options or FitOptions()), **overrides}
        statistics = cls(lights, FitOptions(**settings), store)  # type: ignore[arg-type]
        for index, subject in enumerate(images):
            statistics.update(subject, None if valid is None else valid[index])
        return statistics.solve()

    def update(self, images: Tensor, valid: Tensor | None = None, subject: int | None = None) -> FaceStatistics:
        """Add one subject's ``images (J, H, W)``, ``valid (J,)`` saying which exist; takes effect at the next :meth:`solve`."""
        if self.store is None:
            raise RuntimeError(
                "update: these statistics were loaded, and the images they came from are not kept; fit anew"
            )
        if images.dim() != 3 or len(images) != len(self._light_index):
            raise ValueError(
                f"images: expected ({len(self._light_index)}, H, W), one image a light, got {tuple(images.shape)}"
            )
        kept = torch.ones(len(images), dtype=torch.bool) if valid is None else valid.cpu()
        if not torch.isfinite(images[kept]).all():
            raise ValueError("images: expected finite radiance, got NaN or infinity; mark missing images in `valid`")
        if images[kept].numel() and float(images[kept].abs().max()) > 20:
            raise ValueError(
                f"images: expected radiance with 1.0 = full scale, got up to {float(images[kept].max()):g}; divide by 255?"
            )
        merged = torch.full((len(self.lights), *images.shape[1:]), float("nan"))
        for light in range(len(self.lights)):
            same = kept & (self._light_index == light)
            if same.any():
                merged[light] = images[same].float().mean(0)
        self.store.add(merged, subject)
        return self

    def merge(self, other: FaceStatistics) -> FaceStatistics:
        """Add all subjects of ``other``, learned under the same lights; takes effect at the next :meth:`solve`."""
        if self.store is None or other.store is None:
            raise RuntimeError("merge: expected statistics that still keep their images; loaded ones do not")
        if self.lights.shape != other.lights.shape or not torch.allclose(self.lights, other.lights, atol=1e-5):
            raise ValueError(
                f"merge: expected the same lights, got {len(self.lights)} and {len(other.lights)} that differ"
            )
        for array in other.store:
            self.store.add(torch.from_numpy(array.copy()))
        return self

    def solve(self) -> FaceStatistics:
        """Learn every statistic from the subjects added so far."""
        if self.store is None or len(self.store) < 2:
            raise ValueError(
                f"statistics: expected at least 2 subjects, got {0 if self.store is None else len(self.store)}"
            )
        shapes = {array.shape for array in self.store}
        if len(shapes) > 1:
            raise ValueError(f"statistics: expected images of one size, got {sorted(shapes)}")
        height, width = next(iter(shapes))[1:]
        step = max(32, min(self.options.block, BLOCK_VALUES // (len(self.store) * len(self.lights))))
        grams = gather_grams(self.store, self.lights, step)
        self._choose_widths(grams)
        fill = fill_operators(grams)
        brightness: Brightness | None = None
        gram = total_gram(grams, fill)
        if self.options.brightness:
            brightness = measure_brightness(self.store, gram, fill, step)
            self.gain_spread, self.gain_noise = brightness.spread, brightness.noise
            gram = gram / torch.outer(brightness.gain, brightness.gain)
        operators = face_operators(gram, self.options.face_rank) if self.options.face_rank else None
        basis = self._light_basis(grams)
        pixels = height * width
        maps: dict[str, Tensor] = {}
        for start in range(0, pixels, step):
            block = self._learn_block(
                self.store.block(start, min(start + step, pixels)), fill, brightness, operators, basis
            )
            for name, values in block.items():
                if (
                    name not in maps
                ):  # one allocation each: small ones kept between large ones would tear the heap apart
                    maps[name] = values.new_empty(*values.shape[:-1], pixels)
                maps[name][..., start : start + values.shape[-1]] = values
        maps = {name: values.unflatten(-1, (height, width)) for name, values in maps.items()}
        self.n_mean, self.v_mean = maps["n_mean"], maps["v_mean"]
        self.pixel = PixelStatistics(maps["n_factor"], maps["v_std"], maps["v_factor"])
        if operators is not None:
            self.face = FaceLoadings(
                n=maps["face_n"],
                v=maps["face_v"],
                basis=basis,
                v_power=maps["face_power"],
                temper=torch.tensor(self.options.temper),
                residual=PixelStatistics(maps["face_n_factor"], maps["face_v_std"], maps["face_v_factor"]),
            )
        return self

    def _learn_block(
        self,
        images: Tensor,
        fill: dict[int, Tensor],
        brightness: Brightness | None,
        operators: FaceOperators | None,
        basis: Tensor,
    ) -> dict[str, Tensor]:
        """Every statistic of one block of pixels, from ``images (N, J, P)`` (4.2, 4.3)."""
        images = fill_missing(images, fill)
        if brightness is not None:
            images = images / brightness.gain[:, None, None]
        solver = torch.linalg.pinv(self.lights.double()).float()  # (3, J)
        n = solver @ images  # least squares per subject (4.2)
        v = images - self.lights @ n
        n_mean, v_mean = n.mean(0), v.mean(0)
        n_factor, v_std, v_factor = PixelStatistics.learn(n - n_mean, v - v_mean, len(n) - 1, self.options)
        maps = {"n_mean": n_mean, "v_mean": v_mean, "n_factor": n_factor, "v_std": v_std, "v_factor": v_factor}
        if operators is not None:
            residual_n = torch.einsum("ab,b...->a...", operators.residual, n)
            residual_v = torch.einsum("ab,b...->a...", operators.residual, v)
            learned = PixelStatistics.learn(residual_n, residual_v, len(n), self.options)
            maps |= dict(zip(("face_n_factor", "face_v_std", "face_v_factor"), learned, strict=True))
            loadings = torch.einsum("ka,ajp->kjp", operators.loadings, v)
            maps |= {
                "face_n": torch.einsum("ka,acp->kcp", operators.loadings, n),
                "face_v": basis @ loadings,
                "face_power": loadings.square().sum(0),
            }
        return maps

    def _choose_widths(self, grams: Grams) -> None:
        """Kernel widths in proportion to the local spacing of the lights; the factor by leaving each light out in turn."""
        distance = torch.cdist(self.lights.double(), self.lights.double())
        spacing = neighbour_widths(distance, 3)
        factor = self.options.kernel_width
        if factor is None:
            candidates = [0.2, 0.25, 0.3, 0.35, 0.4, 0.45, 0.5, 0.6, 0.7, 0.8, 1.0]
            best = min(candidates, key=lambda c: interpolation_error(grams.deviation, distance, c * spacing))
            factor = GAP_SHRINK * best
        self.light_widths = (factor * spacing).float()
        self.nugget_width = (self.options.nugget_width * spacing.median()).float()

    def _light_basis(self, grams: Grams) -> Tensor:
        """Orthonormal functions over the lights that hold most of how v varies between subjects, ``(m, J)``."""
        vectors = torch.linalg.eigh(grams.deviation_spread).eigenvectors
        return vectors[:, -min(self.options.basis, len(self.lights)) :].T.flip(0).float()

    def mean_images(self) -> Tensor:
        """The average face under every bootstrap light, ``n^T s + v`` of the means, ``(J, H, W)``."""
        return self.v_mean + torch.einsum("jc,chw->jhw", self.lights, self.n_mean)

    def weights(self, lights: Tensor) -> Tensor:
        """Kernel weights ``w(s)`` over the bootstrap lights (4.5), ``(..., 3) -> (..., J)``; below 1e-6 they are 0, so few count."""
        squared = (lights[..., None, :] - self.lights).square().sum(-1)
        weights = kernel_weights(squared, self.light_widths)
        weights = torch.where(weights > NEGLIGIBLE, weights, 0.0)
        return weights / weights.sum(-1, keepdim=True)

    def nugget(self, a: Tensor, b: Tensor) -> Tensor:
        """The narrow kernel ``k(|p - q|)`` between lights ``(A, 3)`` and ``(B, 3)``; 1 where they meet."""
        squared = (a[..., :, None, :] - b[..., None, :, :]).square().sum(-1)
        return torch.exp(-0.5 * squared / self.nugget_width**2)

    @property
    def size(self) -> tuple[int, int]:
        """Height and width of the maps, in pixels."""
        if self.n_mean is None:
            raise RuntimeError("statistics: nothing is learned yet; call solve() after adding subjects")
        return int(self.n_mean.shape[-2]), int(self.n_mean.shape[-1])

    def save(self, path: str | Path, coarseness: float = 0.0) -> None:
        """Write a safetensors file, atomically: tensors, and as metadata the format version, options and ``self.metadata``.

        With a ``coarseness`` above 0 it is compressed, see :mod:`facerelight.compression`.
        """
        _ = self.size
        write_tensors(path, self.state_dict(), {"options": asdict(self.options), **self.metadata}, coarseness)

    @classmethod
    def load(cls, path: str | Path) -> FaceStatistics:
        """Read what :meth:`save` wrote.

        Raises:
            ValueError: no such file, not a statistics file, of an unknown version, or with tensors missing, misshapen or not finite.
        """
        tensors, header = read_tensors(path)
        try:
            options = header.pop("options")
            statistics = cls(tensors["lights"], FitOptions(**options))  # type: ignore[arg-type]
        except (KeyError, TypeError, ValueError) as error:
            raise ValueError(
                f"{path}: expected the options and lights of a fit, got {error}; train anew with `facerelight train`"
            ) from error
        statistics.store, statistics.metadata = None, header

        def pixel(prefix: str) -> PixelStatistics:
            return PixelStatistics(*(tensors[f"{prefix}.{name}"] for name in ("n_factor", "v_std", "v_factor")))

        for name in ("lights", "light_widths", "nugget_width", "gain_spread", "gain_noise", "n_mean", "v_mean"):
            setattr(statistics, name, tensors[name])
        statistics.pixel = pixel("pixel")
        if "face.n" in tensors:
            parts = {name: tensors[f"face.{name}"] for name in ("n", "v", "basis", "v_power", "temper")}
            statistics.face = FaceLoadings(**parts, residual=pixel("face.residual"))
        return statistics

    def describe(self) -> dict[str, object]:
        """What ``facerelight train`` reports: size, lights, spacing, the kernel width chosen, ranks."""
        spacing = angular_distance(self.lights[:, None].double(), self.lights[None].double()).kthvalue(2, dim=-1).values
        return {
            "height": self.size[0],
            "width": self.size[1],
            "lights": len(self.lights),
            "median_spacing_deg": float(spacing.median()),
            "kernel_width": float(torch.rad2deg(self.light_widths.median())),
            "rank": self.options.rank if self.pixel is None else self.pixel.v_factor.shape[1],
            "face_rank": 0 if self.face is None else len(self.face.n),
            "temper": self.options.temper,
        }
