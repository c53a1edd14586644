"""Slow float64 NumPy versions of the thesis's equations, one pixel at a time, written from the text and not from the
package."""

import numpy as np


def fit(images: np.ndarray, lights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(4.2) for one pixel: ``images (N, J)``, ``lights (J, 3)`` -> n ``(N, 3)``, v ``(N, J)``."""
    n = np.array([np.linalg.lstsq(lights, row, rcond=None)[0] for row in images])
    return n, images - n @ lights.T


class Pixel:
    """(3.16), (3.17) for one pixel with the completed correlation of the design."""

    def __init__(self, statistics, y: int, x: int, residual: bool = False) -> None:
        parts = statistics.face.residual if residual else statistics.pixel
        self.lights = statistics.lights.double().numpy()
        self.widths = statistics.light_widths.double().numpy()
        self.narrow = float(statistics.nugget_width)
        self.n_mean = statistics.n_mean[:, y, x].double().numpy()
        self.v_mean = statistics.v_mean[:, y, x].double().numpy()
        factor = parts.n_factor[..., y, x].double().numpy()
        self.n_cov = factor @ factor.T
        self.std = parts.v_std[:, y, x].double().numpy()
        learned = parts.v_factor[..., y, x].double().numpy()
        self.correlation = learned @ learned.T + np.diag(1 - (learned**2).sum(1))

    def weights(self, s: np.ndarray) -> np.ndarray:
        kernel = np.exp(-0.5 * ((s - self.lights) ** 2).sum(1) / self.widths**2)
        return kernel / kernel.sum()

    def mean(self, s: np.ndarray) -> float:
        return float(s @ self.n_mean + self.weights(s) @ self.v_mean)

    def covariance(self, p: np.ndarray, q: np.ndarray) -> float:
        wp, wq = self.weights(p), self.weights(q)
        rho = wp @ self.correlation @ wq
        gap_p, gap_q = 1 - wp @ self.correlation @ wp, 1 - wq @ self.correlation @ wq
        rho += np.sqrt(max(gap_p, 0) * max(gap_q, 0)) * np.exp(-0.5 * ((p - q) ** 2).sum() / self.narrow**2)
        return float(p @ self.n_cov @ q + np.sqrt(wp @ self.std**2) * np.sqrt(wq @ self.std**2) * rho)

    def relight(self, y: np.ndarray, sources: np.ndarray, target: np.ndarray) -> tuple[float, float]:
        r_yy = np.array([[self.covariance(a, b) for b in sources] for a in sources])
        r_xy = np.array([self.covariance(target, a) for a in sources])
        solved = np.linalg.solve(r_yy, y - np.array([self.mean(s) for s in sources]))
        mean = self.mean(target) + r_xy @ solved
        variance = self.covariance(target, target) - r_xy @ np.linalg.solve(r_yy, r_xy)
        return float(mean), float(variance)
