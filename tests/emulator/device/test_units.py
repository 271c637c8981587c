"""The device as another unit: conventions, bindings, answers, errors, subscriptions, a plugin."""

from pathlib import Path

import numpy as np
import pytest

from starhil.emulator.errors import EmulatorError
from starhil.emulator.profile import Profile
from starhil.emulator.run import Run
from starhil.emulator.truth.source import FixedTruth
from starhil.protocol.messages import ErrorCode, ReplyKind
from starid.attitude import Attitude
from starid.camera import DEFAULT_CAMERA

HEAD = '[unit]\nname = "x"\nversion = "1"\ndoc = "d"\n'
ATTITUDE = Attitude.from_radec_roll(251.3, 38.7, 200.0)
QUATERNION = "\n".join(
    f'{{ name = "{axis}", type = "f64", value = "attitude.{axis}" }},' for axis in "xyzw"
).replace("\n", " ")


def row(kind: str, number: int, name: str, fields: str = "", more: str = "") -> str:
    """Text of a row."""
    return f'[[{kind}]]\nid = {number}\nname = "{name}"\ndoc = "d"\nprovenance = "ours"\n{more}\nfields = [{fields}]\n'


START = row("telecommand", 100, "start", more='action = "set_mode"\narguments = { mode = "lost_in_space" }')


@pytest.fixture
def unit(tmp_path: Path, make_bench):
    """A device with a definition, that has made frames."""

    def make(text: str, **options):
        (tmp_path / "unit.toml").write_text(text + START, encoding="utf-8")
        bench = make_bench(unit=str(tmp_path), truth=FixedTruth(ATTITUDE), **options).start()
        bench.command("start")
        bench.step(2.5)
        return bench

    return make


def reported(bench) -> np.ndarray:
    """The quaternion in the row `attitude`."""
    return np.array([bench.read("attitude")[axis] for axis in "xyzw"])


def test_the_attitude_quaternion_is_the_conjugate_of_the_rotation(unit):
    text = HEAD + row("telemetry", 1, "attitude", QUATERNION)
    x, y, z, w = ATTITUDE.quaternion_xyzw
    assert reported(unit(text)) == pytest.approx([x, y, z, w])
    assert reported(unit(text + '[conventions]\nquaternion = "attitude"\n')) == pytest.approx([-x, -y, -z, w])


@pytest.mark.parametrize(
    "axes", [("+y", "-x", "+z"), ("+z", "+x", "+y"), ("-x", "-y", "+z"), ("+x", "-z", "+y")]
)
def test_the_reported_frame_has_the_axes_that_the_unit_names(unit, axes):
    names = ", ".join(f'"{axis}"' for axis in axes)
    star = ", ".join(
        f'{{ name = "v{axis}", type = "f64", value = "stars[1].vector_{axis}" }}' for axis in "xyz"
    )
    bench = unit(
        f"{HEAD}[conventions]\naxes = [{names}]\n" + row("telemetry", 1, "attitude", QUATERNION + star)
    )
    rows = {"x": ATTITUDE.matrix[0], "y": ATTITUDE.matrix[1], "z": ATTITUDE.matrix[2]}
    matrix = Attitude(reported(bench)).matrix
    for mine, axis in zip(matrix, axes, strict=True):
        assert mine == pytest.approx((-1.0 if axis[0] == "-" else 1.0) * rows[axis[1]], abs=1e-12)
    values = bench.read("attitude")
    camera = DEFAULT_CAMERA.back_project(
        [[bench.device.snapshot().frame.result.stars[0].x, bench.device.snapshot().frame.result.stars[0].y]]
    )[0]
    for letter, axis in zip("xyz", axes, strict=True):
        assert values[f"v{letter}"] == pytest.approx(
            (-1.0 if axis[0] == "-" else 1.0) * camera["xyz".index(axis[1])]
        )


