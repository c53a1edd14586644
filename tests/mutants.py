"""Faults put into a copy of the package, one at a time: do the tests see them?

``python tests/mutants.py`` runs all, ``python tests/mutants.py 3 temper`` those of these numbers and names; by hand,
for it takes minutes. Faults are in what is learned or scaled, where no shape or dtype gives them away.
"""

import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[1]
COPIED = ("facerelight", "tests", "configs", "pyproject.toml")
KILLED, SURVIVED = 1, 0  # how pytest exits where a test failed, and where none did
SECONDS = 300


class Mutant(NamedTuple):
    """In ``file`` of the package, ``old``, which occurs once, becomes ``new``; ``tests`` are to notice."""

    name: str
    file: str
    old: str
    new: str
    tests: str


PERSON, VARIANCE = "inference/person.py", "inference/test_variance.py"
LEARNING, COMPRESSION = "model/test_learning.py", "model/compression.py"

MUTANTS = (
    Mutant("gain prior", "model/brightness.py", "1 / spread**2 + ones @ ones", "ones @ ones", VARIANCE),
    Mutant("gain squared in the variance", PERSON, "gain.value**2 * (variance", "gain.value * (variance", VARIANCE),
    Mutant("scale of the loadings", "model/subjects.py", "(scale * values / (count", "(values / (count", LEARNING),
    Mutant(
        "sign of the light's bias",
        "light/kernel.py",
        "direction + self.bias",
        "direction - self.bias",
        "light/test_kernel.py",
    ),
    Mutant(
        "variance that the basis loses",
        "model/light_terms.py",
        "positive_root(near @ of_lights(face.v_power",
        "0 * positive_root(near @ of_lights(face.v_power",
        VARIANCE,
    ),
    Mutant(
        "lamps at the side",
        "bootstrap/domain.py",
        "1 + side_light",
        "1 - side_light",
        "bootstrap/test_lamp.py",
    ),
    Mutant(
        "lamps above",
        "bootstrap/domain.py",
        "1 + top_light",
        "1 - top_light",
        "bootstrap/test_lamp.py",
    ),
    Mutant(
        "exposure of a photograph",
        "photo/face_model.py",
        ".clamp_min(0) * self.exposure).numpy()",
        ".clamp_min(0)).numpy()",
        "photo/test_face_model.py",
    ),
    Mutant(
        "amount of block shrinkage",
        "numerics/shrinkage.py",
        "torch.where(signal > 0, noise /",
        "torch.where(signal > 0, 0.5 * noise /",
        "numerics/test_scales.py",
    ),
    Mutant(
        "evidence of a view",
        "viewpoint/whole_face.py",
        "- 2 * temper * spread",
        "+ 2 * temper * spread",
        "viewpoint/test_evidence.py",
    ),
    Mutant("temper of a person's code", PERSON, "float(self.face.temper)", "1.0", VARIANCE),
    Mutant(
        "noise divided by gain",
        PERSON,
        "observed(covariance, noise.T / gain)",
        "observed(covariance, noise.T)",
        VARIANCE,
    ),
    Mutant(
        "noise of a new image",
        PERSON,
        "gain.spread**2 * black.square()) + self.noise_variance",
        "gain.spread**2 * black.square())",
        VARIANCE,
    ),
    Mutant(
        "what is not known of the gain",
        PERSON,
        "(variance + gain.spread**2 * black.square())",
        "(variance)",
        VARIANCE,
    ),
    Mutant(
        "variance behind the face",
        PERSON,
        "new[:, None] * self._components(at_edge).variance",
        "0 * new[:, None]",
        "test_hard_cases.py -k pixel-float32-lights-in-the",
    ),
    Mutant(
        "errors of lights together",
        "numerics/kernels.py",
        "torch.exp(-0.5 * squared / reach**2)",
        "torch.exp(-squared / reach**2)",
        "light/test_kernel.py",
    ),
    Mutant(
        "size of a light's error",
        "light/kernel.py",
        "covariance_factor(error - bias, max(",
        "covariance_factor(error - bias, 2 * max(",
        "light/test_kernel.py",
    ),
    Mutant("width of the kernel", "model/learning.py", "GAP_SHRINK * best", "best", LEARNING),
    Mutant(
        "floor of the deviation",
        "model/learning.py",
        ".clamp_min(options.floor)",
        ".clamp_min(options.floor**2)",
        LEARNING,
    ),
    Mutant(
        "pixels that count as one",
        "numerics/gaussian.py",
        "safe_cholesky(eye + rows.T @ rows / temper)",
        "safe_cholesky(eye + rows.T @ rows)",
        "numerics/test_scales.py",
    ),
    Mutant(
        "gain squared with a fixed normal",
        "inference/maximum_likelihood.py",
        "gain**2 * (variance",
        "gain * (variance",
        VARIANCE,
    ),
    Mutant(
        "noise of a gain's reading",
        "model/subjects.py",
        ".clamp_min(1e-3).log().std(0)",
        ".clamp_min(1e-3).std(0) / 2",
        LEARNING,
    ),
    Mutant(
        "noise of a dim photograph",
        "photo/face_model.py",
        "scale * math.hypot(self.relighter.noise, MISFIT)",
        "torch.ones_like(scale) * math.hypot(self.relighter.noise, MISFIT)",
        "photo/test_face_model.py",
    ),
    Mutant(
        "strength of a photograph's light",
        "photo/face_model.py",
        "(amounts[kept] / self.exposure)",
        "(amounts[kept])",
        "photo/test_face_model.py",
    ),
    Mutant(
        "sign of what the loadings miss, compressed",
        COMPRESSION,
        "lost.sign() * lost.abs().sqrt()",
        "lost.abs().sqrt()",
        "model/test_compression.py -k comes_back",
    ),
    Mutant(
        "turning the columns of a factor",
        COMPRESSION,
        "rows @ (left @ right)",
        "rows @ (left @ right).mT",
        "model/test_compression.py -k columns",
    ),
    Mutant(
        "scale of unpacked deviations",
        COMPRESSION,
        'tensors.pop(f"{part}v_log_std").exp_()',
        'tensors.pop(f"{part}v_log_std").exp_().mul_(1.1)',
        "model/test_compression.py -k comes_back",
    ),
)


