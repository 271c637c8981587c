"""A reply, a stream and a sample of PDOs are of one moment, though the clock goes on while they are made."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import is_dataclass, replace
from enum import Enum
from types import MappingProxyType

import numpy as np
import pytest
from pydantic import BaseModel

from starhil.emulator.device.file_download import LOOKUP_S
from starhil.emulator.device.modes import Mode
from starhil.emulator.device.quantities import QUANTITIES, getter_of
from starhil.emulator.device.refusal import Refused
from starhil.emulator.device.snapshot import Snapshot
from starhil.emulator.device.subscriptions import Subscription
from starhil.emulator.links.canopen import DeviceApplication
from starhil.emulator.profile import Profile
from starhil.emulator.simulation.clock import SteppedClock
from starhil.protocol.canopen.device_dictionary import DeviceDictionary
from starhil.protocol.files.bundled import bundled_units
from starhil.protocol.icd import InterfaceDefinition
from starhil.protocol.icd.device_model import generic
from starhil.protocol.messages import FaultKind, LinkFault

TICK_NS = 1000


class PassingClock(SteppedClock):
    """A clock that goes on by `tick_ns` with each reading, as time passes while a row is packed."""

    def __init__(self) -> None:
        super().__init__()
        self.tick_ns = 0
        self.readings = 0

    def now_ns(self) -> int:
        """Return the simulation time, then let time pass."""
        self.readings += 1
        now_ns = super().now_ns()
        self.set_ns(now_ns + self.tick_ns)
        return now_ns


@pytest.fixture
def passing(make_bench):
    """Make a device with frames, whose clock passes from then on."""

    def start(**device):
        bench = make_bench(clock=PassingClock(), **device).start()
        bench.device.command_mode(Mode.LOST_IN_SPACE)
        bench.step(3.5)
        bench.clock.tick_ns = TICK_NS
        bench.clock.readings = 0
        return bench

    return start


@pytest.mark.parametrize("readings_before", range(8))
def test_the_end_of_a_look_up_does_not_tear_the_file_information(make_bench, readings_before):
    bench = make_bench(clock=PassingClock()).start()
    bench.command("save_image", image_size="size_64")
    bench.step(1.3)
    bench.command("reset_file_list")
    bench.step(LOOKUP_S - readings_before * TICK_NS / 1e9)
    bench.clock.tick_ns = TICK_NS
    info = bench.read("file_info")
    found = (info["counter"], info["size"])
    assert found == ((0, 0) if info["updating"] else (1, 54 + 1024 + 64 * 64)), info


@pytest.mark.parametrize("unit", bundled_units())
def test_a_reply_to_a_request_reads_the_clock_once(passing, unit):
    bench = passing(unit=unit)
    for row in bench.icd.telemetry.values():
        before = bench.clock.readings
        bench.requests.handle(bench.icd.request(row))
        assert bench.clock.readings == before + 1, row.name


def test_the_header_of_a_reply_is_of_the_moment_of_its_data(passing):
    bench = passing(unit="sagitta")
    (reply,) = bench.requests.handle(bench.icd.request(bench.icd.telemetry["solution"]))
    assert reply.time_ns - bench.device.time.offset_ns == reply.uptime_ns + bench.device.started_ns


def test_rows_that_are_sent_with_a_frame_are_of_one_moment(passing):
    bench = passing()
    rows = [bench.icd.telemetry[name] for name in ("unix_time", "device_status", "precise_attitude")]
    bench.device.subscriptions.replace("request", [Subscription(row, None) for row in rows])
    sent = []
    bench.device.signals.unsolicited.connect(sent.append)
    before = bench.clock.readings
    bench.device.signals.frame_published.emit(bench.device.latest)
    assert [reply.id for reply in sent] == [row.id for row in rows]
    assert bench.clock.readings == before + 1


def reachable(value: object, path: str, *, table: bool = False) -> Iterator[tuple[str, object]]:
    """Yield what can be reached from a value and may change, or is no value: path and object.

    Records and the tables of definition and profile are frozen; only within such a `table` lists and dicts remain.
    """
    match value:
        case None | bool() | int() | float() | str() | bytes() | Enum():
            return
        case np.ndarray():
            if value.flags.writeable:
                yield path, value
            return
        case tuple() | frozenset():
            members = [(f"{path}[{number}]", item) for number, item in enumerate(value)]
        case MappingProxyType():
            members = [(f"{path}[{key!r}]", item) for key, item in value.items()]
        case list() | set() if table:
            members = [(f"{path}[{number}]", item) for number, item in enumerate(value)]
        case dict() if table:
            members = [(f"{path}[{key!r}]", item) for key, item in value.items()]
        case BaseModel() if value.model_config.get("frozen"):
            members, table = [(f"{path}.{name}", item) for name, item in vars(value).items()], True
        case _ if is_dataclass(value) and value.__dataclass_params__.frozen:
            members = [(f"{path}.{name}", item) for name, item in vars(value).items()]
        case _:
            yield path, value
            return
    for name, item in members:
        yield from reachable(item, name, table=table)


def values_of(snapshot: Snapshot, icd: InterfaceDefinition) -> dict[str, object]:
    """Return all quantities of a snapshot."""
    values = {}
    names = [f"parameter.{name}" for name in icd.device_parameters] + ["health.board"]
    for name in QUANTITIES:
        count = icd.model.quantities[name].count
        names += [name] if count is None else [name.replace("[n]", f"[{n}]") for n in range(1, count + 1)]
    for name in names:
        try:
            values[name] = getter_of(name)(snapshot)
        except Refused as refused:
            values[name] = refused.code
    return values


@pytest.mark.parametrize("unit", bundled_units())
def test_no_quantity_can_reach_a_device_or_a_clock(passing, unit):
    bench = passing(unit=unit, profile=Profile(unit=unit, health={"board": 21.5}))
    bench.device.images.save(64)
    bench.step(1.3)
    bench.device.files.rewind()
    bench.step(0.1)
    snapshot = bench.device.snapshot()
    values_of(snapshot, bench.icd)  # what is computed at first use is kept in the snapshot
    assert snapshot.frame.valid
    assert snapshot.file is not None
    assert list(reachable(snapshot, "snapshot")) == []


PYTHON_TYPES = {"bool": bool, "int": int, "float": float, "text": str, "bytes": bytes}


def test_values_have_the_types_that_the_model_declares(passing):
    bench = passing()
    bench.command("save_image", image_size="size_64")
    bench.step(1.3)
    values = values_of(bench.device.snapshot(), bench.icd)
    declared = {name: PYTHON_TYPES[item.type] for name, item in bench.icd.model.quantities.items()}
    declared |= {name: declared[generic(name)] for name in values if "[" in name}
    wrong = {
        name: value
        for name, value in values.items()
        if name in declared and value is not None and type(value) is not declared[name]
    }
    assert wrong == {}


def test_a_door_to_the_device_would_be_found(passing):
    bench = passing()
    snapshot = bench.device.snapshot()
    for leak in (bench.device, bench.clock, bench.clock.now_ns, lambda: 0, [1], {"a": 1}, np.zeros(3)):
        assert [path for path, _ in reachable(replace(snapshot, accepted=(leak,)), "snapshot")] == [
            "snapshot.accepted[0]"
        ]


def test_a_snapshot_does_not_see_what_happens_later(passing):
    bench = passing()
    bench.clock.tick_ns = 0
    bench.command("save_image", image_size="size_64")
    bench.step(1.3)
    bench.command("reset_file_list")
    bench.command("load_file_block", file_type="bmp", file_counter=1, offset=0, length=100)
    read_now, read_later = bench.device.snapshot(), bench.device.snapshot()
    before = values_of(read_now, bench.icd)
    bench.command("set_parameter", parameter=20, value=10.0)
    bench.command("set_unix_time", seconds=1_800_000_000, milliseconds=250)
    bench.command("save_image", image_size="size_128")
    bench.pipeline.turn_rad = 0.3
    bench.step(5.0)
    bench.command("erase_file", all=True)
    bench.requests.count_fault(LinkFault(FaultKind.UART_CHECK, "later"))
    bench.device.modes.fail("sensor")
    failed = values_of(bench.device.snapshot(), bench.icd)
    bench.device.reset("watchdog")
    bench.step(60.0)
    assert values_of(read_later, bench.icd) == before
    reset = values_of(bench.device.snapshot(), bench.icd)
    changed = {name.partition(".")[0] for name in before if not before[name] == failed[name] == reset[name]}
    assert changed >= {
        "attitude",
        "frame",
        "stars[1]",
        "clock",
        "uptime",
        "mode",
        "error",
        "boot",
        "counters",
    }
    assert changed >= {"link", "request", "parameter", "image", "file", "power"}


def test_the_entries_of_a_pdo_are_of_one_moment(passing):
    bench = passing()
    rows = [bench.icd.telemetry[name] for name in ("unix_time", "device_status")]
    dictionary = DeviceDictionary(bench.icd, DeviceApplication(bench.requests, lambda *_: None))
    dictionary.new_instant()
    before = bench.clock.readings
    for row in rows:
        dictionary.row_bytes(row)
    assert bench.clock.readings == before + 1
    dictionary.new_instant()
    dictionary.row_bytes(rows[0])
    assert bench.clock.readings == before + 2
