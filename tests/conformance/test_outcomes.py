"""Which cases run, what becomes of their outcomes, and what of them is printed."""

from __future__ import annotations

import io
from dataclasses import replace
from functools import partial

import pytest
from rich.console import Console

from starhil.hil_tests.conformance.case import Case, CaseFailed, CaseSkipped
from starhil.hil_tests.conformance.conformance_run import ConformanceRequest, requested_cases
from starhil.hil_tests.conformance.report import print_outcome, print_summary
from starhil.hil_tests.conformance.runner import Outcome, not_run, run_case, run_cases, select_cases
from starhil.hil_tests.errors import BenchError

pytestmark = pytest.mark.long


def case(case_id: str, run=lambda _probe: None, *, intrusive: bool = False) -> Case:
    return Case(
        case_id, case_id.rpartition(".")[0], f"title of {case_id}", "a clause", run, intrusive=intrusive
    )


CASES = [
    case("serial.framing.start"),
    case("serial.framing.end"),
    case("serial.modes.set", intrusive=True),
    case("can.id.type"),
]


@pytest.mark.parametrize(
    ("patterns", "safe_only", "chosen", "left_out"),
    [
        ([], False, [0, 1, 2, 3], []),
        ([], True, [0, 1, 3], [2]),
        (["serial.framing"], False, [0, 1], []),
        (["serial.framing"], True, [0, 1], []),
        (["*.type", "serial.framing.end"], False, [1, 3], []),
    ],
)
def test_cases_are_chosen_by_names_and_patterns(patterns, safe_only, chosen, left_out):
    selected = select_cases(CASES, patterns, safe_only=safe_only)
    assert selected == ([CASES[number] for number in chosen], [CASES[number] for number in left_out])


@pytest.mark.parametrize("others", [[], ["serial.framing"], ["can.id"]])
def test_a_pattern_of_which_safe_only_leaves_nothing_is_an_error_also_beside_another(others):
    with pytest.raises(
        BenchError,
        match=r"no case that matches 'serial.m\*' is run: 1 of 1 cases are left out, .* --intrusive runs them",
    ):
        select_cases(CASES, [*others, "serial.m*"], safe_only=True)


def test_a_pattern_without_a_case_is_an_error_that_lists_the_areas():
    with pytest.raises(
        BenchError, match=r"no conformance case matches 'serial.frame'; areas: can.id, serial.framing"
    ):
        select_cases(CASES, ["serial.framing", "serial.frame"])


@pytest.mark.parametrize(
    ("request_", "links"),
    [
        ({"serial": "/dev/x"}, {"serial"}),
        ({"can": "vcan0"}, {"can"}),
        ({"can": "vcan0", "canopen_node": 44}, {"can", "canopen"}),
        ({"unit": "oresat", "can": "vcan0", "canopen_node": 44}, {"canopen"}),
    ],
)
def test_the_cases_are_those_of_the_links_that_are_given(request_, links):
    chosen, left_out = requested_cases(ConformanceRequest(**request_))
    assert {item.id.partition(".")[0] for item in (*chosen, *left_out)} == links


@pytest.mark.parametrize(
    ("request_", "intrusive"),
    [
        ({}, False),
        ({"start": True}, True),
        ({"intrusive": True}, True),
        ({"start": True, "intrusive": False}, False),
    ],
)
def test_cases_that_change_a_device_need_the_wish_of_the_user_unless_it_was_started_for_the_run(
    request_, intrusive
):
    chosen, left_out = requested_cases(ConformanceRequest(unit="sagitta", serial="/dev/x", **request_))
    assert any(item.intrusive for item in chosen) == intrusive
    assert bool(left_out) != intrusive
    assert all(item.intrusive for item in left_out)


@pytest.mark.parametrize(
    ("request_", "message"),
    [
        ({}, r"no link: use --serial DEV"),
        ({"unit": "nos3", "can": "vcan0"}, "has no CAN link"),
        ({"unit": "nos3", "serial": "x", "dialect": "b"}, "--dialect b: unit .* has no reply dialects"),
    ],
)
def test_a_request_without_cases_is_rejected(request_, message):
    with pytest.raises(BenchError, match=message):
        requested_cases(ConformanceRequest(**request_))


