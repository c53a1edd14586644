"""Rank and temper by cross-validation."""

import pytest
import torch

from facerelight.model.learning import FitOptions
from facerelight.train.cross_validation import choose_face_options


def test_more_than_one_loading_is_worth_having(people: torch.Tensor, lights: torch.Tensor) -> None:
    """The world of the fixtures varies in five ways: cross-validation takes several loadings, and its error is the
    least of the table."""
    choice = choose_face_options(
        people, lights, options=FitOptions(rank=4, basis=12), ranks=(1, 5), tempers=(1.0, 10.0, 1000.0)
    )
    assert choice.options.face_rank == 5
    assert choice.options.rank == 4
    assert set(choice.errors) == {(rank, temper) for rank in (1, 5) for temper in (1.0, 10.0, 1000.0)}
    assert choice.errors[choice.options.face_rank, choice.options.temper] == min(choice.errors.values())
    assert choice.errors[5, 10.0] < choice.errors[1, 10.0]


def test_ranks_beyond_the_people_are_cut_and_missing_images_skipped(people: torch.Tensor, lights: torch.Tensor) -> None:
    valid = torch.ones(16, 30, dtype=torch.bool)
    valid[2, :5] = False
    choice = choose_face_options(people, lights, valid, ranks=(3, 40, 80), tempers=(10.0,))
    assert {rank for rank, _ in choice.errors} == {3, 10}


def test_too_few_people_are_refused(people: torch.Tensor, lights: torch.Tensor) -> None:
    with pytest.raises(ValueError, match="people"):
        choose_face_options(people[:2], lights)
