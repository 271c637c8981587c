"""A stepped run through every state of the CubeStar, and the bytes of every row in each of them.

`python -m tests.emulator.device.recorded_run` prints the recording that `recorded_rows.txt` keeps.
"""

from __future__ import annotations

from collections.abc import Iterator

from starhil.emulator.profile import Profile
from starhil.emulator.truth.source import FixedTruth
from starhil.protocol.messages import FaultKind, LinkFault, Reply, Request
from starhil.protocol.unit import load_unit
from starid.attitude import Attitude
from tests.emulator.conftest import Bench

ICD = load_unit()
ATTITUDE = Attitude.from_radec_roll(251.3, 38.7, 200.0)

STEPS = (
    ("booting", 0.0, ()),
    ("standby", 1.0, ()),
    ("first frame", 2.5, (("set_mode", {"mode": "lost_in_space"}),)),
    ("tracking", 3.0, ()),
    ("mounted askew", 2.0, (
        ("set_parameter", {"parameter": 20, "value": 10.0}),
        ("set_parameter", {"parameter": 21, "value": -20.0}),
        ("set_parameter", {"parameter": 22, "value": 30.0}),
    )),
    ("turning", 2.0, ()),
    ("clock set", 1.25, (("set_unix_time", {"seconds": 1_800_000_000, "milliseconds": 250}),)),
    ("faster", 1.5, (("set_update_rate", {"rate": 5.0}), ("set_unsolicited", {"telemetry": 160, "rate": 4.0}))),
    ("configured", 1.0, (("set_star_config", {**ICD.telecommands["set_star_config"].example(), "exposure": 80}),)),
    ("configuration refused", 0.5, (
        ("set_star_config", {**ICD.telecommands["set_star_config"].example(), "min_star_pixels": 9, "max_star_pixels": 8}),
    )),
    ("refused", 0.5, (
        ("set_parameter", {"parameter": 200, "value": 1.0}),
        ("set_parameter", {"parameter": 1, "value": 1e9}),
        ("select_parameter", {"parameter": 5}),
        ("select_parameter", {"parameter": 31}),
        ("set_unsolicited", {"telemetry": 200, "rate": 1.0}),
        ("advance_image_download", {"next_frame": 1}),
        ("start_burst", {}),
        ("save_image", {"camera": "camera_1", "image_size": "size_64"}),
        ("init_image_download", {"sram": 0, "image_size": "size_64"}),
        ("load_file_block", {"file_type": "bmp", "length": 100}),
    )),
    ("image saved", 3.0, (("save_image", {"image_size": "size_128"}),)),
    ("image opened", 1.0, (
        ("init_image_download", {"sram": 0, "image_size": "size_64"}),
        ("advance_image_download", {"next_frame": 3}),
    )),
    ("file loaded", 1.0, (
        ("load_file_block", {"file_type": "bmp", "offset": 0, "length": 100}),
        ("set_hole_map_1", {"map": bytes((5,)) + bytes(15)}),
        ("set_hole_map_8", {"map": bytes(range(16))}),
        ("start_burst", {"ignore_hole_map": False}),
        ("start_burst", {"ignore_hole_map": True}),
    )),
    ("saved", 1.0, (("save_parameters", {}),)),
    ("defaults", 1.5, (("default_parameters", {}), ("select_parameter", {"parameter": 29}))),
    ("restored", 1.0, (("restore_parameters", {}),)),
    ("tracking commanded", 1.0, (("set_mode", {"mode": "tracking"}),)),
    ("cleared", 1.0, (("clear_counters", {}),)),
    ("stopped", 1.0, (("set_mode", {"mode": "standby"}),)),
    ("reset", 0.1, (("reset", {}),)),
    ("booted again", 2.0, ()),
)  # fmt: skip
"""Label, seconds to pass, telecommands before that."""


def _telecommand(bench: Bench, name: str, values: dict) -> Iterator[str]:
    row = ICD.telecommands[name]
    given = {**row.example(), **values}
    for reply in bench.send(name, row.encode(given, check=False)):
        yield f"  {name} {values}: {_shown(reply)}"
    for reply in bench.later:
        yield f"  {name} {values} later: {_shown(reply)}"
    bench.later.clear()


def _shown(reply: Reply) -> str:
    return f"{reply.kind.value} {reply.id} code {int(reply.code)} to {reply.destination} {reply.data.hex()}"


def recording() -> Iterator[str]:
    """Yield the lines of the recording."""
    bench = Bench(Profile(parameters={"canopen_node": 5}), truth=FixedTruth(ATTITUDE))
    sent: list[Reply] = []
    bench.device.signals.unsolicited.connect(sent.append)
    bench.device.power_on()
    for label, seconds, commands in STEPS:
        yield label
        if label == "standby":
            bench.device.pipeline_ready({})
        bench.pipeline.turn_rad = 0.0
        for name, values in commands:
            yield from _telecommand(bench, name, values)
        if label == "turning":
            bench.pipeline.turn_rad = 0.01
        bench.pipeline.fail = "no_match" if label == "faster" else ""
        bench.step(seconds)
        if label == "refused":
            for kind in FaultKind:
                bench.requests.count_fault(LinkFault(kind, "recorded"))
        for row in sorted(ICD.telemetry.values(), key=lambda row: row.id):
            (reply,) = bench.requests.handle(Request.of(row.id, source=7))
            yield f"  {row.name}: {_shown(reply)}"
        for reply in sent:
            yield f"  unsolicited: {_shown(reply)}"
        sent.clear()
    bench.device.pipeline_lost()
    for name in ("device_status", "precise_attitude"):
        (reply,) = bench.requests.handle(Request.of(ICD.telemetry[name].id))
        yield f"  lost {name}: {_shown(reply)}"


if __name__ == "__main__":
    print("\n".join(recording()))
