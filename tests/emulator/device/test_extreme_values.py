"""Extreme values through every parameter and every telecommand of every bundled unit: refused, or harmless."""

import contextlib
import dataclasses
import itertools
import math
import struct

import numpy as np
import pytest

from starhil.emulator.errors import EmulatorError
from starhil.emulator.profile import Profile, load_profile
from starhil.emulator.profile.pipeline_setup import pipeline_setup
from starhil.emulator.sensor.pipeline.messages import Failure, FrameRequest, SolverSettings, camera_constants
from starhil.emulator.sensor.pipeline.pipeline import Pipeline
from starhil.emulator.truth.source import ZERO_RATE, TruthState
from starhil.protocol.files.bundled import bundled_units
from starhil.protocol.icd.values import MessageError
from starhil.protocol.unit import load_unit
from starid.errors import StaridError
from tests.emulator.conftest import ORION

pytestmark = pytest.mark.long

UNITS = sorted(bundled_units())
FLOATS = (
    0.0,
    -0.0,
    5e-324,
    -5e-324,
    1e-45,
    1e-38,
    1e10,
    3.4028234e38,
    -3.4028234e38,
)
FLOATS += (1.7976931348623157e308, -1.7976931348623157e308, math.inf, -math.inf, math.nan)
INTEGERS = (0, 1, -1, *(2**bits - sign for bits in (8, 16, 32, 64) for sign in (0, 1)), -(2**31), -(2**63))


def extremes(definition):
    """Extreme values of a parameter: of its type, and of its limits."""
    if definition.type == "f32":
        low, high = definition.minimum, definition.maximum
        inside = float(np.nextafter(np.float32(low), np.float32(high)))
        return (*FLOATS, low, high, inside)
    return (*INTEGERS, *FLOATS, definition.minimum, definition.maximum)


def errors_of(caplog):
    return [record.getMessage() for record in caplog.records if record.levelname == "ERROR"]


def read_everything(bench):
    """Request every row of telemetry; some are refused."""
    for row in bench.icd.telemetry.values():
        assert bench.requests.handle(bench.icd.request(row))


def distinct_parameters():
    """Return the parameters by unit, without those that a unit before has with the same limits."""
    seen, distinct = set(), {}
    for unit in UNITS:
        for name, definition in load_unit(unit).device_parameters.items():
            key = (name, definition.type, definition.minimum, definition.maximum)
            if key not in seen:
                seen.add(key)
                distinct.setdefault(unit, {})[name] = definition
    return distinct


DISTINCT = distinct_parameters()


@pytest.mark.parametrize("unit", DISTINCT)
def test_after_an_extreme_parameter_the_next_attitude_is_valid(make_bench, unit, caplog):
    bench = make_bench(unit=unit).start()
    device = bench.device
    device.command_mode(device.modes.mode.LOST_IN_SPACE)
    accepted = 0
    for name, definition in DISTINCT[unit].items():
        for value in extremes(definition):
            try:
                device.parameters.set({name: value})
            except MessageError:
                continue
            accepted += 1
            bench.step(1.0)
            device.parameters.set_defaults()
            bench.step(3.0)
            assert device.latest.valid, (name, value)
        read_everything(bench)
        assert errors_of(caplog) == [], name
    assert accepted > len(DISTINCT[unit])


def test_every_parameter_takes_or_refuses_an_extreme_number_from_the_wire(bench, caplog):
    for number in range(256):
        definition = bench.icd.parameters_by_id.get(number)
        for value in FLOATS if definition is None else extremes(definition):
            bench.send("set_parameter", parameter=number, value=float(value))
            bench.step(0.1)
            bench.read("parameter")
        bench.device.parameters.set_defaults()
    assert errors_of(caplog) == []


