"""The language of conformance cases written as text, for all links: what is sent, and what must come back.

    1F 7F 80 1F FF > 128                serial line: bytes, and the telemetry of row 128
    1F 7F 03 1F FF > 3!crc              ... or the refusal of row 3, by the name of an error
    0480{host}{device}# > 0580{device}{host}#....       CAN: frames in the format of `cansend`
    40 {text} > 43 {text} *             CANopen: a request to the node, and its answer; see `canopen_dialogue`

A step ends at a semicolon or at the end of its line; `#` after a blank begins a comment. `(00)*600` repeats a text; names
in braces are those of the file (`case_file`), of the unit and of the link. In an answer, `..` is any byte and a final
`*` any others. Steps other than traffic begin with a verb, on each link:

    sleep 0.1, drain                    wait; discard what was received
    command clear_counters              a telecommand without values, which must be accepted
    telemetry status a=1 b=true         a row with these values; of two for one field, the last
    finally                             the steps from here on follow in any case, also if one before has failed

On a serial line and on CAN there is one more verb. At the end of a case, nothing more may come, and the next request must
be answered.

    silence, silence 0.8                nothing comes within a time, s
"""

from __future__ import annotations

import inspect
import re
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from functools import cache
from math import inf
from textwrap import shorten
from typing import Annotated, Any, Final, Generic, TypeVar

from starhil.hil_tests.client.raw_traffic import parse_frame, pattern
from starhil.hil_tests.conformance.case import CaseFailed, Probe, check, check_equal
from starhil.hil_tests.conformance.link_probe import LinkProbe
from starhil.protocol.errors import OneLineError, did_you_mean

SHOWN_STEPS: Final = 4
"""Number of steps before a failed one in its message."""
SHOWN_CHARACTERS: Final = 80
"""Length to which each of them is cut."""
COMMENT: Final = re.compile(r"(?:^|\s)#")
REPEATED: Final = re.compile(r"\(([^()]*)\)\*(\d+)")
IN_BRACES: Final = re.compile(r"\{(\w+)\}")
ROW_ANSWER: Final = re.compile(r"\d+(!\w*)?")

ProbeType = TypeVar("ProbeType", bound=Probe)


def split_steps(text: str) -> list[tuple[int, str]]:
    """Return the steps of a case, with the numbers of their lines; repeated texts are written out."""
    lines = (COMMENT.split(line, 1)[0] for line in text.splitlines())
    written_out = (REPEATED.sub(lambda match: match[1] * int(match[2]), line) for line in lines)
    return [
        (number, step.strip())
        for number, line in enumerate(written_out, 1)
        for step in line.split(";")
        if step.strip()
    ]


def check_literal(word: str, *, answer: bool = False) -> None:
    """Check bytes or a frame; a name in braces is a byte or an 11-bit CAN ID, and an answer may have `..` and `*`.

    Raises BenchError, ValueError: it is neither.
    """
    head, mark, data = word.partition("#")
    digits, names = len(IN_BRACES.sub("", head)), len(IN_BRACES.findall(head))
    is_can_id = mark and names == 1 and digits in (0, 5)
    sample = IN_BRACES.sub("000" if is_can_id else "00", head) + mark + IN_BRACES.sub("00", data)
    if answer:
        pattern(sample)
    elif mark:
        parse_frame(sample)
    else:
        bytes.fromhex(sample)


def _setting(text: str) -> tuple[str, Any]:
    """Read `field=value`: a flag, a number, or the name of a value."""
    name, equals, value = text.partition("=")
    if not equals:
        raise ValueError(f"{text!r} is not FIELD=VALUE")
    if value in ("true", "false"):
        return name, value == "true"
    for read in (lambda text: int(text, 0), float):
        with suppress(ValueError):
            return name, read(value)
    return name, value


def _seconds(text: str) -> float:
    seconds = float(text)
    if not 0 <= seconds < inf:
        raise ValueError(f"{text!r} is not a time in seconds")
    return seconds


Setting = Annotated[tuple[str, Any], _setting]
Seconds = Annotated[float, _seconds]


@cache
def _signature(method: Any) -> inspect.Signature:
    return inspect.signature(method, eval_str=True)


def _read(word: str, kind: Any) -> Any:
    """Read a word as an annotation says; one with names in braces remains a text."""
    return word if "{" in word else getattr(kind, "__metadata__", [kind])[0](word)