def test_the_sign_of_the_scalar_stays_with_the_last_where_any_is_allowed(unit):
    bench = unit(HEAD + '[conventions]\nscalar_sign = "any"\n' + row("telemetry", 1, "attitude", QUATERNION))
    first = reported(bench)
    turning = Attitude(ATTITUDE.quaternion_xyzw)
    signs = set()
    for _ in range(12):  # a whole turn about x, after which a continuous quaternion has the other sign
        turning = turning.rotated((np.radians(30.0), 0.0, 0.0))
        bench.device.surroundings.truth = FixedTruth(turning)
        bench.device.parameters.set({"max_rate": 30.0})
        bench.step(1.0)
        now = reported(bench)
        if now.any():
            assert first @ now > 0.0
            first = now
            signs.add(np.sign(now[3]))
    assert signs == {-1.0, 1.0}


def test_the_sign_of_the_scalar_does_not_depend_on_how_often_it_is_read(unit):
    text = HEAD + '[conventions]\nscalar_sign = "any"\n' + row("telemetry", 1, "attitude", QUATERNION)
    last = []
    for reads_all in (True, False):
        bench, turning = unit(text), Attitude(ATTITUDE.quaternion_xyzw)
        bench.device.parameters.set({"max_rate": 30.0})
        for _ in range(8):
            turning = turning.rotated((np.radians(30.0), 0.0, 0.0))
            bench.device.surroundings.truth = FixedTruth(turning)
            bench.step(1.0)
            if reads_all:
                reported(bench)
        last.append(reported(bench))
    assert last[0][3] < 0.0
    assert (last[0] == last[1]).all()


@pytest.mark.parametrize(
    ("epoch", "seconds"),
    [("unix", 0), ("gps", 315_964_800), ("j2000", 946_728_000), ("2020-01-01", 1_577_836_800)],
)
def test_times_count_from_the_epoch_of_the_unit(unit, epoch, seconds):
    fields = '{ name = "t", type = "f64", unit = "s", value = "clock.unix" }, { name = "f", type = "f64", unit = "s", value = "frame.time" }'
    time = '{ name = "t", type = "u64", unit = "us", argument = "microseconds" }'
    bench = unit(
        f'{HEAD}[conventions]\nepoch = "{epoch}"\n'
        + row("telemetry", 1, "times", fields)
        + row("telecommand", 2, "set_time", time, 'action = "set_clock"')
    )
    bench.command("set_time", t=1_000_000_000)
    assert bench.device.time.unix_ns() == (seconds + 1000) * 10**9
    bench.step(2.0)
    values = bench.read("times")
    assert values["t"] == pytest.approx(1002.0)
    assert 1000.0 < values["f"] < 1002.0


def test_a_day_starts_at_midnight(unit):
    fields = '{ name = "t", type = "u32", unit = "ms", value = "clock.unix" }'
    bench = unit(f'{HEAD}[conventions]\nepoch = "midnight"\n' + row("telemetry", 1, "times", fields))
    bench.device.time.set_unix_ns((20_000 * 86_400 + 3_600) * 10**9)
    assert bench.read("times")["t"] == 3_600_000


def test_values_go_out_in_the_units_and_numbers_of_the_fields(unit):
    fields = (
        '{ name = "mode", type = "u8", value = "mode", map = { "9" = "standby", "4" = ["tracking", "lost_in_space"] }, default = "standby" },'
        '{ name = "valid", type = "u8", value = "attitude.valid", map = { "0xAA" = true, "0x55" = false } },'
        '{ name = "latency", type = "u32", unit = "us", value = "frame.latency" },'
        '{ name = "sigma", type = "f64", unit = "rad", value = "attitude.sigma_cross" },'
        '{ name = "exposure", type = "u16", unit = "ms", parameter = "exposure" },'
        '{ name = "temperature", type = "i16", unit = "degC", scale = -0.5, value = "health.board" },'
        '{ name = "sync", type = "u16", const = 0xEB90, order = "big" },'
        '{ repeat = { count = 6, fields = [{ name = "hip", type = "u32", value = "stars[n].hip" }, { name = "m", type = "i8", value = "stars[n].magnitude", unit = "mag", scale = 0.1, default = 12.7 }] } }'
    )
    bench = unit(HEAD + row("telemetry", 1, "all", fields), profile=Profile(health={"board": 20.0}))
    (reply,) = bench.requests.handle(bench.icd.request(bench.icd.telemetry["all"]))
    assert reply.data[:2] == b"\x04\xaa"
    values = bench.read("all")
    assert values["latency"] == round(bench.device.snapshot().frame.latency_s * 1e6)
    assert values["sigma"] == pytest.approx(np.radians(1.5 / 3600.0))
    assert (values["exposure"], values["temperature"], values["sync"]) == (100, 20.0, 0xEB90)
    assert [values[f"hip_{n}"] for n in range(1, 7)] == [32349, 101772, 27989, 21421, 0, 0]
    assert values["m_1"] == pytest.approx(-1.4)
    assert values["m_6"] == pytest.approx(12.7)
    bench.pipeline.fail = "no_match"
    bench.step(2.0)
    assert bench.requests.handle(bench.icd.request(bench.icd.telemetry["all"]))[0].data[1] == 0x55


