import functools

import numpy as np
import pytest
import torch
from conftest import MeanColour
from kornia.color import linear_rgb_to_rgb
from scipy.stats import multivariate_normal
from sklearn.decomposition import PCA

from facerelight.geometry.alignment import CropFrame
from facerelight.geometry.lights import even_hemisphere
from facerelight.inference.relighter import StatisticalRelighter
from facerelight.model.statistics import FaceStatistics
from facerelight.recognition.class_conditional import GaussianClassifier
from facerelight.recognition.classifier import SumClassifier
from facerelight.recognition.exemplars import direct_subspace, exemplar_lights, light_moments, synthesize
from facerelight.recognition.nearest import NearestNeighborClassifier
from facerelight.recognition.opencv import EmbeddingFeatures, OpenCVClassifier
from facerelight.recognition.pca import GlobalPCAClassifier, IndividualPCAClassifier
from facerelight.recognition.photometric import Inside, TanTriggs, WeberFaces, make_normalizer
from facerelight.recognition.subspaces import IncrementalSubspace, principal_angles, principal_subspace

CLASSIFIERS = [
    NearestNeighborClassifier,
    lambda **k: NearestNeighborClassifier("cosine", **k),
    lambda **k: NearestNeighborClassifier("l0", **k),
    lambda **k: GlobalPCAClassifier(5, **k),
    lambda **k: IndividualPCAClassifier(3, **k),
    IndividualPCAClassifier,
    lambda **k: IndividualPCAClassifier(3, metric="cosine", **k),
    GaussianClassifier,
    lambda **k: GaussianClassifier(2, 3, **k),
]
NAMES = ["nearest", "cosine", "l0", "global", "individual3", "individual", "individual cosine", "gaussian", "mixture"]


def faces(seed: int = 0) -> tuple[torch.Tensor, list[str]]:
    generator = torch.Generator().manual_seed(seed)
    centres = torch.rand(4, 1, 20, 18, generator=generator)
    images = centres + 0.05 * torch.randn(4, 8, 20, 18, generator=generator)
    return images.flatten(0, 1), [name for name in ("dan", "ann", "cy", "bob") for _ in range(8)]


@pytest.mark.parametrize("make", CLASSIFIERS, ids=NAMES)
def test_the_contract_of_every_classifier(make) -> None:
    images, labels = faces()
    classifier = make()
    with pytest.raises(RuntimeError, match="fit first"):
        classifier.predict(images)
    assert classifier.fit(images, labels) is classifier
    assert classifier.classes_ == ["ann", "bob", "cy", "dan"]
    probes = images + 0.01
    before = probes.clone()
    assert classifier.score(probes, labels) > 0.95
    assert torch.equal(probes, before)
    scores = classifier.decision_function(probes)
    assert scores.shape == (32, 4)
    assert torch.allclose(classifier.decision_function(probes[5:6]), scores[5:6], atol=1e-4)
    assert torch.equal(classifier.fit(images, labels).decision_function(probes), scores)
    assert set(classifier.fit(images[:8], ["only"] * 8).predict(images)) == {"only"}
    strict = make(reject=1e9).fit(images, labels)
    assert set(strict.predict(probes)) == {None}


@pytest.mark.parametrize("make", CLASSIFIERS, ids=NAMES)
def test_bad_input_is_named(make) -> None:
    images, labels = faces()
    with pytest.raises(ValueError, match="M >= 1"):
        make().fit(images[:0], [])
    with pytest.raises(ValueError, match="one for each"):
        make().fit(images, labels[:3])
    with pytest.raises(ValueError, match="NaN"):
        make().fit(images * torch.nan, labels)


def test_degenerate_galleries_have_an_answer() -> None:
    """One image a person, identical images, zero variance, more dimensions than exemplars."""
    images, _ = faces()
    one = IndividualPCAClassifier(9).fit(images[::8], list("abcd"))
    assert one.predict(images[::8]) == list("abcd")
    assert one.dimensions.tolist() == [0, 0, 0, 0]
    same = IndividualPCAClassifier().fit(images[:1].expand(6, -1, -1), ["a"] * 6)
    assert float(same.reconstruction_error(images[:1])) < 1e-3
    flat = IndividualPCAClassifier(3).fit(torch.zeros(4, 8, 8), ["a", "a", "b", "b"])
    assert torch.isfinite(flat.decision_function(torch.rand(2, 8, 8))).all()