def raw_extremes(field):
    """Bytes of a field that no encoder would write: all zeros, all ones, and the special numbers of its type."""
    size = field.size
    yield from (bytes(size), b"\xff" * size, b"\x7f" + b"\xff" * (size - 1), b"\xff" * (size - 1) + b"\x7f")
    yield from (b"\x80" + bytes(size - 1), bytes(size - 1) + b"\x80", b"\x01" + bytes(size - 1))
    if field.kind == "float":
        for value in FLOATS:
            if size == 8 or not math.isfinite(value) or abs(value) < 3.5e38:
                yield from (struct.pack(order + "fd"[size // 8], value) for order in "<>")


@pytest.mark.parametrize("unit", UNITS)
def test_an_extreme_telecommand_is_answered_and_telemetry_can_be_read(make_bench, unit, caplog):
    bench = make_bench(unit=unit).start()
    for row in bench.icd.telecommands.values():
        bench.device.command_mode(bench.device.modes.mode.LOST_IN_SPACE)
        size = row.size
        payloads = {bytes(size), b"\xff" * size}
        for field in row.fields:
            for raw in raw_extremes(field):
                data = bytearray(size)
                data[field.offset : field.offset + field.size] = raw
                payloads.add(bytes(data))
        for payload in sorted(payloads):
            bench.send(row.name, payload)
            bench.step(0.1)
            assert errors_of(caplog) == [], (row.name, payload.hex())
        read_everything(bench)
        assert errors_of(caplog) == [], row.name
        bench.device.parameters.set_defaults()
    bench.device.reset("command")
    bench.step(2.0)
    bench.device.command_mode(bench.device.modes.mode.LOST_IN_SPACE)
    bench.step(4.0)
    assert bench.device.latest.valid


@pytest.fixture(scope="module")
def solve():
    """Solve one rendered image with given settings; the image is rendered once."""
    setup = dataclasses.replace(pipeline_setup(Profile()), build_in_background=False)
    pipeline = Pipeline(setup)
    nominal = dataclasses.replace(setup.settings, **camera_constants(pipeline.camera.to_dict()))
    request = FrameRequest(0, TruthState(ORION, ZERO_RATE), exposure_s=0.1, gain=1.0, settings=nominal)
    assert pipeline.handle(request).valid
    exposure = pipeline._last
    pipeline._expose = lambda _request: exposure
    return lambda **changes: pipeline.handle(
        dataclasses.replace(request, settings=dataclasses.replace(nominal, **changes))
    )


SLOW = {"limiting_magnitude": 9.0}
"""Builds the largest index, which takes seconds; a long run of tests does this anyway."""


@pytest.mark.parametrize("name", sorted(field.name for field in dataclasses.fields(SolverSettings)))
def test_the_pipeline_survives_an_extreme_parameter(solve, name):
    definition = load_unit().device_parameters[name]
    allowed = []
    for value in extremes(definition):
        try:
            allowed.append(definition.check(value))
        except MessageError:
            continue
    numbers = {struct.pack("<d", value): value for value in allowed if SLOW.get(name) != value}
    assert numbers
    for value in numbers.values():
        result = solve(**{name: value})
        if isinstance(result, Failure):
            assert "internal error" not in result.text, (name, value)
    assert solve().valid


@pytest.mark.parametrize(("term", "value"), list(itertools.product(range(5), (5e-324, -1e-310, 1e-45, 1e6))))
def test_an_extreme_distortion_in_a_profile_is_rejected_or_harmless(term, value):
    """The start of a profile with this lens is accepted, or rejected in one line."""
    distortion = [0.0] * 5
    distortion[term] = value
    profile = Profile.model_validate({"camera": {"fov_deg": 42.0, "distortion": distortion}})
    expected = pytest.raises(StaridError, match="distortion") if abs(value) > 1.0 and term in (2, 3) else None
    with expected or contextlib.nullcontext():
        assert math.isclose(Pipeline(pipeline_setup(profile)).camera.fov_deg, 42.0)


def test_an_extreme_default_in_a_profile_is_rejected_or_harmless(make_bench, caplog):
    loaded = load_profile("real_lens")
    for name, definition in load_unit().device_parameters.items():
        if definition.profile_key:
            continue  # set in [links]
        for value in extremes(definition):
            parameters = {**loaded.parameters, name: value, "start_mode": "lost_in_space"}
            with contextlib.suppress(EmulatorError):  # one line
                make_bench(loaded.model_copy(update={"parameters": parameters})).start().step(0.5)
            assert errors_of(caplog) == [], (name, value)
