"""Relative error of a conditional mean against the condition number of its covariance: float32, the package, and
60-digit arithmetic.

python scripts/figures/conditioning.py --output conditioning.png

The covariances are those of images under K = 4 lights that draw nearer to each other, as in the model: smooth terms and
a narrow kernel.
"""

import warnings

import mpmath
import numpy as np
import torch
from matplotlib.figure import Figure

from facerelight.evaluation.results import ScriptParser
from facerelight.model.covariance import MEASUREMENT, observed
from facerelight.numerics.gaussian import NumericalWarning, condition_gaussian


def covariance(separation: float) -> mpmath.matrix:
    """Joint covariance of one target and four inputs ``separation`` apart, in 60 digits, with the model's measurement
    variance."""
    place = [mpmath.mpf(3) / 10, *(k * mpmath.mpf(separation) for k in range(4))]

    def kernel(a: mpmath.mpf, b: mpmath.mpf) -> mpmath.mpf:
        square = (a - b) ** 2 / 2
        return mpmath.exp(-square / mpmath.mpf("0.16")) + mpmath.exp(-square / mpmath.mpf("0.0025")) / 10

    return mpmath.matrix([[kernel(a, b) for b in place] for a in place])


def sweep() -> list[tuple[float, float, float]]:
    """Condition number without the measurement variance, error of float32, error of the package; separations from 0.3
    to 1e-7."""
    rows = []
    generator = np.random.default_rng(0)
    with mpmath.workdps(60):
        for separation in np.geomspace(0.3, 1e-7, 60):
            joint = covariance(float(separation))
            inputs = joint[1:, 1:].copy()
            values = mpmath.eigsy(inputs, eigvals_only=True)
            condition = float(max(values) / min(values))
            draws = mpmath.matrix(generator.standard_normal(4).tolist())
            y = mpmath.cholesky(inputs) * draws  # as likely as the model says
            y = mpmath.matrix([float(np.float32(float(v))) for v in y])
            seen = inputs.copy()
            for k in range(4):
                seen[k, k] *= 1 + mpmath.mpf(MEASUREMENT)
            truth = float((joint[0, 1:] * mpmath.lu_solve(seen, y))[0])
            double = torch.tensor([[float(joint[i, j]) for j in range(5)] for i in range(5)], dtype=torch.float64)
            values_y = torch.tensor([float(v) for v in y], dtype=torch.float64)
            noisy = observed(double[1:, 1:])
            try:
                plain = float(double[0, 1:].float() @ torch.linalg.solve(noisy.float(), values_y.float()))
            except RuntimeError:
                plain = float("nan")
            zero = torch.zeros(1, dtype=torch.float64)
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", NumericalWarning)
                ours = float(
                    condition_gaussian(zero, torch.zeros(4), double[:1, :1], double[:1, 1:], noisy, values_y).mean
                )
            scale = max(abs(truth), 1e-3)
            rows.append((condition, abs(plain - truth) / scale, abs(ours - truth) / scale))
    return rows


def main() -> None:
    parser = ScriptParser(__file__, __doc__)
    parser.add_argument("--output", required=True)
    parser.add_results("csv")
    args = parser.parse_args()
    rows = sweep()
    names = ("condition", "float32", "facerelight")
    parser.save_rows(args.csv, [dict(zip(names, row, strict=True)) for row in rows])
    figure = Figure(figsize=(5, 3), layout="constrained")
    axis = figure.subplots()
    condition, plain, ours = zip(*rows, strict=True)
    axis.loglog(condition, np.maximum(plain, 1e-17), ".", label="float32 solve")
    axis.loglog(condition, np.maximum(ours, 1e-17), ".", label="facerelight (float64 Cholesky, jitter where needed)")
    axis.axhline(1 / 255, color="k", linewidth=0.6)
    axis.text(min(condition), 1.3 / 255, "a grey level", fontsize=7)
    axis.set_xlabel("condition number of the inputs' covariance")
    axis.set_ylabel("relative error of the mean")
    axis.legend(fontsize=7)
    figure.savefig(args.output)
    for low in 10.0 ** np.arange(0, 45, 3):
        inside = [(p, o) for c, p, o in rows if low <= c < 1e3 * low]
        if inside:
            print(
                f"condition {low:.0e} to {1e3 * low:.0e}: float32 {max(p for p, _ in inside):.1e},"
                f" facerelight {max(o for _, o in inside):.1e}"
            )


if __name__ == "__main__":
    main()
