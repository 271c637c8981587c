"""Each thing that a unit must never do is a violation, named as what it is: wrong answers, wrong values, wrong attitudes."""

import logging
import math
from dataclasses import replace
from itertools import count

import pytest

from starhil.emulator.cli.endurance import run_once
from starhil.emulator.launch.unit_in_memory import UnitUnderTest
from starhil.hil_tests.attitude import Quaternion, conjugate, from_rotation_vector, product
from starhil.hil_tests.endurance.attitude_judge import AttitudeJudge, Motion
from starhil.hil_tests.endurance.life import Life
from starhil.hil_tests.endurance.node import Node
from starhil.hil_tests.endurance.oracle import Oracle
from starhil.hil_tests.endurance.run import ORION
from starhil.hil_tests.endurance.violation import Violation
from starhil.hil_tests.judge.definition import read_unit
from starhil.hil_tests.judge.rows import PARAMETER
from starhil.protocol.can.frame import CanFrame

pytestmark = pytest.mark.long

UNIT = read_unit("cubestar")
IDENTIFICATION, VERSION = UNIT.telemetry["identification"], UNIT.telemetry["boot_status"]
SIGMA_ARCSEC = (5.0, 25.0)
UNKNOWN = 60
"""ID of no telecommand."""
NO_ROW = next(number for number in range(128, 256) if ("", number) not in UNIT.by_key)
ACK, REFUSED, TELEMETRY, SEGMENT, UNSOLICITED = 2, 3, 5, 8, 12


def frame(kind, row_id, data=b""):
    """Return a CAN frame from the unit to the OBC."""
    return CanFrame(kind << 24 | row_id << 16 | 4 << 8 | 1, data)


def request(row_id, kind="telemetry", link="can"):
    return {"do": "request", "link": link, "row": ["", row_id, kind]}


def violation(monkeypatch, change, *steps, links=("can",), profile=None):
    """Return the violation of a life of a unit whose output is changed: `change` gets frames and returns others."""
    take = UnitUnderTest.take

    def changed(unit, link):
        taken = take(unit, link)
        at_s = taken[-1][0] if taken else unit.now_s
        return [(at_s, item) for item in change([item for _, item in taken])]

    monkeypatch.setattr(UnitUnderTest, "take", changed)
    steps = ({"do": "wait", "s": 2.0}, *steps)
    return run_once(Life("cubestar", 1, links, profile or {}, steps)).violation


# -- answers -----------------------------------------------------------------------------------------------------------

READ, COMMAND = (request(IDENTIFICATION.id),), (request(UNKNOWN, "telecommand"),)
TWO = {"do": "burst", "link": "can", "rows": [["", row.id, "telemetry"] for row in (IDENTIFICATION, VERSION)]}
COUNTS = {
    **TWO,
    "rows": [
        ["", UNIT.telemetry[name].id, "telemetry"] for name in ("identification", "communication_status")
    ],
}
STUCK = {"do": "fault", "fault": {"device": {"stuck": True}}}


def answer(replacement):
    """Replace each answer, not what comes by itself."""
    return lambda frames: [new for old in frames for new in replacement(old)]


def inject(*frames):
    """Add frames that nobody has asked for."""
    return lambda taken: [*taken, *frames]


