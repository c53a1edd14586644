"""Properties that hold for any light, image and person (hypothesis), and across devices, threads and compilation."""

import copy
import runpy
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from conftest import SIZE, shaded_people
from hypothesis import given, settings
from hypothesis import strategies as st

from facerelight.geometry.lights import even_hemisphere
from facerelight.inference.relighter import StatisticalRelighter
from facerelight.light.kernel import KernelIlluminationEstimator
from facerelight.model.statistics import FaceStatistics

MIRROR = torch.tensor([-1.0, 1.0, 1.0])


def random_lights(count: int, seed: int) -> torch.Tensor:
    lights = torch.randn(count, 3, generator=torch.Generator().manual_seed(seed))
    return torch.nn.functional.normalize(
        lights * torch.tensor([1.0, 1.0, 0.0]) + lights[:, 2:].abs() * torch.tensor([0.0, 0.0, 1.0]), dim=-1
    )


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 10_000), inputs=st.integers(1, 6), covariance=st.sampled_from(["pixel", "face"]))
def test_variance_lies_between_zero_and_the_prior(
    statistics: FaceStatistics, people: torch.Tensor, lights: torch.Tensor, seed: int, inputs: int, covariance: str
) -> None:
    relighter = StatisticalRelighter(statistics, covariance)  # type: ignore[arg-type]
    sources, targets = random_lights(inputs, seed), random_lights(3, seed + 1)
    images = torch.rand(1, inputs, *SIZE, generator=torch.Generator().manual_seed(seed))
    prior = relighter(images[:, :1], targets, source_lights=torch.zeros(1, 3)).variance
    posterior = relighter(images, targets, source_lights=sources).variance
    assert (posterior >= 0).all()
    assert (posterior <= prior * (1 + 1e-5) + 1e-9).all()


@settings(max_examples=10, deadline=None)
@given(order=st.permutations(range(4)), covariance=st.sampled_from(["pixel", "face"]))
def test_the_order_of_the_inputs_does_not_matter(
    statistics: FaceStatistics, people: torch.Tensor, lights: torch.Tensor, order: list[int], covariance: str
) -> None:
    relighter = StatisticalRelighter(statistics, covariance)  # type: ignore[arg-type]
    plain = relighter(people[12:14, :4], lights[7:9], source_lights=lights[:4])
    shuffled = relighter(people[12:14, order], lights[7:9], source_lights=lights[order])
    assert torch.allclose(plain.mean, shuffled.mean, atol=1e-5)
    assert torch.allclose(plain.variance, shuffled.variance, atol=1e-6)


@pytest.mark.parametrize("covariance", ["pixel", "face"])
def test_a_mirrored_world_gives_the_mirrored_answer(covariance: str) -> None:
    half = even_hemisphere(12)
    lights = torch.cat((half + torch.tensor([0.11, 0.0, 0.0]), (half + torch.tensor([0.11, 0.0, 0.0])) * MIRROR))
    lights = torch.nn.functional.normalize(lights, dim=-1)
    people = shaded_people(9, lights, 0)
    swap = torch.cat((torch.arange(12, 24), torch.arange(12)))
    everybody = torch.cat((people[:8], people[:8, swap].flip(-1)))
    statistics = FaceStatistics.fit(everybody, lights, rank=24, face_rank=4, basis=24)
    relighter = StatisticalRelighter(statistics, covariance)  # type: ignore[arg-type]
    source, target = random_lights(1, 5), random_lights(2, 6)
    image = people[8:9, :1]
    plain = relighter(image, target, source_lights=source)
    mirrored = relighter(image.flip(-1), target * MIRROR, source_lights=source * MIRROR)
    assert torch.allclose(mirrored.mean.flip(-1), plain.mean, atol=2e-4)
    assert torch.allclose(mirrored.variance.flip(-1), plain.variance, atol=2e-4)


