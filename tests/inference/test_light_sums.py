"""Sums of lights in the core: one lamp as their special case, exact superposition, and hard cases."""

import time
from collections.abc import Callable

import pytest
import torch

from facerelight.geometry.lights import even_hemisphere, light_from_angles
from facerelight.geometry.sources import Lamp, fill_light, scene_light
from facerelight.geometry.sums import LightSum
from facerelight.inference.relighter import StatisticalRelighter
from facerelight.model.covariance import image_covariance
from facerelight.model.light_terms import light_terms, loadings_at
from facerelight.model.statistics import FaceStatistics
from facerelight.numerics.gaussian import condition_gaussian

MODELS = ("pixel", "face")
TARGETS = torch.nn.functional.normalize(torch.tensor([[0.3, 0.2, 0.9], [-0.7, 0.1, 0.6], [0.1, 0.8, 0.5]]), dim=1)


@pytest.fixture(scope="module", params=[False, True], ids=["plain", "brightness"])
def learned(request: pytest.FixtureRequest, people: torch.Tensor, lights: torch.Tensor) -> FaceStatistics:
    return FaceStatistics.fit(people[:12], lights, rank=6, face_rank=5, temper=10.0, basis=12, brightness=request.param)


def window(lights: torch.Tensor) -> torch.Tensor:
    """Amounts of ``lights`` that sum to 1."""
    towards = light_from_angles(40.0, 10.0)
    amounts = torch.exp(-4 * (lights - towards).square().sum(1))
    return amounts / amounts.sum()


def wobbly(seed: int, count: int) -> LightSum:
    """One light of ``count`` directions between the bootstrap's."""
    generator = torch.Generator().manual_seed(seed)
    directions = torch.randn(count, 3, generator=generator)
    directions[:, 2] = directions[:, 2].abs() + 0.2
    return LightSum(torch.nn.functional.normalize(directions, dim=1), torch.rand(1, count, generator=generator) / count)


@pytest.mark.parametrize("covariance", MODELS)
def test_a_sum_of_one_is_a_single_light(learned: FaceStatistics, people: torch.Tensor, covariance: str) -> None:
    relighter = StatisticalRelighter(learned, covariance)
    source, images = even_hemisphere(30)[4:6] + 0.0, people[12:14, 4:6]
    plain = relighter.condition(images, source)
    for sums in (LightSum.single(source), LightSum(source, torch.eye(2))):
        summed = relighter.condition(images, sums)
        for what in ("mean", "variance", "mode"):
            expected = getattr(plain, what)(TARGETS)
            for goal in (TARGETS, LightSum.single(TARGETS), LightSum(TARGETS, torch.eye(3))):
                assert torch.allclose(getattr(summed, what)(goal), expected, atol=1e-5)