WRONG_ANSWERS = {
    "answers twice": (answer(lambda old: [old, old]), READ, "can: identification: 2 answers"),
    "answers nothing": (answer(lambda _: []), READ, "can: identification: no answer"),
    "refuses": (answer(lambda _: [frame(6, 128, b"\6")]), READ, "can: identification: refused with 6, must be accepted"),
    "answers with a wrong type": (answer(lambda _: [frame(31, 128)]), READ, "can: identification: malformed, 4 bytes: 1f 80 04 01"),
    "answers another OBC": (answer(lambda old: [replace(old, id=old.id + 1)]), READ, "can: identification: malformed"),
    "answers with another row": (answer(lambda _: [frame(TELEMETRY, 229, bytes(6))]), READ, "can: identification: telemetry of 229, 6 bytes"),
    "answers too short": (answer(lambda old: [replace(old, data=old.data[:7])]), READ, "identification: 7 bytes, not 8"),
    "accepts an unknown ID": (answer(lambda _: [frame(ACK, UNKNOWN)]), COMMAND, "can: 60: accepted, must be refused"),
    "refuses with a wrong code": (answer(lambda _: [frame(REFUSED, UNKNOWN, b"\2")]), COMMAND, "can: 60: refused with 2, not 1"),
    "refuses twice": (answer(lambda old: [old, old]), COMMAND, "can: 60: 2 answers to a refused request"),
    "ignores an unknown ID": (answer(lambda _: []), COMMAND, "can: 60: no answer, must be refused"),
    "answers without a request": (inject(frame(TELEMETRY, 128, bytes(8))), (), "can: telemetry of 128, 8 bytes"),
    "streams to another OBC": (inject(replace(frame(UNSOLICITED, 128, bytes(8)), id=UNSOLICITED << 24 | 0x800405)), (), "can: unsolicited of 128, 8 bytes: 00 00 00 00 00 00 00 00 to address 5, not 1"),
    "streams as another unit": (inject(replace(frame(UNSOLICITED, 128, bytes(8)), id=UNSOLICITED << 24 | 0x800501)), (), "can: malformed, 12 bytes: 0c 80 05 01"),
    "sends a file": (inject(frame(SEGMENT, 119, b"1234567\1"), frame(SEGMENT, 119, b"1234567\0")), (), "can: a packet of a file that nobody requested"),
    "sends an unknown row": (inject(frame(UNSOLICITED, NO_ROW, b"1")), (), f"can: unsolicited unsolicited of {NO_ROW}, 1 bytes"),
    "loses one of two answers": (lambda frames: frames[:1], (TWO,), "can: 1 answers to 2 requests"),
    "answers the second of two with a wrong value": (lambda frames: [*frames[:-1], replace(frames[-1], data=b"\xff" * 6)] if len(frames) == 2 else frames, (COUNTS,), "communication_status."),
    "answers in another order": (lambda frames: frames[::-1], (TWO,), "where identification was next"),
    "speaks while it is stuck": (inject(frame(TELEMETRY, 128, bytes(8))), (STUCK,), "can: telemetry of 128"),
    "ends a message early": (answer(lambda old: [replace(old, id=old.id + (3 << 24), data=bytes(7) + b"\1")]), READ, "can: identification: malformed"),
}  # fmt: skip


@pytest.mark.parametrize("name", WRONG_ANSWERS)
def test_a_wrong_answer_is_a_violation(monkeypatch, name):
    change, steps, expected = WRONG_ANSWERS[name]
    assert expected in violation(monkeypatch, change, *steps)


@pytest.mark.parametrize(
    ("speaks_at", "step", "expected"),
    [
        ("fault", {"do": "wait", "s": 1.0}, "can: output of an unresponsive unit"),
        ("deliver", *READ, "an unresponsive unit answers telemetry of 128"),
    ],
)
def test_what_an_unresponsive_unit_sends_is_a_violation(monkeypatch, speaks_at, step, expected):
    happened = []
    real = getattr(UnitUnderTest, speaks_at)
    monkeypatch.setattr(UnitUnderTest, speaks_at, lambda *given: (real(*given), happened.append(given)))

    def speak(frames):
        return [*frames, frame(TELEMETRY, 128, bytes(8))] if happened else frames

    assert violation(monkeypatch, speak, STUCK, step).startswith(expected)


LONG = max(UNIT.telecommands.values(), key=lambda row: row.size)