def test_individual_pca_equals_scikit_learn() -> None:
    images, labels = faces()
    classifier = IndividualPCAClassifier(3).fit(images, labels)
    probes = torch.rand(6, 20, 18)
    for index, name in enumerate(classifier.classes_):
        rows = images[[i for i, label in enumerate(labels) if label == name]].flatten(1).double().numpy()
        pca = PCA(3, svd_solver="full").fit(rows)
        x = probes.flatten(1).double().numpy()
        error = ((x - pca.inverse_transform(pca.transform(x))) ** 2).sum(1)
        assert torch.allclose(
            classifier.reconstruction_error(probes)[:, index].double(), torch.from_numpy(error), rtol=1e-3
        )


def test_cosine_of_individual_subspaces() -> None:
    """Against projections written out in float64; neither a probe's contrast nor a person's matters."""
    images, labels = faces()
    classifier = IndividualPCAClassifier(3, metric="cosine").fit(images, labels)
    probes = torch.rand(6, 20, 18)
    scores = classifier.decision_function(probes)
    for person in range(4):
        basis, mean = classifier.bases[person].double(), classifier.means[person].double()
        left, own = ((x - (x @ basis) @ basis.T) for x in (probes.flatten(1).double(), mean))
        expected = (left @ own) / (left.norm(dim=1) * own.norm())
        assert torch.allclose(scores[:, person].double(), expected, atol=1e-5)
    assert torch.allclose(classifier.decision_function(3 * probes), scores, atol=1e-5)
    dimmed = IndividualPCAClassifier(3, metric="cosine").fit(
        images * torch.tensor([0.1 if x == "ann" else 1.0 for x in labels])[:, None, None], labels
    )
    assert torch.allclose(dimmed.decision_function(probes), scores, atol=1e-4)
    flat = IndividualPCAClassifier(3, metric="cosine").fit(torch.zeros(4, 8, 8), ["a", "a", "b", "b"])
    assert torch.isfinite(flat.decision_function(torch.rand(2, 8, 8))).all()
    with pytest.raises(ValueError, match="metric"):
        IndividualPCAClassifier(metric="manhattan")


def test_one_percent_rule() -> None:
    rows = torch.randn(40, 300, generator=torch.Generator().manual_seed(0)) * torch.logspace(0, -3, 40)[:, None]
    space = principal_subspace(rows)
    left = rows - space.mean - ((rows - space.mean) @ space.basis) @ space.basis.T
    assert left.square().sum() <= 0.0101 * rows.square().sum()
    fewer = space.basis[:, :-1]
    left = rows - space.mean - ((rows - space.mean) @ fewer) @ fewer.T
    assert left.square().sum() > 0.0099 * rows.square().sum()


def test_enrolling_one_more_person_leaves_the_others(statistics: FaceStatistics) -> None:
    images, labels = faces()
    both = IndividualPCAClassifier(3).fit(images, labels)
    grown = IndividualPCAClassifier(3).fit(images[:24], labels[:24]).partial_fit(images[24:], labels[24])
    assert grown.classes_ == both.classes_
    assert torch.allclose(grown.decision_function(images), both.decision_function(images), atol=1e-4)
    both.calibrate(images, 0.1)
    assert both.predict(torch.rand(3, 20, 18)) == [None] * 3


def test_incremental_svd_over_10000_updates_with_duplicates() -> None:
    generator = torch.Generator().manual_seed(0)
    basis = torch.randn(60, 12, generator=generator, dtype=torch.float64)
    pool = torch.randn(300, 12, generator=generator, dtype=torch.float64) @ basis.T
    space = IncrementalSubspace(60, error=1e-6)
    changed = sum(space.add(pool[i % 300]) for i in range(10_000))
    assert changed == 12
    identity = space.basis.T @ space.basis - torch.eye(space.basis.shape[1])
    assert identity.abs().max() < 1e-5
    left = pool.T - space.basis @ (space.basis.T @ pool.T)
    assert left.abs().max() < 1e-5
    with pytest.raises(ValueError, match="60 finite"):
        space.add(torch.full((60,), torch.nan))


def test_direct_subspace_equals_that_of_the_synthesised_images(
    statistics: FaceStatistics, people: torch.Tensor, lights: torch.Tensor
) -> None:
    """(6.1) with covariance interpolation: w(s)^T (sigma b) in place of sigma(s) w(s)^T b, the same nodes and
    weights."""
    posterior = StatisticalRelighter(statistics, "face").condition(people[12:13, :1], lights[:1])
    nodes, weights = exemplar_lights("hemisphere")
    person = posterior.people[0]
    features = torch.cat((nodes, statistics.weights(nodes)), 1)
    maps = torch.cat((person.n_map, person.v_map + person.pixel.v_std.flatten(1) * person.pull))
    explicit = principal_subspace(features.double() @ maps.double(), 9, weights=weights.double())
    direct = direct_subspace(person, light_moments(posterior, nodes, weights), 9)
    assert principal_angles(direct.basis, explicit.basis).max() < 0.1
    assert torch.allclose(direct.mean.double(), explicit.mean, atol=1e-5)
    rendered = principal_subspace(synthesize(posterior, nodes)[0].flatten(1), 4, weights=weights)
    assert (
        principal_angles(direct.basis[:, :4], rendered.basis).max() < 25
    )  # the default model interpolates correlations