@pytest.mark.parametrize("covariance", MODELS)
def test_the_whole_is_the_joint_gaussian_of_its_directions(
    statistics: FaceStatistics, people: torch.Tensor, covariance: str
) -> None:
    """Mean and variance by the theorem, from the covariance of all single directions; two inputs, each its own sum."""
    first, second, goal = wobbly(0, 7), wobbly(1, 5), wobbly(2, 6)
    every = torch.cat((first.directions, second.directions, goal.directions))
    observed = torch.zeros(2, len(every))
    observed[0, :7], observed[1, 7:12] = first.amounts[0], second.amounts[0]
    asked = torch.zeros(1, len(every))
    asked[0, 12:] = goal.amounts[0]
    images = people[12:13, :2] * 0.6
    relighter = StatisticalRelighter(statistics, covariance)
    posterior = relighter.condition(images, LightSum(every, observed))
    face = statistics.face if covariance == "face" else None
    pixel = statistics.pixel if face is None else face.residual
    terms = light_terms(statistics, pixel, every, face)
    joint = image_covariance(statistics, pixel, terms, terms)  # (P, D, D)
    a, b = observed.double(), asked.double()
    noise = relighter.noise / 255
    mean_y, mean_x = a @ terms.mean.double(), b @ terms.mean.double()  # (., P)
    y = images[0].flatten(1).double()
    r_yy, r_xy, r_xx = a @ joint @ a.T, b @ joint @ a.T, b @ joint @ b.T
    r_yy = r_yy + torch.diag_embed(1e-8 * r_yy.diagonal(dim1=1, dim2=2) + noise**2)
    if face is None:
        expected = condition_gaussian(mean_x.T, mean_y.T, r_xx, r_xy, r_yy, y.T)
        assert torch.allclose(
            posterior.variance(goal).flatten().double(), expected.covariance.flatten() + noise**2, rtol=1e-3
        )
        assert torch.allclose(posterior.mean(goal).flatten().double(), expected.mean[:, 0].clamp_min(0), atol=1e-5)
        return
    loads = loadings_at(face, terms).double()  # (D, k, P)
    white = torch.linalg.solve(r_yy, torch.einsum("kd,dcp->pkc", a, loads))  # (P, K, k)
    rows = torch.einsum("kd,dcp->pkc", a, loads)
    temper = float(face.temper)
    precision = torch.eye(loads.shape[1]).double() + torch.einsum("pkc,pkd->cd", rows, white) / temper
    code = torch.linalg.solve(precision, torch.einsum("pkc,kp->c", white, y - mean_y) / temper)
    left = y - mean_y - torch.einsum("kd,dcp,c->kp", a, loads, code)
    mean = mean_x[0] + torch.einsum("d,dcp,c->p", b[0], loads, code)
    mean = mean + (r_xy @ torch.linalg.solve(r_yy, left.T[..., None]))[:, 0, 0]
    assert torch.allclose(posterior.mean(goal).flatten().double(), mean.clamp_min(0), atol=1e-5)


@pytest.mark.parametrize("covariance", MODELS)
def test_light_adds_up(learned: FaceStatistics, people: torch.Tensor, covariance: str) -> None:
    source, one, other = wobbly(3, 9), wobbly(4, 8), wobbly(5, 6)
    person = StatisticalRelighter(learned, covariance).condition(people[12:13, :1], source).people[0]
    both = LightSum(
        torch.cat((one.directions, other.directions)), torch.cat((2.5 * one.amounts, 0.3 * other.amounts), 1)
    )
    assert torch.allclose(person.mean(both), 2.5 * person.mean(one) + 0.3 * person.mean(other), atol=1e-6)


@pytest.mark.parametrize("covariance", MODELS)
@pytest.mark.parametrize("register", [False, True])
def test_the_photo_under_its_own_light_comes_back(
    learned: FaceStatistics, people: torch.Tensor, lights: torch.Tensor, covariance: str, register: bool
) -> None:
    light = LightSum(lights, window(lights)[None])
    photo = torch.tensordot(light.amounts, people[13], 1)[None]
    relighter = StatisticalRelighter(learned, covariance, noise=0.0)
    posterior = relighter.condition(photo, light, register=register)
    tolerance = 0.05 if register else 1e-4  # there and back by bicubic interpolation
    assert torch.allclose(posterior.mean(light), photo, atol=tolerance)
    assert float(posterior.variance(light).max()) < 1e-5


def test_knowing_the_whole_light_is_better_than_its_middle(
    learned: FaceStatistics, people: torch.Tensor, lights: torch.Tensor
) -> None:
    light = LightSum(lights, window(lights)[None])
    photo = torch.einsum("qj,njhw->nqhw", light.amounts, people[12:])
    relighter = StatisticalRelighter(learned, "face")
    middle = torch.nn.functional.normalize(light.vector, dim=1)
    whole, single = (relighter.condition(photo, given).mean(lights) - people[12:] for given in (light, middle))
    assert float(whole.square().mean()) < float(single.square().mean())


def test_a_scene_is_a_light(learned: FaceStatistics, people: torch.Tensor) -> None:
    scene = scene_light([Lamp(40, 20), Lamp(-60, 0, power=0.3)], fill=0.1)
    posterior = StatisticalRelighter(learned).condition(people[12:13, :1], scene)
    assert torch.allclose(posterior.mean(scene), posterior.mean(LightSum.of(scene)))
    assert posterior.mean(scene).shape == (1, 1, *learned.size)