@pytest.mark.parametrize(
    "step",
    [
        {"do": "junk", "link": "can", "frames": [[4 << 24 | 128 << 16 | 0x0109, ""]]},
        {"do": "cut", "link": "can", "row": ["", LONG.id, "telecommand"], "share": 0.5},
    ],
    ids=["of another unit", "incomplete"],
)
def test_an_answer_to_what_is_no_request_of_the_unit_is_a_violation(monkeypatch, step):
    waiting = []
    deliver = UnitUnderTest.deliver

    def deliver_and_answer(unit, link, item):
        deliver(unit, link, item)
        waiting.append(frame(TELEMETRY, 128, bytes(8)))

    def with_answers(frames):
        answers = list(waiting)
        waiting.clear()
        return [*frames, *answers]

    monkeypatch.setattr(UnitUnderTest, "deliver", deliver_and_answer)
    assert violation(monkeypatch, with_answers, step).startswith("can: telemetry of 128, 8 bytes")


VALID = next(row for row in UNIT.telemetry.values() if any(f.value == "attitude.valid" for f in row.fields))


@pytest.mark.parametrize(
    ("is_valid", "answers", "expected"),
    [
        (True, False, f"can: {VALID.name}: no answer after all faults have ended"),
        (False, True, f"{VALID.name}: no valid attitude 15 s after the last fault has ended"),
        (True, True, ""),
    ],
)
def test_a_unit_that_does_not_recover_is_a_violation(monkeypatch, is_valid, answers, expected):
    def mute(frames):
        return [item for item in frames if answers or item.id >> 16 & 0xFF != VALID.id]

    dark = {"optical": {"blocked_share": 1.0}}
    if not is_valid:
        monkeypatch.setattr(
            UnitUnderTest, "clear_faults", lambda unit: unit.fault(dark)
        )  # it stays dark whatever clears the faults
        power_on = UnitUnderTest.power_on

        async def power_on_in_the_dark(unit):
            await power_on(unit)
            unit.fault(dark)

        monkeypatch.setattr(UnitUnderTest, "power_on", power_on_in_the_dark)
    assert violation(monkeypatch, mute, {"do": "recover"}) == expected


def command(name, **values):
    row = UNIT.telecommands[name]
    return {**request(row.id, "telecommand"), "data": row.encode(values).hex()}


FLOOD = {**request(IDENTIFICATION.id), "do": "flood", "count": 5}
EXPOSURE = (
    command("select_parameter", parameter=UNIT.parameters["exposure"].id),
    request(UNIT.telemetry["parameter"].id),
)
HARMLESS = {
    "a flood": ((FLOOD, *READ), 6),
    "a flood to an unresponsive unit": ((STUCK, FLOOD), 0),
    "the start of a long request": (({**request(37, "telecommand"), "do": "cut", "share": 0.5}, *READ), 1),
    "the restored parameters": ((command("set_parameter", parameter=UNIT.parameters["exposure"].id, value=80.0), command("restore_parameters"), *EXPOSURE), 4),
    "the default parameters": ((command("default_parameters"), *EXPOSURE), 3),
}  # fmt: skip


@pytest.mark.parametrize("name", HARMLESS)
def test_what_a_unit_may_do_is_no_violation(name):
    steps, requests = HARMLESS[name]
    outcome = run_once(Life("cubestar", 1, ("can",), {}, ({"do": "wait", "s": 2.0}, *steps)))
    assert (outcome.violation, outcome.requests) == ("", requests)


# -- the node ----------------------------------------------------------------------------------------------------------

NODE = 44
WRONG_FRAMES = {
    "a heartbeat of no state": (CanFrame(0x72C, b"\x33", extended=False), "canopen: a frame 72Ch 33 that the unit does not define"),
    "a heartbeat of two bytes": (CanFrame(0x72C, b"\5\0", extended=False), "canopen: a frame 72Ch 0500 that"),
    "a CAN ID of nothing": (CanFrame(0x123, b"", extended=False), "canopen: a frame 123h  that"),
    "an unknown emergency": (CanFrame(0x0AC, b"\x34\x12" + bytes(6), extended=False), "canopen: EMCY 1234h, which no event has caused"),
    "an emergency without an error": (CanFrame(0x0AC, b"\1\xff" + bytes(6), extended=False), "canopen: EMCY FF01h in standby"),
    "a short TPDO": (CanFrame(0x1AC, b"\1", extended=False), "TPDO 1ACh: 1 bytes"),
}  # fmt: skip