def test_answers_come_in_the_order_that_the_row_names(unit):
    bench = unit(
        HEAD
        + row("telemetry", 1, "status", '{ name = "up", type = "u32", unit = "s", value = "uptime.seconds" }', 'answer = ["echo", "reply"]')
        + row("telecommand", 2, "go", '{ name = "a", type = "u8", max = 5 }', 'action = "nothing"\nanswer = ["echo", "row:status"]')
        + row("telecommand", 3, "silent", more='action = "nothing"\nanswer = []')
    )  # fmt: skip
    status = bench.icd.telemetry["status"]
    echo, reply = bench.requests.handle(bench.icd.request(status))
    assert (echo.kind, echo.id, echo.final) == (ReplyKind.ECHO, 1, False)
    assert (reply.kind, reply.data, reply.final) == (ReplyKind.TELEMETRY, b"\x03\0\0\0", True)
    echo, reply = bench.send("go", a=3)
    assert (echo.kind, echo.data) == (ReplyKind.ECHO, b"\x03")
    assert (reply.kind, reply.id, reply.data) == (ReplyKind.TELEMETRY, 1, b"\x03\0\0\0")
    assert [reply.kind for reply in bench.send("go", b"\x06")] == [ReplyKind.ECHO]
    assert bench.send("silent") == []


def test_errors_have_the_numbers_of_the_unit(unit):
    bench = unit(
        HEAD + "[errors]\ninvalid_length = 20\nother = 99\n" + row("telecommand", 2, "mode", '{ name = "m", type = "u8", argument = "mode", map = { "1" = "tracking" } }', 'action = "set_mode"')
    )  # fmt: skip
    numbers = [bench.icd.error_number(bench.send("mode", data)[0].code) for data in (b"", b"\x02", b"\x01")]
    assert numbers == [20, 99, 0]
    assert bench.icd.error_name(20) == "invalid_length"


SUBSCRIPTION = (
    '{ repeat = { count = 3, fields = [{ name = "row", type = "u8", argument = "telemetry[n]", default = 0 }] } },'
    '{ name = "rate", type = "f32", unit = "Hz", argument = "rate", default = 0 }'
)


def test_a_list_of_rows_is_sent_with_each_frame_or_at_a_rate(unit):
    count = '{ name = "n", type = "u32", value = "frame.counter" }'
    bench = unit(
        HEAD
        + row("telemetry", 1, "one", count)
        + row("telemetry", 2, "two", count)
        + row("telecommand", 3, "subscribe", SUBSCRIPTION, 'action = "subscribe"')
    )
    sent = []
    bench.device.signals.unsolicited.connect(lambda reply: sent.append((reply.kind, reply.id)))
    assert bench.command("subscribe", row_1=2, row_2=1) is ErrorCode.OK
    bench.step(3.0)
    assert sent == [(ReplyKind.UNSOLICITED, 2), (ReplyKind.UNSOLICITED, 1)] * 3
    sent.clear()
    bench.command("subscribe", row_1=2, rate=10.0)
    bench.step(0.95)
    assert sent == [(ReplyKind.UNSOLICITED, 2)] * 10
    sent.clear()
    assert bench.command("subscribe", row_1=1, row_3=77) is ErrorCode.INVALID_PARAMETER
    bench.step(0.5)
    assert sent == [(ReplyKind.UNSOLICITED, 2)] * 5
    bench.command("subscribe")
    sent.clear()
    bench.step(2.0)
    assert sent == []


