"""Identification measured: who is named first, strangers let in, and what a calibrated threshold does."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from facerelight.recognition.gallery.calibration import calibrate
from facerelight.recognition.gallery.recognizer import Levels

__all__ = ["OpenSet", "equal_error", "identified_at", "open_set", "rank_one", "standardised", "wilson"]


class OpenSet(NamedTuple):
    """Best scores, in standard deviations above strangers': ``genuine (P,)`` of enrolled people's photographs, minus
    infinity where another is named first or no face was found; ``strangers (S,)``; and the ``threshold`` calibrated on
    the enrolled alone."""

    genuine: Tensor
    strangers: Tensor
    threshold: float


def rank_one(scores: Tensor, owners: Tensor) -> float:
    """Share of probes whose best template is their owner's: ``scores (P, M)``, template m being person m's, rows of
    minus infinity where no face was found; ``owners (P,)``."""
    right = (scores.argmax(1) == owners) & torch.isfinite(scores).any(1)
    return float(right.double().mean())


def open_set(
    probes: Tensor, owners: Tensor, enrolled: Tensor, known: Tensor, levels: Levels, personal: bool, far: float
) -> OpenSet:
    """Of the people ``known``, and everybody else as a stranger.

    Args:
        probes: ``(P, M)``, scores of probes with every person's one template.
        owners: ``(P,)``, whose the probes are.
        enrolled: ``(M, M)``, scores of the enrolled photographs themselves.
        known: ``(M,)`` bool, who is enrolled.
        levels, personal: see :class:`facerelight.recognition.gallery.recognizer.Recognizer`.
        far: what the threshold is calibrated for.
    """
    people = known.nonzero()[:, 0]
    learned = calibrate(enrolled[people][:, people], people, people, levels, personal)
    best = ((probes[:, people] - learned.mean) / learned.std).max(1)
    own = known[owners]
    right = people[best.indices] == owners
    genuine = torch.where(right, best.values, -torch.inf)[own]
    return OpenSet(genuine, best.values[~own], learned.threshold(far, len(people)))


def equal_error(genuine: Tensor, strangers: Tensor) -> float:
    """Where as large a share of enrolled people is turned away or misnamed as of strangers is let in.

    Example:
        >>> equal_error(torch.tensor([2.0, 3.0, 4.0, 5.0]), torch.tensor([0.0, 1.0, 2.5, -1.0]))
        0.25
    """
    places = torch.cat((genuine, strangers, torch.tensor([torch.inf], dtype=genuine.dtype))).unique()
    missed = (genuine[:, None] < places).double().mean(0)
    let_in = (strangers[:, None] >= places).double().mean(0)
    nearest = (missed - let_in).abs().argmin()
    return float((missed[nearest] + let_in[nearest]) / 2)


def identified_at(genuine: Tensor, strangers: Tensor, far: float) -> float:
    """Share of ``genuine`` named rightly at the lowest threshold that lets in at most ``far`` of ``strangers``."""
    allowed = int(far * len(strangers))
    limit = strangers.sort(descending=True).values[allowed]
    return float((genuine > limit).double().mean())


def standardised(probes: Tensor, enrolled: Tensor, levels: Levels, personal: bool) -> Tensor:
    """``probes (P, M)`` in standard deviations above strangers' scores, everybody enrolled; see :func:`open_set`."""
    people = torch.arange(len(enrolled))
    learned = calibrate(enrolled, people, people, levels, personal)
    return (probes - learned.mean) / learned.std


def wilson(right: int, count: int) -> tuple[float, float]:
    """The 95 % interval of a share (Wilson 1927).

    Example:
        >>> [round(edge, 3) for edge in wilson(9, 10)]
        [0.596, 0.982]
    """
    from scipy.stats import binomtest

    interval = binomtest(right, count).proportion_ci(method="wilson")
    return float(interval.low), float(interval.high)