@pytest.mark.parametrize("name", WRONG_FRAMES)
def test_a_frame_that_a_node_must_not_send_is_a_violation(monkeypatch, name):
    sent, expected = WRONG_FRAMES[name]
    assert violation(monkeypatch, inject(sent), links=("canopen",)).startswith(expected)


def test_an_emergency_in_the_error_mode_and_its_end_are_no_violation():
    oracle, node = oracle_of(), Node(UNIT)
    oracle.failed()
    for code in (0xFF01, 0):
        assert node.judge(CanFrame(0x080 + NODE, code.to_bytes(2, "little") + bytes(6)), NODE, oracle) == 0


# -- values ------------------------------------------------------------------------------------------------------------


def oracle_of(unit=UNIT, mode="standby"):
    """Return the oracle of a unit ten seconds after power-on, at rest."""
    oracle = Oracle(unit, {"start_mode": mode}, 1.7e9, SIGMA_ARCSEC)
    oracle.powered(factory=True, motion=Motion.of(ORION, 0.0))
    oracle.time_passed(10.0)
    return oracle


def field_of(quantity, unit=UNIT):
    return next(
        field for row in unit.telemetry.values() for field in row.fields if field.quantity == quantity
    )


WRONG_VALUES = [
    (PARAMETER + "tracking_enable", not UNIT.parameters["tracking_enable"].default, "but the parameter tracking_enable is"),
    (PARAMETER + "exposure", 101.0, "101.0, not 100.0"),
    ("mode", "tracking", "tracking, but only standby is possible"),
    ("clock.milliseconds", 500, "500, not 0.0"),
    ("clock.seconds", 1_700_000_100, "not 1700000010.0"),
    ("uptime", 90.0, "90.0, not 10.0"),
    ("boot.count", 3, "3, not 1"),
]  # fmt: skip


@pytest.mark.parametrize(("quantity", "value", "expected"), WRONG_VALUES, ids=[q for q, _, _ in WRONG_VALUES])
def test_a_wrong_value_is_a_violation(quantity, value, expected):
    with pytest.raises(Violation) as caught:
        oracle_of().judge("row", {quantity: (field_of(quantity), value)})
    assert expected in str(caught.value)


def test_a_number_that_is_none_is_a_violation():
    row = UNIT.telemetry["precise_attitude"]
    data = row.encode({"uncertainty_cross": math.nan})
    with pytest.raises(Violation, match=r"precise_attitude\.uncertainty_cross: nan"):
        oracle_of().read(row, data)


def test_the_counter_of_images_never_goes_back_but_wraps_and_is_zero_without_an_image():
    oracle, field = oracle_of(), field_of("frame.counter")
    for value in (7, 9, 0, 9, 200, 3):
        oracle.judge("row", {"frame.counter": (field, value)})
    with pytest.raises(Violation, match="frame_counter: 2 after 3"):
        oracle.judge("row", {"frame.counter": (field, 2)})


def test_what_is_not_known_is_learned_and_judged_from_then_on():
    oracle = oracle_of()
    oracle.forget()
    names = ("counters.telemetry", "boot.count", PARAMETER + "exposure")
    for number, wrong in ((500, None), (500, None), (700, Violation)):
        for name in names:
            reading = {name: (field_of(name), number)}
            if wrong is None:
                oracle.judge("row", reading)
            else:
                with pytest.raises(wrong):
                    oracle.judge("row", reading)


def test_an_unknown_parameter_must_be_refused():
    row = UNIT.telecommands["set_parameter"]
    known = row.encode({"parameter": UNIT.parameters["exposure"].id, "value": 50.0})
    unknown = row.encode({"parameter": 253, "value": 50.0})
    assert oracle_of().verdict(row, UNIT.request(row, known)) is None  # bounded by other parameters
    assert oracle_of().verdict(row, UNIT.request(row, unknown)) == "invalid_parameter"


