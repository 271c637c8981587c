"""Every key of every fault, injected by scenario, session, control channel (as the pytest fixture does) and console: the same bytes.

A low Earth orbit is flown on the stepped clock, with one recording for each way. Every second one key is injected for half a
second, so that a key without effect, or one that goes on after its end, is found too. A new key is tried without a
change here, unless the form of the console has a list, a table or a group for it: then it needs an example.
"""

from __future__ import annotations

import asyncio
import json
import os
import zlib
from bisect import bisect_left
from contextlib import suppress
from dataclasses import replace
from operator import itemgetter
from typing import Any, Final

import pytest

from starhil.emulator.console.describe import fault_controls
from starhil.emulator.device.clock_errors import ClockFault
from starhil.emulator.device.telemetry_faults import TelemetryFault
from starhil.emulator.launch import RunOptions
from starhil.emulator.launch.replay import replay
from starhil.emulator.links.wire_faults import WireFault
from starhil.emulator.profile import load_profile
from starhil.emulator.run.faults import DeviceFault, FaultRequest
from starhil.emulator.run.recorder import EVENTS_FILE
from starhil.emulator.sensor.pipeline.messages import FrameRequest
from starhil.emulator.sensor.sky.tables import OPTICAL_FAULT
from starhil.hil_tests.rig.control import ControlClient
from starhil.hil_tests.rig.rig import LinkOptions, Rig
from starhil.hil_tests.session.script import load_script
from starhil.hil_tests.session.session import run_steps
from starhil.protocol.serial.stack import SerialStack
from starhil.protocol.unit import load_unit
from tests.emulator.console.pages import OPTIONS, Page
from tests.waiting import wait_until

pytestmark = [pytest.mark.long, pytest.mark.usefixtures("prompt_pages")]

LEVELS: Final = {
    "optical": OPTICAL_FAULT,
    "telemetry": TelemetryFault,
    "serial": WireFault,
    "can": WireFault,
    "clock": ClockFault,
    "device": DeviceFault,
}
"""Levels of faults, that of which some outlast their end last; the keys of each are the fields of its model."""

ROW: Final = {"cubestar": "precise_attitude", "sagitta": "solution"}
HELD: Final = {"row": "precise_attitude", "drop": True}
PLACE: Final = {"ra_deg": 80.0, "dec_deg": -5.0}
EXAMPLES: Final[dict[str, dict[str, dict[str, Any]]]] = {
    "optical": {
        "moon": {"moon": {**PLACE, "magnitude": -10.0}},
        "sun": {"sun": {**PLACE, "exclusion_deg": 20.0}},
        "earth": {"earth": {**PLACE, "radius_deg": 60.0}},
        "planets": {"planets": [{**PLACE, "magnitude": 2.0, "name": "debris"}]},
        "obstructions": {"obstructions": [{"share": 0.3, "angle_deg": 90.0}]},
        "false_star_magnitudes": {"false_star_magnitudes": [1.0, 2.5]},
        "satellites": {"satellites": {"count": 40, "planes": 4, "altitude_km": 700.0}},
        "catalog_errors": {"catalog_errors": [{"hip": 27989, "fainter": 1.0}]},
    },
    "telemetry": {
        "row": {"row": "device_status", "drop": True},
        "probability": {**HELD, "probability": 0.5},
        "count": {**HELD, "count": 1},
        "after_s": {**HELD, "after_s": 0.2},
        "for_s": {**HELD, "for_s": 0.2},
        "every_s": {**HELD, "for_s": 0.1, "every_s": 0.2},
        "freeze": {"freeze": "attitude"},
        "turn_deg": {"turn_deg": [0.0, 0.5, 0.0]},
        "set": {"set": {"q_x": 0.5}},
        "offset": {"offset": {"q_x": 0.1}},
        "nan": {"row": "precise_attitude", "nan": ["q_x"]},
        "negate": {"negate": ["q_x"]},
        "answer_with": {"row": "precise_attitude", "answer_with": "device_status"},
    },
    "serial": {"split": {"split": 40}, "gap_s": {"split": 40, "gap_s": 0.005}},
    "can": {"split": {"split": 4}, "gap_s": {"split": 4, "gap_s": 0.005}},
    "clock": {"drift_ppm": {"drift_ppm": 80_000.0}, "drift_ppm_c": {"drift_ppm_c": 900.0}},
    "device": {
        "upset": {"upset": {"parameter": "exposure", "bit": 3}},
        "error": {"error": "sensor"},
        "reset": {"reset": "software"},
    },
}
"""What is injected for a key, with the other keys that it needs; the others are made from their range."""