class Dialogue(ABC, Generic[ProbeType]):
    """Holds a case over a link. Each method `do_VERB` is a verb.

    The words behind the verb are read as the annotations of the method say; a keyword-only parameter gets what follows `>`.
    """

    def __init__(self, probe: ProbeType) -> None:
        self._probe = probe

    # --- before the run ---

    @classmethod
    def faults(cls, text: str) -> list[str]:
        """Return what is wrong with the steps of a case, a line each."""
        return [
            f"line {number}: {step}: {fault}"
            for number, step in split_steps(text)
            for fault in cls._faults(step)
        ]

    @classmethod
    def _faults(cls, step: str) -> Iterator[str]:
        try:
            cls._check_step(step)
        except (OneLineError, ValueError, TypeError, LookupError, OverflowError) as error:
            yield str(error)

    @classmethod
    def _check_step(cls, step: str) -> None:
        """Check a step.

        Raises OneLineError, ValueError, TypeError, LookupError, OverflowError: it is wrong.
        """
        method, words, answer = cls._parts(step)
        if method:
            cls._bind(method, words, answer)
        elif step != "finally":
            for word in words:
                try:
                    check_literal(word)
                except (OneLineError, ValueError):
                    verbs = [name[3:].replace("_", "-") for name in dir(cls) if name.startswith("do_")]
                    hint = did_you_mean(word, verbs)
                    raise ValueError(f"{word!r} is neither bytes, a CAN frame nor a verb{hint}") from None
            cls._check_answer(words, answer)

    @classmethod
    @abstractmethod
    def _check_answer(cls, words: Sequence[str], answer: str) -> None:
        """Check what follows `>` in a step of traffic; raises as `_check_step` does."""

    @classmethod
    def _parts(cls, step: str) -> tuple[str, list[str], str]:
        """Return the method of a step, empty for traffic; its words; and what follows `>`."""
        head, _, answer = (part.strip() for part in step.partition(">"))
        words = head.split()
        method = f"do_{words[0].replace('-', '_')}" if words else ""
        return (method, words[1:], answer) if hasattr(cls, method) else ("", words, answer)

    @classmethod
    def _bind(cls, method: str, words: Sequence[str], answer: str) -> inspect.BoundArguments:
        signature = _signature(getattr(cls, method))
        keywords = [item.name for item in signature.parameters.values() if item.kind is item.KEYWORD_ONLY]
        if answer and not keywords:
            raise ValueError("nothing may follow >")
        call = signature.bind(None, *words, **({keywords[0]: answer} if answer else {}))
        for name, value in call.arguments.items():
            kind = signature.parameters[name].annotation
            if isinstance(value, tuple):
                call.arguments[name] = tuple(_read(word, kind) for word in value)
            elif value is not None:
                call.arguments[name] = _read(value, kind)
        return call

    # --- the run ---

    def hold(self, text: str) -> None:
        """Carry out the steps of a case."""
        steps = [step for _, step in split_steps(text)]
        names = self._find_names(steps)
        ready = [step.format_map(names) for step in steps]
        last = ready.index("finally") if "finally" in ready else len(ready)
        try:
            self._take(ready[:last])
        except BaseException:
            with suppress(CaseFailed):
                self._take(ready[last + 1 :])
            raise
        self._take(ready[last + 1 :])
        self._close()

    @abstractmethod
    def _find_names(self, steps: Sequence[str]) -> Mapping[str, str]:
        """Return the texts of the names in braces that are left, before the first step."""

    def _take(self, steps: Sequence[str]) -> None:
        """Take steps until one ends the dialogue."""
        for number, step in enumerate(steps):
            try:
                if self._ends_with(step):
                    return
            except CaseFailed as failure:
                before = [_shown(other) for other in steps[max(0, number - SHOWN_STEPS) : number]]
                after = f", after {'; '.join(before)}" if before else ""
                place = f"(step {number + 1}: {_shown(step)}{after})"
                raise CaseFailed(f"{failure.expected} {place}", failure.seen) from None

    def _ends_with(self, step: str) -> bool:
        """Do what a step says, and check the answer; return whether the dialogue ends with it."""
        method, words, answer = self._parts(step)
        if not method:
            return self._exchange(words, answer)
        call = self._bind(method, words, answer)
        return bool(getattr(self, method)(*call.args[1:], **call.kwargs))

    @abstractmethod
    def _exchange(self, words: Sequence[str], answer: str) -> bool:
        """Send what a step says, and check the answer; return whether the dialogue ends with it."""

    def _close(self) -> None:
        """Check what must hold after the last step."""

    # --- verbs of every link ---

    def do_sleep(self, seconds: Seconds) -> None:
        self._probe.sleep(seconds)

    def do_drain(self) -> None:
        self._probe.drain()

    def do_command(self, name: str) -> None:
        names = {row.name for row in self._probe.telecommands()}
        check(name in names, f"a telecommand {name!r} in the definition", "none")
        self._probe.command(name)

    def do_telemetry(self, name: str, setting: Setting, *settings: Setting) -> None:
        rows = {row.name: row for row in self._probe.telemetry_rows()}
        check(name in rows, f"telemetry {name!r} in the definition", "none")
        expected = dict((setting, *settings))
        values = self._probe.values(rows[name])
        check_equal({key: values.get(key, "no such field") for key in expected}, expected, name)


class LinkDialogue(Dialogue[LinkProbe]):
    """A case on a serial line or on CAN."""

    @classmethod
    def _check_answer(cls, words: Sequence[str], answer: str) -> None:
        if not words:
            raise ValueError("nothing is sent")
        for word in answer.split():
            if "#" in word:
                check_literal(word, answer=True)
            elif ROW_ANSWER.fullmatch(word) is None:
                raise ValueError(f"{word!r} is neither ROW, ROW!ERROR nor a CAN frame")

    def _find_names(self, steps: Sequence[str]) -> Mapping[str, str]:  # noqa: ARG002 -- the same for all
        return self._probe.addresses

    def _exchange(self, words: Sequence[str], answer: str) -> bool:
        self._probe.exchange(words, answer.split())
        return False

    def _close(self) -> None:
        self._probe.expect_silence("no more was requested")
        # an incomplete message ends at the start of the next one
        self._probe.expect_alive()

    def do_silence(self, seconds: Annotated[float | None, _seconds] = None) -> None:
        self._probe.expect_silence("nothing was requested", seconds)


def _shown(step: str) -> str:
    return shorten(step, SHOWN_CHARACTERS, placeholder=" …")