def test_every_person_and_hypothesis_may_have_its_own(learned: FaceStatistics, people: torch.Tensor) -> None:
    lights = even_hemisphere(30)
    generator = torch.Generator().manual_seed(1)
    amounts = torch.rand(2, 3, 2, 30, generator=generator) / 30
    relighter = StatisticalRelighter(learned, "face")
    images = people[12:14, :2] / 2
    shared = relighter.condition(images, LightSum(lights, amounts))
    apart = relighter.condition(images, LightSum(lights.expand(2, 3, 2, -1, -1), amounts))
    for what in ("mean", "variance"):
        assert torch.allclose(getattr(shared, what)(TARGETS), getattr(apart, what)(TARGETS), rtol=1e-3, atol=1e-5)


def test_three_sums_tell_the_normal(learned: FaceStatistics, people: torch.Tensor, lights: torch.Tensor) -> None:
    """The special case without a prior: sums of one are single lights, and a sum comes back."""
    relighter = StatisticalRelighter(learned, noise=0.0)
    images = people[12:13, [1, 5, 9]]
    plain = relighter(images, TARGETS, lights[[1, 5, 9]], method="mle")
    summed = relighter(images, TARGETS, LightSum(lights[[1, 5, 9]], torch.eye(3)), method="mle")
    assert torch.allclose(plain.mean, summed.mean, atol=1e-5)
    light = LightSum(lights, torch.eye(30)[[1, 5, 9]] * 0.5 + torch.eye(30)[[2, 6, 12]] * 0.5)
    images = torch.tensordot(light.amounts, people[12], 1)[None]
    assert torch.allclose(relighter(images, light, light, method="mle").mean, images, atol=1e-4)


def test_gradients_pass_through_sums(learned: FaceStatistics, people: torch.Tensor) -> None:
    small = FaceStatistics.fit(people[:8, :, 4::9, 3::8], even_hemisphere(30), rank=3, face_rank=3, temper=2.0).double()
    relighter = StatisticalRelighter(small, "face")
    source, goal = wobbly(6, 4), wobbly(7, 3)
    inputs = [t.double().requires_grad_() for t in (source.directions, source.amounts, goal.directions, goal.amounts)]
    images = people[9:10, :1, 4::9, 3::8].double()

    def render(*parts: torch.Tensor) -> torch.Tensor:
        posterior = relighter.condition(images, LightSum(*parts[:2]))
        return torch.cat(posterior.render(LightSum(*parts[2:])))

    assert torch.autograd.gradcheck(render, tuple(inputs), atol=1e-6, rtol=1e-3)


# hard cases


def _bad(change: Callable[[LightSum], LightSum]) -> Callable[[FaceStatistics, torch.Tensor], None]:
    def check(learned: FaceStatistics, people: torch.Tensor) -> None:
        relighter, light = StatisticalRelighter(learned, "face"), change(wobbly(0, 5))
        with pytest.raises(ValueError, match="expected"):
            relighter.condition(people[12:13, :1], light)
        with pytest.raises(ValueError, match="expected"):
            relighter.condition(people[12:13, :1], even_hemisphere(1)).mean(light)

    return check


@pytest.mark.parametrize(
    "change",
    [
        lambda s: LightSum(s.directions, -s.amounts),
        lambda s: LightSum(s.directions, s.amounts * torch.nan),
        lambda s: LightSum(s.directions, s.amounts / 0),
        lambda s: LightSum(0 * s.directions, s.amounts),
        lambda s: LightSum(s.directions[:3], s.amounts),
        lambda s: LightSum(s.directions, s.amounts.long()),
    ],
    ids=["negative", "nan", "infinite", "no directions", "shapes", "integers"],
)
def test_amounts_that_are_none(
    learned: FaceStatistics, people: torch.Tensor, change: Callable[[LightSum], LightSum]
) -> None:
    _bad(change)(learned, people)