def outcome(folder: Path, tests: str) -> int:
    """How pytest exits on ``tests`` with the package in ``folder``."""
    there = {
        **os.environ,
        "PYTHONPATH": str(folder),
        "PYTHONDONTWRITEBYTECODE": "1",
    }  # a mutant's bytecode is no other's
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", *tests.split()]
    command[7] = f"tests/{command[7]}"
    try:
        done = subprocess.run(command, cwd=folder, env=there, capture_output=True, text=True, timeout=SECONDS)
    except subprocess.TimeoutExpired:
        return KILLED
    if done.returncode not in (KILLED, SURVIVED):
        raise RuntimeError(f"{tests}: pytest ended with {done.returncode}\n{done.stdout[-2000:]}{done.stderr[-2000:]}")
    return done.returncode


def survives(folder: Path, mutant: Mutant) -> bool:
    """Whether the tests pass with ``mutant`` in the copy in ``folder``, which is as before afterwards."""
    path = folder / "facerelight" / mutant.file
    text = path.read_text()
    if text.count(mutant.old) != 1:
        raise RuntimeError(f"{mutant.name}: {mutant.old!r} occurs {text.count(mutant.old)} times in {mutant.file}")
    path.write_text(text.replace(mutant.old, mutant.new))
    try:
        return outcome(folder, mutant.tests) == SURVIVED
    finally:
        path.write_text(text)


def copied(folder: Path) -> Path:
    """A copy of the package and its tests in ``folder``."""
    for name in COPIED:
        if (ROOT / name).is_dir():
            shutil.copytree(ROOT / name, folder / name, ignore=shutil.ignore_patterns("__pycache__"))
        else:
            shutil.copy(ROOT / name, folder / name)
    return folder


def main(asked: list[str]) -> int:
    """Print the table; 1 where a mutant survived."""
    chosen = [
        m
        for i, m in enumerate(MUTANTS, 1)
        if not asked or str(i) in asked or any(a in m.name for a in asked if not a.isdigit())
    ]
    alive = 0
    with tempfile.TemporaryDirectory() as scratch:
        folder = copied(Path(scratch))
        for tests in sorted({mutant.tests for mutant in chosen}):
            if outcome(folder, tests) != SURVIVED:
                raise RuntimeError(f"{tests}: fails without any mutant")
        print("| fault | in | seen by | |\n|---|---|---|---|")
        for mutant in chosen:
            lives = survives(folder, mutant)
            alive += lives
            print(
                f"| {mutant.name} | `{mutant.file}` | `{mutant.tests}` | {'survived' if lives else 'killed'} |",
                flush=True,
            )
    print(f"\n{len(chosen) - alive} of {len(chosen)} killed")
    return int(alive > 0)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