def test_a_lens_is_dark_since_it_was_first_covered():
    oracle = oracle_of()
    oracle.covered(fully=True)
    oracle.time_passed(20.0)
    oracle.covered(fully=True)
    assert oracle.attitudes.dark_since_s == 10.0
    oracle.covered(fully=False)
    assert oracle.attitudes.dark_since_s is None


def test_a_clock_set_to_a_time_of_day_is_not_known(tmp_path):
    (tmp_path / "unit.toml").write_text(
        '[unit]\nname = "x"\nversion = "1"\ndoc = "d"\nprovenance = "ours"\n[conventions]\nepoch = "midnight"\n'
        '[[telecommand]]\nid = 1\nname = "set"\ndoc = "d"\naction = "set_clock"\n'
        'fields = [{ name = "t", type = "u32", unit = "s", argument = "seconds" }]\n'
        '[[telemetry]]\nid = 2\nname = "clock"\ndoc = "d"\nfields = ["u32 t s", { name = "c", type = "u32", unit = "s", value = "clock.seconds" }]\n'
        "unbound = 'zeros'\n"
    )
    unit = read_unit(tmp_path)
    oracle, row = oracle_of(unit), unit.telecommands["set"]
    field = field_of("clock.seconds", unit)
    with pytest.raises(Violation):
        oracle.judge("clock", {"clock.seconds": (field, 5)})
    oracle.executed(row, unit.request(row, row.encode({"t": 5})), "ok", sure=True)
    oracle.judge("clock", {"clock.seconds": (field, 5)})


# -- attitudes ---------------------------------------------------------------------------------------------------------

TRUTH = Motion.of(ORION, 0.0).attitude
IDENTITY = Quaternion(0.0, 0.0, 0.0, 1.0)
GEN2 = read_unit("cubestar-gen2")


def reading_of(q, *, valid=True, unit=UNIT, stars=()):
    """Return an attitude, or stars, as a row reports them."""
    read = {"attitude.valid": valid}
    read |= dict(zip((f"attitude.{letter}" for letter in "xyzw"), q, strict=False))
    for number, (seen, known) in enumerate(stars, 1):
        for kind, vector in (("vector", seen), ("icrs", known)):
            read |= {
                f"stars[{number}].{kind}_{axis}": value for axis, value in zip("xyz", vector, strict=True)
            }
    return {name: (field_of(name, unit), value) for name, value in read.items()}


def turned(q, arcsec, axis=(1.0, 0.0, 0.0)):
    return product(from_rotation_vector([math.radians(-arcsec / 3600.0) * part for part in axis]), q)


def judge(read, *, imaging=True, now_s=10.0, dark_since_s=None, unit=UNIT, forget=()):
    """Judge a reading; return the number of attitudes compared with the truth."""
    oracle = oracle_of(unit, "lost_in_space")
    oracle.values |= dict.fromkeys(forget)
    attitudes = oracle.attitudes
    attitudes.dark_since_s = dark_since_s
    attitudes.judge("row", read, now_s, imaging=imaging)
    return attitudes.count


def seen_at(q, known):
    """Return the direction of a star in the sensor."""
    return product(product(q, Quaternion(*known, 0.0)), conjugate(q))[:3]


def two_stars(angle_deg, shift=0.0, q=IDENTITY):
    """Return two stars an angle apart, seen with an attitude, the second one shifted."""
    angle = math.radians(angle_deg)
    known = [(0.0, 0.0, 1.0), (math.sin(angle), 0.0, math.cos(angle))]
    first, second = (seen_at(q, vector) for vector in known)
    return [(first, known[0]), ((second[0] + shift, *second[1:]), known[1])]


