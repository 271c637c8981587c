"""Lines of JSON from a peer: what is one, what is not, and what a flood of them costs."""

import asyncio

import pytest

from starhil.emulator.truth.json_lines import TURN, JsonError, parse_object, read_lines
from starhil.protocol.errors import LONGEST_PROBLEM

LIMIT = 10_000


async def lines_of(*chunks, end=b"\n", limit=LIMIT):
    """The lines of a peer that sends some chunks and closes."""
    reader = asyncio.StreamReader()

    async def send():
        for chunk in chunks:
            reader.feed_data(chunk)
            await asyncio.sleep(0)
        reader.feed_eof()

    sending = asyncio.create_task(send())
    found = [line async for line in read_lines(reader, limit, end)]
    await sending
    return found


@pytest.mark.parametrize(
    ("chunks", "end", "lines"),
    [
        ([b"a\nbc\n\nd"], b"\n", [b"a\n", b"bc\n", b"d"]),
        ([b" \t\r\n\n", b"\n a\n  "], b"\n", [b" a\n"]),
        ([bytes([letter]) for letter in b"ab\ncd"], b"\n", [b"ab\n", b"cd"]),
        ([b"a[EN", b"D]b", b"[", b"END]", b"[END"], b"[END]", [b"a[END]", b"b[END]", b"[END"]),
        ([b"x" * LIMIT + b"\ny\n"], b"\n", [b"x" * LIMIT + b"\n", b"y\n"]),
        ([b"x" * LIMIT + b"x\ny\n"], b"\n", [None, b"y\n"]),
        ([b"x" * (3 * LIMIT), b"x\ny"], b"\n", [None, b"y"]),
        ([b"x" * (3 * LIMIT)], b"\n", [None]),
        ([b"x" * LIMIT + b"[EN", b"D]y[END]"], b"[END]", [b"x" * LIMIT + b"[END]", b"y[END]"]),
        ([b"x" * (2 * LIMIT) + b"[EN", b"D]y[END]"], b"[END]", [None, b"y[END]"]),
        ([], b"\n", []),
    ],
)
def test_lines_are_separated_however_they_arrive(chunks, end, lines):
    assert asyncio.run(lines_of(*chunks, end=end)) == lines


def test_blank_lines_cost_no_turn_of_the_loop_each():
    """Other tasks run after each `TURN` bytes; a turn for each of 100 000 blank lines took two seconds."""
    turns = 0

    async def main():
        async def count():
            nonlocal turns
            while True:
                turns += 1
                await asyncio.sleep(0)

        counting = asyncio.create_task(count())
        assert await lines_of(b"\n" * 100_000) == []
        counting.cancel()

    asyncio.run(main())
    assert 100_000 / TURN <= turns < 100


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("", "not a JSON object on one line"),
        (b"\xff", "not a JSON object on one line"),
        ("[1]", "not a JSON object on one line"),
        ("[" * 100_000, "not a JSON object on one line"),
        ('{"a": ' + "9" * 5000 + "}", "not a JSON object on one line"),
        ('{"a": 1, "a": 2}', "key 'a' is repeated"),
        ('{"b": NaN}', "b: nan is not a finite number"),
        ('{"b": [{"c": [1, [-1e400]]}]}', "c: -inf is not a finite number"),
    ],
)
def test_what_is_no_unambiguous_object_is_said(line, said):
    with pytest.raises(JsonError) as refusal:
        parse_object(line)
    assert str(refusal.value) == said


@pytest.mark.parametrize("line", ['{"%s": 1, "%s": 2}' % (2 * ("k" * 9000,)), '{"%s": NaN}' % ("k" * 9000)])
def test_an_error_does_not_repeat_a_long_line(line):
    with pytest.raises(JsonError) as refusal:
        parse_object(line)
    assert len(str(refusal.value)) < LONGEST_PROBLEM + 40