class Probe:
    """A probe of a device that passes everything but what a test sets."""

    def __init__(self, **changed) -> None:
        self.log: list[str] = []
        self.calls: list[str] = []
        self._changed = changed

    def __getattr__(self, name):
        def act(*_args, **_keys):
            self.calls.append(name)
            return self._changed[name]() if name in self._changed else None

        return act


def fail():
    raise CaseFailed("nothing more", "another answer")


def skip(_probe):
    raise CaseSkipped("no such row")


def test_a_case_that_passes_but_leaves_something_behind_fails():
    outcome = run_case(Probe(end=fail), CASES[0])
    assert (outcome.status, outcome.expected, outcome.seen) == ("failed", "nothing more", "another answer")


def test_no_cases_are_no_run():
    probe = Probe()
    assert run_cases(probe, []) == []
    assert probe.calls == []


def test_settings_that_cannot_be_read_or_restored_are_outcomes_of_the_run():
    outcomes = run_cases(Probe(prepare=fail, restore=fail), [CASES[2], case("serial.x.y", skip)])
    assert [(outcome.id, outcome.status) for outcome in outcomes] == [
        ("serial.settings.found", "failed"), ("serial.modes.set", "passed"), ("serial.x.y", "skipped"), ("serial.settings.kept", "failed"),
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("seen", "text"),
    [
        ("nothing", "nothing answers on /dev/x"),
        ("1F; check --baud", "no valid answer on /dev/x: 1F; check --baud"),
    ],
)
def test_a_device_that_does_not_answer_ends_the_run(seen, text):
    outcomes = run_cases(Probe(silence=lambda: seen), CASES[:2], port="/dev/x")
    assert [(outcome.status, outcome.seen) for outcome in outcomes] == [
        ("failed", text),
        *[("not run", f"not run: {text}")] * 2,
    ]


OUTCOMES = [
    Outcome.of(CASES[0], None, 0.25),
    Outcome.of(CASES[1], CaseFailed("an answer", "no\x1banswer"), 0.25),
    Outcome.of(CASES[2], CaseSkipped("no such row"), 0.25),
    replace(not_run(CASES[3], "x"), seconds=0.25),
]


def printed(act) -> list[str]:
    console = Console(file=io.StringIO(), width=200, color_system=None)
    act(console)
    return [line.rstrip() for line in console.file.getvalue().splitlines()]


@pytest.mark.parametrize(("verbose", "marks"), [(True, "✓✗--"), (False, "✗-")])
def test_a_line_for_each_case_says_what_was_expected_and_seen(verbose, marks):
    lines = printed(
        lambda console: [print_outcome(console, outcome, verbose=verbose) for outcome in OUTCOMES]
    )
    assert "".join(line[0] for line in lines if not line.startswith(" ")) == marks
    assert "    expected an answer" in lines
    assert any(line.startswith("    seen     no") and "\x1b" not in line for line in lines)
    assert any(line.endswith("title of serial.modes.set [a clause]  no such row") for line in lines)


def test_what_no_case_judges_is_one_line_of_the_summary_unless_asked_for():
    unjudged = [
        replace(
            OUTCOMES[-2], id=f"can.unjudged.{kind}", area="can.unjudged", status="skipped", seen="of 3 fields"
        )
        for kind in ("stars", "frame")
    ]
    short, long = (
        printed(
            partial(
                lambda console, verbose: [print_outcome(console, item, verbose=verbose) for item in unjudged],
                verbose=verbose,
            )
        )
        for verbose in (False, True)
    )
    assert short == []
    assert [line.split()[1] for line in long] == ["can.unjudged.stars", "can.unjudged.frame"]
    *_, last = printed(lambda console: print_summary(console, [*OUTCOMES, *unjudged]))
    assert last == "2 cases unjudged.* list values of which only the limits are checked: --verbose shows them"


def test_the_summary_counts_by_area():
    head, *areas, total = printed(lambda console: print_summary(console, OUTCOMES))
    assert head.split() == ["area", "cases", "passed", "failed", "skipped", "not", "run", "seconds"]
    assert [line.split() for line in areas] == [
        ["serial.framing", "2", "1", "1", "0", "0", "0.5"], ["serial.modes", "1", "0", "0", "1", "0", "0.2"], ["can.id", "1", "0", "0", "0", "1", "0.2"],
    ]  # fmt: skip
    assert total == "4 cases: 1 passed, 1 failed, 1 skipped, 1 not run"