@pytest.mark.parametrize("covariance", MODELS)
@pytest.mark.parametrize("strength", [0.0, 1e-6, 1e6])
def test_any_strength(learned: FaceStatistics, people: torch.Tensor, covariance: str, strength: float) -> None:
    light = wobbly(0, 5)
    strong = LightSum(light.directions, light.amounts * strength)
    relighter = StatisticalRelighter(learned, covariance)
    posterior = relighter.condition(people[12:13, :1], strong)
    assert all(torch.isfinite(part).all() for part in posterior.render(TARGETS))
    seen = relighter.condition(people[12:13, :1], light).render(strong)
    assert all(torch.isfinite(part).all() for part in seen)
    if strength == 0:  # no light, no evidence; and a dark picture
        nothing = relighter.condition(people[12:13, :1], torch.zeros(1, 3))
        assert torch.equal(posterior.mean(TARGETS), nothing.mean(TARGETS))
        assert not seen.mean.any()


@pytest.mark.parametrize("covariance", MODELS)
def test_a_direction_given_twice_counts_twice(learned: FaceStatistics, people: torch.Tensor, covariance: str) -> None:
    source = light_from_angles(33.0, 12.0)[None]
    relighter = StatisticalRelighter(learned, covariance)
    once = relighter.condition(people[12:13, :1], source).render(TARGETS)
    twice = relighter.condition(people[12:13, :1], LightSum(source.expand(2, 3), torch.tensor([[0.25, 0.75]]))).render(
        TARGETS
    )
    for a, b in zip(once, twice, strict=True):
        assert torch.allclose(a, b, atol=1e-5)


@pytest.mark.parametrize("covariance", MODELS)
def test_all_light_from_behind(learned: FaceStatistics, people: torch.Tensor, covariance: str) -> None:
    front = wobbly(0, 5)
    behind = LightSum(front.directions * torch.tensor((1.0, 1.0, -1.0)), front.amounts)
    posterior = StatisticalRelighter(learned, covariance).condition(people[12:13, :1] * 0.1, behind)
    assert all(torch.isfinite(part).all() for part in posterior.render(TARGETS))
    assert all(torch.isfinite(part).all() for part in posterior.render(behind))


def test_ten_thousand_directions(learned: FaceStatistics, people: torch.Tensor) -> None:
    """They are gathered, and nearly the same as a hundredth of them."""
    relighter = StatisticalRelighter(learned, "face")
    pictures = []
    for count in (100, 10_000):
        directions = even_hemisphere(count)
        light = LightSum(directions, torch.full((1, count), 1 / count))
        posterior = relighter.condition(people[12:13, :1] * 0.6, light)
        pictures.append(posterior.mean(torch.cat((TARGETS, directions[:2]))))
        pictures.append(posterior.mean(light))
    assert float((pictures[0] - pictures[2]).abs().mean()) < 0.01
    assert float((pictures[1] - pictures[3]).abs().mean()) < 0.01
    with pytest.raises(ValueError, match="at most 512"):
        relighter.condition(people[12:13, :1], LightSum(directions[None], light.amounts))


def test_a_constant_sphere_is_even_light(learned: FaceStatistics, people: torch.Tensor) -> None:
    lights = even_hemisphere(30)
    posterior = StatisticalRelighter(learned).condition(people[12:13, :1], lights[:1])
    even = posterior.mean(LightSum(lights, torch.full((1, 30), 1 / 30)))
    assert torch.allclose(even, posterior.mean(lights).mean(1, keepdim=True), atol=0.02)


def test_sixty_four_directions_cost_little(people: torch.Tensor) -> None:
    """A generous bound: machines differ, and are busy."""
    lights = even_hemisphere(64)
    images = torch.rand(6, 64, 48, 42)
    statistics = FaceStatistics.fit(images, lights, rank=8, face_rank=4)
    relighter = StatisticalRelighter(statistics, "face")
    light, photo = LightSum(lights, torch.full((1, 64), 1 / 64)), images[:1, :1]

    def seconds(given: torch.Tensor | LightSum) -> float:
        times = []
        for _ in range(7):
            started = time.perf_counter()
            relighter.condition(photo, given)
            times.append(time.perf_counter() - started)
        return min(times)

    assert seconds(light) < 6 * seconds(lights[:1])
    assert fill_light(0.1).directions.shape[0] < 512
