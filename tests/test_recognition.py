import pytest
import torch
from sklearn.decomposition import PCA

from facerelight.lights import even_hemisphere
from facerelight.recognition.classifiers import GlobalPCAClassifier, IndividualPCAClassifier, NearestNeighborClassifier
from facerelight.recognition.exemplars import direct_subspace, exemplar_lights, light_moments, synthesize
from facerelight.recognition.photometric import TanTriggs, WeberFaces, make_normalizer
from facerelight.recognition.subspaces import IncrementalSubspace, principal_angles, principal_subspace
from facerelight.relighter import StatisticalRelighter
from facerelight.statistics import FaceStatistics

CLASSIFIERS = [
    NearestNeighborClassifier,
    lambda **k: NearestNeighborClassifier("cosine", **k),
    lambda **k: NearestNeighborClassifier("l0", **k),
    lambda **k: GlobalPCAClassifier(5, **k),
    lambda **k: IndividualPCAClassifier(3, **k),
    IndividualPCAClassifier,
]
NAMES = ["nearest", "cosine", "l0", "global", "individual3", "individual"]


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
        assert torch.allclose(classifier.reconstruction_error(probes)[:, index].double(), torch.from_numpy(error), rtol=1e-3)


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


def test_direct_subspace_equals_that_of_the_synthesised_images(statistics: FaceStatistics, people: torch.Tensor, lights: torch.Tensor) -> None:
    """(6.1) with covariance interpolation: w(s)^T (sigma b) in place of sigma(s) w(s)^T b, the same nodes and weights."""
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
    assert principal_angles(direct.basis[:, :4], rendered.basis).max() < 25  # the default model interpolates correlations


def test_synthesis_recognises_people_under_any_light(statistics: FaceStatistics, people: torch.Tensor, lights: torch.Tensor) -> None:
    gallery, names = people[12:], ["a", "b", "c", "d"]
    posterior = StatisticalRelighter(statistics, "face").condition(gallery[:, :1], lights[:1])
    exemplars = synthesize(posterior, even_hemisphere(40)).flatten(0, 1)
    owners = [name for name in names for _ in range(40)]
    probes, truth = gallery[:, 5:].flatten(0, 1), [name for name in names for _ in range(25)]
    single = NearestNeighborClassifier().fit(gallery[:, 0], names).score(probes, truth)
    relit = IndividualPCAClassifier(9).fit(exemplars, owners).score(probes, truth)
    assert relit > single + 0.1


@pytest.mark.parametrize("normalizer", [TanTriggs(), WeberFaces()], ids=["tan_triggs", "weber"])
def test_photometric_normalisation_forgets_brightness(normalizer: torch.nn.Module) -> None:
    images = torch.rand(3, 40, 36, generator=torch.Generator().manual_seed(0)) * 0.5 + 0.2
    ramp = torch.linspace(0.7, 1.3, 36)
    before = (images / images.norm(dim=(1, 2), keepdim=True) - (images * ramp) / (images * ramp).norm(dim=(1, 2), keepdim=True)).norm()
    after = (normalizer(images) - normalizer(images * ramp)).norm()
    assert after < before
    assert torch.isfinite(normalizer(torch.zeros(1, 40, 36))).all()
    assert torch.allclose(normalizer(images).norm(dim=(1, 2)), torch.ones(3), atol=1e-4)
    with pytest.raises(ValueError, match="expected one of"):
        make_normalizer("sepia")