def test_synthesis_recognises_people_under_any_light(
    statistics: FaceStatistics, people: torch.Tensor, lights: torch.Tensor
) -> None:
    gallery, names = people[12:], ["a", "b", "c", "d"]
    posterior = StatisticalRelighter(statistics, "face").condition(gallery[:, :1], lights[:1])
    exemplars = synthesize(posterior, even_hemisphere(40)).flatten(0, 1)
    owners = [name for name in names for _ in range(40)]
    probes, truth = gallery[:, 5:].flatten(0, 1), [name for name in names for _ in range(25)]
    single = NearestNeighborClassifier().fit(gallery[:, 0], names).score(probes, truth)
    relit = IndividualPCAClassifier(9).fit(exemplars, owners).score(probes, truth)
    assert relit > single + 0.1


@pytest.mark.parametrize(
    "normalizer", [TanTriggs(), WeberFaces(), WeberFaces(sigma=0.5)], ids=["tan_triggs", "weber", "weber_fine"]
)
def test_photometric_normalisation_forgets_brightness(normalizer: torch.nn.Module) -> None:
    images = torch.rand(3, 40, 36, generator=torch.Generator().manual_seed(0)) * 0.5 + 0.2
    ramp = torch.linspace(0.7, 1.3, 36)
    before = (
        images / images.norm(dim=(1, 2), keepdim=True)
        - (images * ramp) / (images * ramp).norm(dim=(1, 2), keepdim=True)
    ).norm()
    after = (normalizer(images) - normalizer(images * ramp)).norm()
    assert after < before
    assert torch.isfinite(normalizer(torch.zeros(1, 40, 36))).all()
    assert torch.allclose(normalizer(images).norm(dim=(1, 2)), torch.ones(3), atol=1e-4)
    with pytest.raises(ValueError, match="expected one of"):
        make_normalizer("sepia")


def test_what_lies_outside_the_mask_does_not_matter() -> None:
    """Beyond the reach of the filter; and the mask's edge itself is no feature."""
    images = torch.rand(2, 40, 36, generator=torch.Generator().manual_seed(0)) * 0.5 + 0.2
    mask = torch.zeros(40, 36)
    mask[8:32, 8:28] = 1
    inside = Inside(WeberFaces(), mask)
    other = images.clone()
    other[:, :2], other[:, :, 34:] = 0, 1
    assert torch.allclose(inside(images), inside(other), atol=1e-6)
    assert torch.allclose(inside(images).norm(dim=(1, 2)), torch.ones(2), atol=1e-5)
    assert (inside(images)[:, mask == 0] == 0).all()
    flat = torch.full((1, 40, 36), 0.5)
    assert float(inside(flat).abs().max()) < 1e-3
    assert set(dict(inside.named_buffers())) == {"mask"}


