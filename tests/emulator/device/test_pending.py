"""Answers that take time: whoever owes the answer hears the result, whichever comes first."""

import pytest

from starhil.emulator.device.pending import PendingAnswer


@pytest.mark.parametrize("ends_first", [True, False])
def test_the_result_is_heard_once_whichever_comes_first(ends_first):
    answer, heard = PendingAnswer[int](), []
    if ends_first:
        answer.end(7)
    answer.then(lambda number: f"code {number}").when_done(heard.append)
    answer.when_done(heard.append)
    assert bool(heard) is answer.done is ends_first
    if not ends_first:
        answer.end(7)
    assert heard == ["code 7", 7]


def test_observers_are_called_in_the_order_in_which_they_asked():
    answer, heard = PendingAnswer[int](), []
    answer.when_done(lambda _result: heard.append("acknowledge"))
    answer.when_done(lambda _result: heard.append("reply"))
    answer.end(0)
    assert heard == ["acknowledge", "reply"]