WITHOUT_EFFECT: Final = {("can", "split"), ("can", "gap_s")}
"""Keys without effect on what is sent and read here: a CAN frame cannot be split."""

OTHER_UNIT: Final = {("telemetry", "wrong_check"): "sagitta"}
"""Keys that need what `cubestar` has not, and a unit that has it."""

FIRST_S: Final = 2.7137
"""Time of the first fault, seconds: no event of the device is due then, and the clock passes a second during the fault."""

QUARTER_S: Final = 0.25
EPOCH_S: Final = 1_780_000_000


def derived(control: dict[str, Any]) -> Any:
    """Return a value of a control that is not its default."""
    if control["kind"] == "flag":
        return True
    assert control["kind"] in ("number", "integer"), f"{control['name']} needs an example"
    low, high = control["min"] or 0.0, control["max"]
    value = high if high <= 1.0 else min(max(low, 0.0) + 0.3 * (high - max(low, 0.0)), 0.15)
    return max(1, int(low)) + 1 if control["kind"] == "integer" else value


def _after_all_others(key: str) -> int:
    """Return the order of keys: an error lasts until a restart, whose periods begin when a later fault would be injected."""
    return {"error": 1, "reset": 2}.get(key, 0)


def contents(unit: str) -> list[tuple[str, str, dict[str, Any]]]:
    """Return level, key and content of every fault to try on a unit."""
    controls = {level["level"]: level["controls"] for level in fault_controls(load_unit(), ["serial", "can"])}
    requests = []
    for level, model in LEVELS.items():
        by_name = {control["name"]: control for control in controls[level]}
        for key in sorted(model.model_fields, key=_after_all_others):
            if OTHER_UNIT.get((level, key), "cubestar") == unit:
                content = EXAMPLES.get(level, {}).get(key) or {key: derived(by_name[key])}
                requests.append((level, key, content))
    return requests


def request_of(level: str, content: dict[str, Any]) -> dict[str, Any]:
    """Return a request for a fault; of telemetry without an effect, for none."""
    value: Any = content
    if level == "telemetry":
        value = (
            [content] if set(content) - {"row", "probability", "count", "after_s", "for_s", "every_s"} else []
        )
    return {"do": "fault", level: value}


def without(key: str, content: dict[str, Any]) -> dict[str, Any]:
    """Return what is injected to see what a key does: the same without it, and without what needs it."""
    return {name: value for name, value in content.items() if name != key}


def filled_in(controls: list[dict[str, Any]], content: dict[str, Any]) -> dict[str, Any]:
    """Return the values of a form of the console in which a content was typed, as faults.js reads them."""
    by_name = {control["name"]: control for control in controls}
    values = {}
    for name, item in content.items():
        control = by_name[name]
        match control["kind"]:
            case "group":
                values[name] = filled_in(control["controls"], item)
            case "flag":
                values[name] = item is True
            case "choice":
                assert item in control["values"]
                values[name] = item
            case "list" | "table":
                values[name] = json.loads(json.dumps(item))
            case "text":
                values[name] = str(item)
            case _:
                assert float(str(item)) != control["default"]
                assert control["min"] is None or item >= control["min"]
                assert control["max"] is None or item <= control["max"]
                values[name] = item
    return values


def toml(value: Any) -> str:
    """Return a value in TOML, in one line."""
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{key} = {toml(item)}" for key, item in value.items()) + " }"
    if isinstance(value, list):
        return "[" + ", ".join(toml(item) for item in value) + "]"
    return json.dumps(value)