def blobs(seed: int, people: int = 4, each: int = 12) -> tuple[torch.Tensor, list[int]]:
    """Images of people, each with two modes, as smooth random patterns."""
    generator = torch.Generator().manual_seed(seed)
    centres = torch.nn.functional.interpolate(
        torch.rand(2 * people, 1, 4, 4, generator=generator), (12, 10), mode="bilinear"
    )[:, 0]
    images = centres.repeat_interleave(each // 2, 0) + 0.02 * torch.randn(people * each, 12, 10, generator=generator)
    return images, [person for person in range(people) for _ in range(each)]


def test_gaussian_scores_are_log_densities() -> None:
    """Against scipy's multivariate normal with the covariance written out, to 1e-3 nats a pixel."""
    images, labels = blobs(0)
    classifier = GaussianClassifier(dimension=3, noise=1e-3).fit(images, labels)
    scores = classifier.decision_function(images[::5])
    for person in range(4):
        basis, spread = classifier.bases[person].double(), classifier.spread[person].double()
        covariance = basis * spread @ basis.T + float(classifier.floor[person]) * torch.eye(120, dtype=torch.float64)
        exact = (
            multivariate_normal(classifier.means[person].double(), covariance).logpdf(images[::5].flatten(1).double())
            / 120
        )
        assert np.abs(scores[:, person].numpy() - exact).max() < 1e-3 * max(1, np.abs(exact).max())


def test_a_mixture_knows_two_modes() -> None:
    images, labels = blobs(1)
    single, mixture = (GaussianClassifier(k, 1, noise=1e-3).fit(images, labels) for k in (1, 2))
    assert len(mixture.owner) == 8
    assert mixture.score(images, labels) == 1.0
    between = (images[0] + images[-1 + 12]) / 2  # nobody looks like the middle of two modes
    gap = [
        float(c.decision_function(images[:1]).max() - c.decision_function(between[None]).max())
        for c in (single, mixture)
    ]
    assert gap[1] > gap[0]
    assert (
        len(GaussianClassifier(5, 2).fit(images[:4], [0, 0, 1, 1]).owner) == 2
    )  # too few exemplars for five components
    with pytest.raises(ValueError, match="noise > 0"):
        GaussianClassifier(noise=0)


def test_shifted_probes_are_found_by_shifted_comparison() -> None:
    images, labels = blobs(2)
    moved = torch.roll(images, (2, -2), (1, 2))
    moved[:, :2], moved[:, :, -2:] = moved[:, 2:3], moved[:, :, -3:-2]
    still, tolerant = (NearestNeighborClassifier(shift=shift).fit(images, labels) for shift in (0, 2))
    assert tolerant.score(moved, labels) >= still.score(moved, labels)
    assert (tolerant.decision_function(moved).amax(1) >= still.decision_function(moved).amax(1)).all()
    assert tolerant.score(images, labels) == 1.0
    with pytest.raises(ValueError, match="shift"):
        NearestNeighborClassifier(shift=-1)


def test_the_sum_rule_adds_scores() -> None:
    images, labels = blobs(3)
    one, two = NearestNeighborClassifier().fit(images, labels), IndividualPCAClassifier(2).fit(images, labels)
    both = SumClassifier([one, two], [1.0, 0.5])
    expected = one.decision_function(images) + 0.5 * two.decision_function(images)
    assert torch.allclose(both.decision_function(images), expected)
    assert both.score(images, labels) == 1.0
    with pytest.raises(ValueError, match="same people"):
        SumClassifier([one, IndividualPCAClassifier(2).fit(images[:24], labels[:24])])
    with pytest.raises(ValueError, match="weights"):
        SumClassifier([one, two], [1.0])


def test_reject_is_calibrated_on_new_images() -> None:
    images, labels = blobs(4)
    classifier = IndividualPCAClassifier(2).fit(images[::2], labels[::2]).calibrate(images[1::2], 0.25)
    answers = classifier.predict(images[1::2])
    assert 0.15 < sum(answer is None for answer in answers) / len(answers) < 0.35
    assert classifier.predict(torch.rand(1, 12, 10)) == [None]


@pytest.mark.parametrize("kind", ["eigenfaces", "fisherfaces", "lbph"])
def test_opencv_baselines(kind: str) -> None:
    """The same answers as OpenCV's own predict."""
    images, labels = (torch.nn.functional.interpolate(blobs(5)[0][:, None], (48, 40))[:, 0].clamp(0, 1), blobs(5)[1])
    classifier = OpenCVClassifier(kind).fit(images, labels)
    coded = linear_rgb_to_rgb(images[::7, None].expand(-1, 3, -1, -1))[:, 0]
    direct = [classifier._recognizer.predict((image * 255).round().byte().numpy())[0] for image in coded]
    assert classifier.predict(images[::7]) == direct
    if kind == "fisherfaces":
        with pytest.raises(ValueError, match="two exemplars"):
            OpenCVClassifier(kind).fit(images[:2], [0, 1])
    with pytest.raises(ValueError, match="eigenfaces"):
        OpenCVClassifier("deep")


def test_an_embedding_tells_crops_apart() -> None:
    crops = torch.rand(3, 48, 42)
    features = EmbeddingFeatures(MeanColour(), CropFrame(48, 42))
    assert features(crops).shape == (3, 1, 3)
    bright = torch.linspace(0.1, 0.9, 3)[:, None, None].expand(3, 48, 42)
    coded = NearestNeighborClassifier("l2", normalizer=features).fit(bright, [0, 1, 2])
    assert coded.decision_function(bright).shape == (3, 3)


@pytest.mark.parametrize(
    "make",
    [
        IndividualPCAClassifier,
        GlobalPCAClassifier,
        NearestNeighborClassifier,
        functools.partial(GaussianClassifier, 2, 2, 1e-3),
    ],
)
def test_fit_finds_the_threshold_for_strangers(make) -> None:
    """Known people's new images pass, images of people who were not enrolled do not, each with few exceptions."""
    images, labels = blobs(6)
    known = [i for i, label in enumerate(labels) if label < 3]
    strangers = [i for i, label in enumerate(labels) if label >= 3]
    classifier = make(reject="fit").fit(images[known][::2], [labels[i] for i in known][::2])
    assert classifier.threshold_ is not None
    accepted = [answer is not None for answer in classifier.predict(images[known][1::2])]
    turned_away = [answer is None for answer in classifier.predict(images[strangers])]
    assert sum(accepted) / len(accepted) >= 0.8
    assert sum(turned_away) / len(turned_away) >= 0.8


def test_a_threshold_needs_exemplars_to_hold_out() -> None:
    images, labels = blobs(6)
    with pytest.raises(ValueError, match="4 exemplars"):
        IndividualPCAClassifier(1, reject="fit").fit(images[:2], [0, 1])
    with pytest.raises(ValueError, match="'fit'"):
        IndividualPCAClassifier(1, reject="auto")
    assert IndividualPCAClassifier(1).fit(images, labels).threshold_ is None


def test_k_nearest_neighbours_vote_as_in_scikit_learn() -> None:
    neighbours = pytest.importorskip("sklearn.neighbors")
    generator = torch.Generator().manual_seed(4)
    images, labels = torch.rand(60, 6, 5, generator=generator), [i % 3 for i in range(60)]
    probes = torch.rand(200, 6, 5, generator=generator)
    for k in (1, 3, 7):
        ours = NearestNeighborClassifier(neighbors=k).fit(images, labels).predict(probes)
        theirs = neighbours.KNeighborsClassifier(k).fit(images.flatten(1).numpy(), labels)
        votes = theirs.predict_proba(probes.flatten(1).numpy())
        clear = [
            i for i, row in enumerate(votes) if (row == row.max()).sum() == 1
        ]  # scikit-learn breaks ties by label, we by distance
        assert len(clear) > 100
        assert [ours[i] for i in clear] == [int(votes[i].argmax()) for i in clear]
    with pytest.raises(ValueError, match="neighbors"):
        NearestNeighborClassifier(neighbors=0)


@pytest.mark.parametrize("make", [NearestNeighborClassifier, functools.partial(GlobalPCAClassifier, 60)])
def test_near_twins_find_themselves(make) -> None:
    """200 people 0.03 grey levels apart: a difference of large numbers, which float32 would lose."""
    generator = torch.Generator().manual_seed(0)
    face = 0.3 + 0.5 * torch.rand(48, 42, generator=generator)
    twins = face + 0.03 / 255 * torch.randn(200, 48, 42, generator=generator)
    assert make().fit(twins, list(range(200))).score(twins, list(range(200))) == 1.0


def test_people_join_the_one_subspace_of_all() -> None:
    """As if all had been there from the first: the same answers, and nearly the same subspace of the exemplars."""
    images, labels = faces()
    first = [i for i, label in enumerate(labels) if label in labels[:12]]
    rest = [i for i in range(len(labels)) if i not in first]
    whole = GlobalPCAClassifier(None, 1e-3).fit(images, labels)
    grown = GlobalPCAClassifier(60, 1e-3).fit(images[first], [labels[i] for i in first])
    before = grown.basis.shape[1]
    for i in rest:
        grown.partial_fit(images[i : i + 1], labels[i])
    assert grown.basis.shape[1] > before
    assert grown.classes_ == whole.classes_
    assert (grown.basis.T @ grown.basis - torch.eye(grown.basis.shape[1])).abs().max() < 1e-4
    left = (images.flatten(1) - grown.mean) @ (torch.eye(360) - grown.basis @ grown.basis.T)
    assert left.square().sum() < 2e-3 * images.square().sum()
    probes = images + 0.01 * torch.randn(images.shape, generator=torch.Generator().manual_seed(1))
    assert grown.predict(probes) == whole.predict(probes) == list(labels)
    columns = grown.basis.shape[1]
    grown.partial_fit(images[:1], labels[0])  # what it knows already changes nothing
    assert grown.basis.shape[1] == columns
    with pytest.raises(RuntimeError, match="call fit first"):
        GlobalPCAClassifier().partial_fit(images[:1], "ann")
    with pytest.raises(ValueError, match="images"):
        grown.partial_fit(images[:1, 1:], "ann")
    with pytest.raises(ValueError, match="exemplars"):
        grown.partial_fit(images[:0], "ann")