@settings(max_examples=8, deadline=None)
@given(scale=st.floats(0.1, 8.0))
def test_a_brighter_world_gives_a_brighter_answer(people: torch.Tensor, lights: torch.Tensor, scale: float) -> None:
    """Statistics and input scaled alike scale the output (the deviation's floor and the noise with them)."""
    options = {"rank": 6, "face_rank": 3, "basis": 12}
    plain = FaceStatistics.fit(people[:12], lights, floor=2e-3, **options)
    bright = FaceStatistics.fit(people[:12] * scale, lights, floor=2e-3 * scale, **options)
    image, targets = people[12:13, :1], lights[[0, 9]]
    a = StatisticalRelighter(plain, "face")(image, targets, source_lights=lights[:1])
    b = StatisticalRelighter(bright, "face", noise=scale)(image * scale, targets, source_lights=lights[:1])
    assert torch.allclose(b.mean, scale * a.mean, atol=2e-4 * scale)
    assert torch.allclose(b.variance, scale**2 * a.variance, atol=1e-5 * scale**2)


def test_error_against_the_condition_number() -> None:
    """Against 60-digit arithmetic: the package stays below 1e-6 where a float32 solve is wrong by more than 1 %."""
    rows = runpy.run_path(str(Path(__file__).parent.parent / "scripts" / "figures" / "conditioning.py"))["sweep"]()
    assert max(condition for condition, _, _ in rows) > 1e30
    assert max(ours for _, _, ours in rows) < 1e-6
    assert max(plain for condition, plain, _ in rows if condition < 1e9) > 1e-2


def relit(relighter: StatisticalRelighter, people: torch.Tensor, lights: torch.Tensor) -> torch.Tensor:
    posterior = relighter.condition(people[12:14, 3:5], draws=4)
    return torch.stack((posterior.mean(lights[:5]), posterior.variance(lights[:5])))


@pytest.fixture(scope="module")
def relighter(statistics: FaceStatistics, people: torch.Tensor, lights: torch.Tensor) -> StatisticalRelighter:
    return StatisticalRelighter(copy.deepcopy(statistics), "face", KernelIlluminationEstimator.fit(people[:12], lights))


def test_the_number_of_threads_does_not_matter(
    relighter: StatisticalRelighter, people: torch.Tensor, lights: torch.Tensor
) -> None:
    before = torch.get_num_threads()
    answers = []
    for threads in (1, 2, 4):
        torch.set_num_threads(threads)
        answers.append(relit(relighter, people, lights))
    torch.set_num_threads(before)
    assert torch.allclose(answers[0], answers[1], atol=1e-5)
    assert torch.allclose(answers[0], answers[2], atol=1e-5)


def test_compiled_equals_plain(relighter: StatisticalRelighter, people: torch.Tensor, lights: torch.Tensor) -> None:
    """The renderer under torch.compile's tracer (no C++ compiler needed), where it can be traced and where it falls
    back."""
    posterior = relighter.condition(people[12:13, :2], lights[:2])
    compiled = torch.compile(posterior.mean, backend="eager")
    assert torch.allclose(compiled(lights[:5]), posterior.mean(lights[:5]), atol=1e-6)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
def test_a_gpu_gives_the_same(relighter: StatisticalRelighter, people: torch.Tensor, lights: torch.Tensor) -> None:
    there = copy.deepcopy(relighter).to("cuda")
    assert torch.allclose(relit(there, people.cuda(), lights.cuda()).cpu(), relit(relighter, people, lights), atol=1e-4)


def test_import_is_silent_and_starts_no_renderer() -> None:
    code = (
        "import sys, facerelight, facerelight.cli, facerelight.viewpoint.pose;"
        "print([m for m in ('pyrender', 'trimesh', 'scipy') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-W", "error", "-c", code], capture_output=True, text=True, timeout=120)
    assert done.stderr == ""
    assert done.stdout.strip() == "[]"