def test_subscriptions_end_with_a_reset(unit):
    bench = unit(
        HEAD
        + row("telemetry", 1, "one", '{ name = "n", type = "u32", value = "frame.counter" }')
        + row("telecommand", 3, "subscribe", SUBSCRIPTION, 'action = "subscribe"')
        + row("telecommand", 4, "reset", more='action = "reset"')
    )
    sent = []
    bench.device.signals.unsolicited.connect(sent.append)
    bench.command("subscribe", row_1=1, rate=5.0)
    bench.command("reset")
    bench.step(0.1)
    sent.clear()
    bench.step(3.0)
    assert sent == []


def test_a_plugin_adds_quantities_and_actions(unit, tmp_path):
    (tmp_path / "unit.py").write_text(
        "from starhil.protocol.plugin import action, quantity\n"
        '@quantity("twice.exposure", unit="s")\n'
        "def twice(snapshot):\n"
        '    return 2e-3 * snapshot.parameters["exposure"]\n'
        '@action("double")\n'
        "def double(device, arguments):\n"
        '    device.parameters.set({"exposure": 2 * device.parameters["exposure"]})\n',
        encoding="utf-8",
    )
    bench = unit(
        HEAD
        + 'plugin = "unit.py"\n'
        + row(
            "telemetry", 1, "plugged", '{ name = "t", type = "u16", unit = "ms", value = "twice.exposure" }'
        )
        + row("telecommand", 2, "double", more='action = "double"')
    )
    assert bench.read("plugged")["t"] == 200
    assert bench.command("double") is ErrorCode.OK
    assert bench.read("plugged")["t"] == 400


@pytest.mark.parametrize("exit_", ["SystemExit(3)", "GeneratorExit", "__import__('asyncio').CancelledError"])
def test_a_plugin_that_exits_ends_its_answer_and_nothing_else(unit, tmp_path, exit_):
    """The run ended with status 3, without a word."""
    (tmp_path / "unit.py").write_text(
        "from starhil.protocol.plugin import action, quantity\n"
        '@quantity("odd.value")\n'
        "def odd(snapshot):\n"
        '    if snapshot.parameters["exposure"] > 300:\n'
        f"        raise {exit_}\n"
        "    return 1\n"
        '@action("leave")\n'
        "def leave(device, arguments):\n"
        '    device.parameters.set({"exposure": 400})\n'
        f"    raise {exit_}\n",
        encoding="utf-8",
    )
    bench = unit(
        HEAD
        + 'plugin = "unit.py"\n'
        + row("telemetry", 1, "odd", '{ name = "v", type = "u8", value = "odd.value" }')
        + row("telemetry", 3, "other", '{ name = "up", type = "u32", unit = "s", value = "uptime" }')
        + row("telecommand", 2, "leave", more='action = "leave"')
    )
    assert bench.read("odd")["v"] == 1
    assert bench.command("leave") is ErrorCode.INTERNAL
    (reply,) = bench.requests.handle(bench.icd.request(bench.icd.telemetry["odd"]))
    assert reply.code is ErrorCode.INTERNAL
    assert bench.read("other")["up"] >= 0


def test_a_unit_whose_rows_are_bound_to_nothing_does_not_start(tmp_path):
    text = HEAD + row("telemetry", 1, "bare", '{ name = "a", type = "u8" }') + START
    (tmp_path / "unit.toml").write_text(text, encoding="utf-8")
    with pytest.raises(EmulatorError, match="telemetry bare: field a: no `value`"):
        Run([Profile(name="x", unit=str(tmp_path))])
