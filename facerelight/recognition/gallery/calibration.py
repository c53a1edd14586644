"""What a score means: how far it stands above strangers' scores, the probability of a match, and where strangers begin.

Scores of different people depend on the camera, the light and who is enrolled: photographs of one studio look alike.
The gallery itself knows, since its people are strangers to each other; what other people's photographs taught counts as
a few such pairs more.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from scipy.stats import t as student
from torch import Tensor

from facerelight.recognition.gallery.recognizer import Levels, Recognizer, Template

__all__ = ["Calibration", "calibrate", "stranger_scores"]

PRIOR_PEOPLE = 5  # that the learned levels count for
PERSONAL_PAIRS = 5.0  # scores that the common level counts for in a template's own


class Calibration(NamedTuple):
    """``mean (M,)`` of strangers' scores by template, their ``std``, the ``freedom`` with which that is known (of
    Student's distribution), and the learned ``levels``."""

    mean: Tensor
    std: float
    freedom: float
    levels: Levels

    def standardised(self, scores: Tensor, rows: Tensor) -> Tensor:
        """Scores of the templates ``rows`` in standard deviations above strangers'."""
        return (scores - self.mean[rows]) / self.std

    def probability(self, standardised: float) -> float:
        """That probe and template are of one person, where one pair in two is."""
        return float(torch.sigmoid(torch.tensor(self.levels.slope * standardised + self.levels.intercept)))

    def threshold(self, far: float, templates: int) -> float:
        """The standardised score that a stranger reaches with probability ``far`` somewhere among ``templates``.

        Raises:
            ValueError: no rate between 0 and 1.
        """
        if not 0 < far < 1:
            raise ValueError(f"far: expected a false accept rate between 0 and 1, got {far}")
        alone = -torch.expm1(torch.log1p(torch.tensor(-far, dtype=torch.float64)) / max(templates, 1))
        return float(student.isf(float(alone), self.freedom))


def stranger_scores(recognizer: Recognizer, templates: Template, owners: Tensor) -> Tensor:
    """What everybody scores with the others' templates as a stranger would, themselves not enrolled: ``(M, M)`` of M
    templates, 0 where both are of one person.

    Args:
        recognizer: which scores.
        templates: of it.
        owners: ``(M,)`` numbers, whose they are.
    """
    scores = torch.zeros(len(owners), len(owners))
    for person in owners.unique():
        others = (owners != person).nonzero()[:, 0]
        if len(others):
            index = recognizer.index({part: values[others] for part, values in templates.items()}, owners[others])
            for row in (owners == person).nonzero()[:, 0].tolist():
                found, columns = index.search(templates["probe"][row], len(others))
                scores[row, others[columns]] = found
    return scores


def calibrate(scores: Tensor, owners: Tensor, templates: Tensor, levels: Levels, personal: bool) -> Calibration:
    """From scores of enrolled faces with other people's templates.

    Args:
        scores: ``(P, M)``, of P enrolled faces with M templates.
        owners: ``(P,)`` numbers, whose the faces are.
        templates: ``(M,)`` numbers, whose the templates are.
        levels: of other people, learned before.
        personal: whether each template is held to its own mean.

    Example:
        >>> scores, people = torch.tensor([[1.0, 0.2], [0.3, 1.0]]), torch.arange(2)
        >>> round(calibrate(scores, people, people, Levels(0.25, 0.1, 1.0, -4.0), False).threshold(0.01, 2), 2)
        3.71
    """
    strangers = owners[:, None] != templates
    counts = strangers.sum(0)
    people = len(owners.unique())
    weight = people / (people + PRIOR_PEOPLE) if strangers.any() else 0.0
    pooled = scores[strangers].mean() if weight else scores.new_tensor(levels.mean)
    common = weight * pooled + (1 - weight) * levels.mean
    each = common.expand(len(templates))
    if personal:
        each = ((scores * strangers).sum(0) + PERSONAL_PAIRS * common) / (counts + PERSONAL_PAIRS)
    spread = float((scores - each)[strangers].square().mean()) if weight else 0.0
    variance = weight * spread + (1 - weight) * levels.std**2
    return Calibration(each.clone(), max(variance, 1e-12) ** 0.5, PRIOR_PEOPLE + max(people - 1, 0), levels)