WRONG_ATTITUDES = {
    "a quaternion that is not valid": ({"read": reading_of(TRUTH, valid=False)}, "row: quaternion .* though the attitude is invalid"),
    "stars that are not valid": ({"read": reading_of((), valid=False, unit=GEN2, stars=two_stars(8.0))}, "2 identified stars though the attitude is invalid"),
    "standby": ({"read": reading_of(TRUTH), "imaging": False}, "a valid attitude in a mode without images"),
    "a covered lens": ({"read": reading_of(TRUTH), "now_s": 100.0, "dark_since_s": 1.0}, "a valid attitude 99.000 s after the lens was covered"),
    "a length": ({"read": reading_of([1.1 * number for number in TRUTH])}, "the quaternion has length 1.1"),
    "across": ({"read": reading_of(turned(TRUTH, 80.0))}, "80.00 arcsec across and 0.00 about .* 6 sigma are 30.00 and 150.00"),
    "about": ({"read": reading_of(turned(TRUTH, 200.0, (0.0, 0.0, 1.0)))}, "0.00 arcsec across and 200.00 about"),
    "two stars": ({"read": reading_of((), unit=GEN2, stars=two_stars(8.0, 0.01)), "unit": GEN2}, "too near or too far apart"),
    "stars elsewhere": ({"read": reading_of((), unit=GEN2, stars=two_stars(8.0)), "unit": GEN2}, "arcsec across"),
}  # fmt: skip


@pytest.mark.parametrize("name", WRONG_ATTITUDES)
def test_a_wrong_attitude_is_a_violation(name):
    arguments, expected = WRONG_ATTITUDES[name]
    with pytest.raises(Violation, match=expected):
        judge(**arguments)


JUDGED = {
    "the truth": ({"read": reading_of(TRUTH)}, 1),
    "within six sigma": ({"read": reading_of(turned(TRUTH, 29.0))}, 1),
    "stars": ({"read": reading_of((), unit=GEN2, stars=two_stars(8.0, q=TRUTH)), "unit": GEN2}, 1),
    "stars too near for an attitude": ({"read": reading_of((), unit=GEN2, stars=two_stars(0.05)), "unit": GEN2}, 0),
    "an unknown mounting": ({"read": reading_of(IDENTITY), "forget": ["mounting_alpha"]}, 0),
    "stars in an unknown mounting": ({"read": reading_of((), unit=GEN2, stars=two_stars(8.0)), "unit": GEN2, "forget": ["mounting_beta"]}, 0),
    "an unknown period": ({"read": reading_of(IDENTITY), "forget": ["update_rate"]}, 0),
}  # fmt: skip


@pytest.mark.parametrize("name", JUDGED)
def test_a_right_attitude_is_compared_where_it_can_be(name):
    arguments, expected = JUDGED[name]
    assert judge(**arguments) == expected


@pytest.mark.parametrize(
    ("sign", "scalar", "counted"), [("positive", 0.5, 1), ("positive", 0.05, 0), ("any", 0.5, 0)]
)
def test_three_numbers_are_an_attitude_if_the_scalar_is_known(sign, scalar, counted):
    q = Quaternion(math.sqrt(1.0 - scalar**2), 0.0, 0.0, scalar)
    conventions = UNIT.conventions.model_copy(update={"scalar_sign": sign})
    judge_ = AttitudeJudge(conventions, oracle_of().values, SIGMA_ARCSEC)
    judge_.motions = [Motion(0.0, q, (0.0, 0.0, 0.0))]
    judge_.judge("row", reading_of(q[:3]), 10.0, imaging=True)
    assert judge_.count == counted


# -- inside ------------------------------------------------------------------------------------------------------------


def growing(first, step):
    numbers = count(first, step)
    return lambda _unit: next(numbers)


def failing(_unit):
    logging.getLogger("starhil.internal").error("ValueError: x")
    return 0


@pytest.mark.parametrize(
    ("name", "function", "expected"),
    [
        ("open_descriptors", failing, "internal error: ValueError: x"),
        ("queued_events", lambda _unit: 5001, "5001 events are queued"),
        ("open_descriptors", growing(10, 5), "descriptors are open, 10 at the start"),
        ("memory_bytes", growing(0, 65 << 20), "65 MiB of memory more than at the start"),
    ],
)
def test_what_grows_inside_a_unit_is_a_violation(monkeypatch, name, function, expected):
    monkeypatch.setattr(UnitUnderTest, name, function)
    assert run_once(Life("sagitta", 1, ("serial",), {}, ({"do": "wait", "s": 1.0},))).violation.endswith(
        expected
    )