class Obc:
    """An OBC that asks and sets the time at given times, and waits for nothing."""

    def __init__(self, emulation) -> None:
        self.icd = emulation.icd
        self._stack = SerialStack(self.icd)
        self._line = os.open(emulation.ready_fields["serial"], os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        self._arrived = 0
        emulation.traffic.passed.connect(self._passed)

    def _passed(self, item) -> None:
        if not item.outgoing and item.bus == "serial":
            self._arrived += len(item.item)

    def tick(self, number: int) -> None:
        """Read a row; every other time, set the clock first, because what faults did to it stays."""
        requests = [self.icd.request(self.icd.readable[0])]
        if self.icd.name == "cubestar":
            requests = [self.icd.request(self.icd.telemetry["device_status"])]
            if number % 2:
                row, at_s = self.icd.telecommands["set_unix_time"], FIRST_S + number // 2 + 3 * QUARTER_S
                values = {"seconds": EPOCH_S + int(at_s), "milliseconds": int(at_s % 1.0 * 1000)}
                requests.insert(0, self.icd.request(row, row.encode(values)))
        data = b"".join(map(self._stack.encode_request, requests))
        due = self._arrived + len(data)
        assert os.write(self._line, data) == len(data)
        wait_until(lambda: self._arrived >= due)
        with suppress(BlockingIOError):
            while os.read(self._line, 1 << 16):
                pass

    def close(self) -> None:
        os.close(self._line)


def schedule(requests: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the requests of a whole run: each fault, its end, and the steps between, after which the OBC talks."""
    step = {"do": "step", "seconds": QUARTER_S}
    first = {"do": "step", "seconds": FIRST_S}
    return [
        first,
        *(each for fault in requests for each in (fault, step, step, {"do": "clear_faults"}, step, step)),
    ]


class Ways:
    """The ways to make the requests of a schedule; each returns when the run is over."""

    def __init__(self, emulation, obc, folder, loop) -> None:
        self.emulation, self.obc, self.folder, self.loop = emulation, obc, folder, loop
        self._steps = 0

    def _stepped(self) -> None:
        """Let the OBC talk in the middle between two requests."""
        self._steps += 1
        if self._steps > 1 and self._steps % 2 == 0:
            self.obc.tick(self._steps // 2 - 1)

    def pytest(self, requests) -> None:
        with ControlClient(self.emulation.ready_fields["control"]) as control:
            for request in requests:
                keys = dict(request)
                control.do(keys.pop("do"), **keys)
                if request["do"] == "step":
                    self._stepped()

    def session(self, requests) -> None:
        steps = []
        for request in requests:
            keys = dict(request)
            steps.append(
                f'[[step]]\nname = "{request["do"]}"\ncontrol = "{keys.pop("do")}"\nwith = {toml(keys)}\n'
            )
        script = self.folder / "session.toml"
        script.write_text("\n".join(steps))
        options = LinkOptions(serial=self.emulation.ready_fields["serial"])
        with Rig(options, self.obc.icd, control=self.emulation.ready_fields["control"]) as rig:

            def done(result) -> None:
                assert result.status == "passed", result
                if result.name == "step":
                    self._stepped()

            run_steps(load_script(script, self.obc.icd), rig, self.folder, on_result=done)

    def console(self, requests) -> None:
        def wait(awaitable):
            return asyncio.run_coroutine_threadsafe(awaitable, self.loop).result()

        async def opened():
            return await Page(self.emulation).__aenter__()

        page = wait(opened())
        (hello,) = [message for message in page.messages if message["type"] == "hello"]
        controls = {level["level"]: level["controls"] for level in hello["faults"]}
        for request in requests:
            fields = dict(request)
            for level in set(fields) & set(LEVELS):
                content = fields[level]
                whole = (
                    [filled_in(controls[level], each) for each in content]
                    if isinstance(content, list)
                    else filled_in(controls[level], content)
                )
                fields[level] = whole
            answer = wait(page.ask(do="control", request=fields))
            assert answer["ok"], (request, answer)
            if request["do"] == "step":
                self._stepped()
        wait(page.__aexit__())

    def scenario(self, requests) -> None:
        """The faults are in the file that the run was started with."""
        with ControlClient(self.emulation.ready_fields["control"]) as control:
            for request in requests:
                if request["do"] == "step":
                    control.do("step", seconds=request["seconds"])
                    self._stepped()


def scenario_file(path, requests) -> str:
    """Write the scenario of a schedule."""
    at_s, events = 0.0, []
    for request in requests:
        keys = dict(request)
        match keys.pop("do"):
            case "step":
                at_s = round(at_s + request["seconds"], 4)
            case "fault":
                events.append(f"[[at]]\nrun_time_s = {at_s}\nfault = {toml(keys)}\n")
            case _:
                events.append(f"[[at]]\nrun_time_s = {at_s}\nclear_faults = true\n")
    path.write_text("\n".join(events))
    return str(path)


SETTINGS: Final = {
    "cubestar": [
        "orbit=leo",
        "links.serial.dialect=c",
        "parameters.unsolicited_rate=5",
        "parameters.unsolicited_selection=160",
    ],
    "sagitta": ["orbit=leo"],
}


@pytest.fixture
def recorded(run, tmp_path):
    """Record a run with a schedule made in one way; return the folder."""
    handle = run.pipeline.handle

    def seeing(request):
        """Answer as the pipeline does, and let the number of matched stars tell which optical faults it was given."""
        result = handle(request)
        if isinstance(request, FrameRequest) and request.solve:
            reported = (
                zlib.crc32(json.dumps(request.faults, sort_keys=True).encode()) % 200 if request.faults else 0
            )
            result = replace(result, matched=4 + reported)
        return result

    run.pipeline.handle = seeing

    def recorded(way: str, name: str, unit: str, faults):
        requests = schedule(faults)
        folder = tmp_path / name
        script = scenario_file(tmp_path / f"{name}.toml", requests) if way == "scenario" else ""
        options = RunOptions(control="auto", record=folder, scenario=script, console=OPTIONS.console)
        profile = load_profile(
            "ideal",
            [
                *SETTINGS[unit],
                "truth.kind=rate",
                "truth.rate_deg_s=[0.1,0.2,0.3]",
                "parameters.start_mode=lost_in_space",
                "parameters.update_rate=10",
                "parameters.exposure=30",
            ],
        )
        keys = profile.model_dump(exclude_unset=True)
        links = {"serial": {**keys.get("links", {}).get("serial", {}), "port": "auto"}}
        if unit == "cubestar":
            links["can"] = {"channel": f"virtual:{name}"}

        async def scenario(emulation, _line):
            obc = Obc(emulation)
            ways = Ways(emulation, obc, tmp_path, asyncio.get_running_loop())
            await asyncio.to_thread(getattr(ways, way), requests)
            obc.close()

        run(scenario, options=options, unit=unit, **{**keys, "links": links, "run": {"clock": "stepped"}})
        return folder

    return recorded


def sent(folder) -> list[tuple[int, str, str]]:
    """Return time, link and data of all that a recorded device has sent."""
    lines = map(json.loads, (folder / EVENTS_FILE).read_text().splitlines())
    return [(line["ns"], line["link"], line["data"]) for line in lines if line["do"] == "out"]


def between(items, begin_s: float, end_s: float):
    """Return the items of an interval, with their times, of a list in order of time."""
    begin, end = (bisect_left(items, 1e9 * at_s, key=itemgetter(0)) for at_s in (begin_s, end_s))
    return items[begin:end]


def test_the_levels_are_those_of_a_request():
    assert set(LEVELS) == set(FaultRequest.model_fields) - {"phase"}


@pytest.mark.parametrize("unit", ["cubestar", "sagitta"])
def test_each_key_does_the_same_in_every_way_and_is_repeated_to_the_byte(recorded, unit):
    faults = contents(unit)
    requests = [request_of(level, content) for level, _, content in faults]
    bare = [request_of(level, without(key, content)) for level, key, content in faults]
    usual = sent(recorded("pytest", "bare", unit, bare))
    folders = {
        way: recorded(way, way, unit, requests) for way in ("pytest", "session", "console", "scenario")
    }
    outputs = {way: sent(folder) for way, folder in folders.items()}
    idle, lasting, unlike = [], [], []
    for number, (level, key, _) in enumerate(faults):
        begin_s = FIRST_S + number
        for way, output in outputs.items():
            if between(output, begin_s, begin_s + 1.0) != between(outputs["pytest"], begin_s, begin_s + 1.0):
                unlike.append((level, key, way))
        during = [between(each, begin_s, begin_s + 0.5) for each in (usual, outputs["pytest"])]
        after = [between(each, begin_s + 0.8, begin_s + 1.0) for each in (usual, outputs["pytest"])]
        if during[0] == during[1]:
            idle.append((level, key))
        if after[0] != after[1] and level != "device":
            lasting.append((level, key))
    assert (unlike, set(idle) - WITHOUT_EFFECT, lasting) == ([], set(), [])
    assert all(outputs.values())
    for way in (
        "pytest",
        "scenario",
    ):  # the tapes of the others have the same requests and output as the first
        assert asyncio.run(replay(folders[way])).differences == []
