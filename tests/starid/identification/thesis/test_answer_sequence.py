"""Algorithm 3 by features alone: which answer is kept, and of what kind it is."""

from __future__ import annotations

from functools import partial
from types import SimpleNamespace
from typing import Any

import pytest

from starid.attitude import Attitude
from starid.identification.thesis.answer_sequence import AnswerSequence, KeptAnswer, Search

HERE = Attitude.from_radec_roll(80.0, 10.0, 0.0)
ELSEWHERE = Attitude.from_radec_roll(200.0, -40.0, 0.0)
THRESHOLD, LARGEST = 0.5, 5.0


def answer(error_psi: float, attitude: Attitude = HERE) -> Any:
    return SimpleNamespace(error_psi=error_psi, attitude=attitude)


def searches(*answers: Any) -> list[Search]:
    return [partial(lambda answer: answer, each) for each in answers]


def unasked() -> Any:
    raise AssertionError("the whole database is searched although the region fits")


def kind_of(kept: KeptAnswer | None) -> tuple[str, int]:
    assert kept is not None
    return kept.kind, kept.images


@pytest.fixture
def sequence() -> AnswerSequence:
    """A sequence after a good first answer."""
    sequence = AnswerSequence(THRESHOLD, LARGEST)
    assert kind_of(sequence.next(None, searches(answer(0.1)), None, first=True)) == ("first", 0)
    assert not sequence.exceeded
    return sequence


def test_while_the_region_fits_the_whole_database_is_not_searched(sequence: AnswerSequence) -> None:
    for image in (1, 2, 3):
        assert kind_of(sequence.next(answer(THRESHOLD), [unasked], HERE, first=False)) == ("region", image)
        assert not sequence.exceeded


def test_after_a_region_that_does_not_fit_the_smaller_error_is_kept_and_judged_by_its_place(
    sequence: AnswerSequence,
) -> None:
    local, everywhere = answer(1.0), answer(0.9, ELSEWHERE)
    assert kind_of(sequence.next(local, searches(everywhere), HERE, first=False)) == ("elsewhere", 0)
    assert kind_of(sequence.next(local, searches(answer(1.1, ELSEWHERE)), HERE, first=False)) == ("again", 1)
    assert kind_of(sequence.next(answer(0.2), [unasked], HERE, first=False)) == ("region", 2)
    assert kind_of(sequence.next(None, searches(answer(0.2)), None, first=False)) == ("elsewhere", 0)


def test_after_an_answer_above_the_threshold_the_region_is_not_searched(sequence: AnswerSequence) -> None:
    kept = sequence.next(None, searches(answer(0.6)), HERE, first=False)
    assert kind_of(kept) == ("again", 1)
    assert kept.valid
    assert sequence.exceeded
    sequence.next(None, searches(answer(0.5)), HERE, first=False)
    assert not sequence.exceeded


def test_the_second_search_is_only_for_an_image_without_an_attitude(sequence: AnswerSequence) -> None:
    bad, good = answer(6.0), answer(4.0)
    assert sequence.next(None, [lambda: good, unasked], HERE, first=False).answer is good
    assert sequence.next(None, searches(bad, good), HERE, first=False).answer is good
    assert sequence.next(None, searches(None, good), HERE, first=False).answer is good


@pytest.mark.parametrize("answers", [[], [None], [None, None]])
def test_without_an_answer_the_row_ends(sequence: AnswerSequence, answers: list[None]) -> None:
    sequence.next(answer(0.1), [unasked], HERE, first=False)
    assert sequence.next(None, searches(*answers), HERE, first=False) is None
    assert sequence.exceeded
    assert kind_of(sequence.next(None, searches(answer(0.1)), HERE, first=False)) == ("again", 1)


def test_an_invalid_answer_is_classified_and_ends_the_row(sequence: AnswerSequence) -> None:
    sequence.next(answer(0.1), [unasked], HERE, first=False)
    kept = sequence.next(None, searches(answer(6.0)), HERE, first=False)
    assert kind_of(kept) == ("again", 2)
    assert not kept.valid
    assert sequence.exceeded
    assert kind_of(sequence.next(None, searches(answer(0.1)), HERE, first=False)) == ("again", 1)
    sequence.reset()
    assert not sequence.exceeded


@pytest.mark.parametrize("valid", [True, False])
def test_a_refined_answer_is_good_if_it_is_verified(sequence: AnswerSequence, valid: bool) -> None:
    sky, region = SimpleNamespace(valid=valid), SimpleNamespace(valid=True)
    assert sequence.next_refined(None, lambda: sky) is sky
    assert sequence.exceeded is not valid
    assert sequence.next_refined(region, unasked) is region
    assert not sequence.exceeded
