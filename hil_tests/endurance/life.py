"""The random life of a unit: steps generated from a seed and the unit's definition.

A step is a JSON object with `do`:

=================  ==================================================================================================
`do`               effect
=================  ==================================================================================================
``wait``           `s`: let simulation time pass, or less after `most` events in the unit
``request``        `link`, `row` ("class id"), `data`: send a request and judge the answers
``burst``          `link`, `rows`: send telemetry requests without waiting; the answers come in order
``flood``          `link`, `row`, `data`, `count`: send the same request many times, so that counters of 16 bits wrap
``cut``            `link`, `row`, `share`: send the first part of a request, as by a client that disconnects; another one connects
``nmt``            `link`, `command`: an NMT command, which starts or stops the PDOs of a CANopen node
``junk``           `link`, `data` or `frames`: send input that is not a request for this unit; nothing may answer
``truth``          `truth`: a table as `[truth]` in a profile
``fault``          `fault`: a request of faults as on the control channel; ``clear`` ends all faults
``power``          switch the unit off and on; `factory`: delete its stored state
``end_pipeline``   end the image pipeline unexpectedly
``disk``           `full`: whether files can be written
``peer``           `link`, `reads`: whether the peer of a link reads
``recover``        end all faults, restore the unit, and wait: its attitude must be valid
=================  ==================================================================================================

Two kinds of lives: in most, everything happens and power is switched often. In a long one, the unit is left alone for
days, without resets and with the lowest update rates, so that its counters and clocks wrap around under observation.
"""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import islice
from typing import Any, Final

from starhil.hil_tests.judge.definition import Parameter, Unit
from starhil.hil_tests.judge.links import LINKS
from starhil.hil_tests.judge.messages import Value
from starhil.hil_tests.judge.rows import PARAMETER, Field, Row

Step = dict[str, Any]

SHORTEST_S: Final = 0.001
LONGEST_S: Final = 40_000.0
"""Waits are log-uniform between these limits."""
MOST_EVENTS: Final = 400
"""Waits end early after about this many events in the unit: exposures, messages, heartbeats."""
LONG_WAIT_S: Final = (20_000.0, 300_000.0)
"""Limits of the waits of a long life."""
MOST_EVENTS_LONG: Final = {False: 40_000, True: 4000}
"""Waits of a long life end early after about this many events, by whether the unit sends heartbeats every second."""
LONG_UPDATE_RATE_HZ: Final = (0.01, 0.02)
FLOOD_REQUESTS: Final = (20_000, 40_000)
"""Limits of the number of requests in a flood."""
USUAL_SHARE: Final = 0.9
"""Share of values that are set to their default, so that the unit stays usable most of the time."""
COUNTING_QUANTITIES: Final = ("counters.", "uptime", "clock.", "boot.count")
"""Prefixes of the names of quantities that count."""
ACTION_WEIGHTS: Final = {
    "set_parameter": 6.0,
    **dict.fromkeys(("save_parameters", "restore_parameters", "default_parameters"), 2.0),
}
"""How often telecommands are sent that set any parameter, or all: as often as this many others."""
ADDRESSES: Final = frozenset({"can_address", "serial_dialect"})
"""Parameters that the OBC must follow to reach the unit."""
ADDRESS_SHARE: Final = 0.2
"""Share of these among the parameters that are set."""
CONTENT_SHARE: Final = 0.03
"""Share of steps before which the content of telemetry, or the clock, becomes wrong."""
READ_BACK_SHARE: Final = 0.5
"""Share of telecommands after which a row that reports their effect is read."""
EFFECTS: Final = {
    **dict.fromkeys(("set_parameters", "set_parameter", "select_parameter"), (PARAMETER, "selected.")),
    **dict.fromkeys(("restore_parameters", "default_parameters"), (PARAMETER, "selected.")),
    "set_clock": ("clock.",),
    "set_mode": ("mode",),
    "clear_counters": ("counters.",),
}
"""Prefixes of the names of quantities that report the effect of an action."""
NMT_COMMANDS: Final = (0x01, 0x80)
"""Start the node, and enter pre-operational; in both states SDO works."""
EDGE_CLOCKS_S: Final = (0, 2**31 - 2, 2**31, 2**32 - 2, 2**32, 1_767_225_600)
"""Clock settings next to the wraps of 2038 and 2106."""


UNRECORDED_STEPS: Final = frozenset({"disk", "end_pipeline"})
"""Steps that a recording does not contain: it would be on the full disk itself, and has no events of the pipeline."""


@dataclass(frozen=True)
class Life:
    """A life: keys of the unit's profile, and the steps in order."""

    unit: str
    """Name or folder."""
    seed: int
    links: tuple[str, ...]
    profile: dict[str, Any]
    steps: tuple[Step, ...]
    rendered: bool = False
    """Whether every image is rendered and solved; otherwise an error model takes the place of the pipeline."""


@dataclass
class Outcome:
    """What a life has shown."""

    violation: str = ""
    """What the unit did and must never do; empty if nothing."""
    step: int = -1
    """Number of the last step."""
    device_s: float = 0.0
    exposed_s: float = 0.0
    """Simulation time lived, and the part of it in which images were taken, seconds."""
    frames: int = 0
    requests: int = 0
    readings: int = 0
    attitudes: int = 0
    """Images solved, requests sent, rows and PDOs read, and valid attitudes compared with the truth."""


def make_life(
    definition: Unit,
    unit: str,
    links: tuple[str, ...],
    seed: int,
    count: int,
    *,
    is_long: bool = False,
    rendered: bool = False,
) -> Life:
    """Generate a life of `count` steps."""
    random_of_life = random.Random(f"{unit} {seed}")  # noqa: S311 (reproducible, not secret)
    commanded = any(row.action == "set_mode" for row in definition.telecommands.values())
    start_mode = random_of_life.choice(["standby", "lost_in_space"]) if commanded else "lost_in_space"
    update_rate = round(10.0 ** random_of_life.uniform(-2.0, 1.0), 3)
    if is_long:
        update_rate = round(random_of_life.uniform(*LONG_UPDATE_RATE_HZ), 4)
        links = tuple(link for link in links if link != "canopen") or links  # a heartbeat every second
    profile: dict[str, Any] = {"parameters": {"start_mode": start_mode, "update_rate": update_rate}}
    if update_rate > 2.0:
        profile["parameters"]["exposure"] = 50
    profile["run"] = {
        "start_unix_s": float(random_of_life.choice([1_767_225_600, 2**31 - 3600, 4_102_444_800]))
    }
    used = tuple(link for link in links if random_of_life.random() < 0.6) or (random_of_life.choice(links),)
    generator = LifeGenerator(definition, used, random_of_life, is_long=is_long)
    return Life(unit, seed, used, profile, tuple(islice(generator.steps(), count)), rendered)


class LifeGenerator:
    """Generates steps for a unit with these links open; a unit whose life `is_long` is left alone for days."""

    def __init__(
        self,
        definition: Unit,
        links: tuple[str, ...],
        random_of_life: random.Random,
        *,
        is_long: bool = False,
    ) -> None:
        self._definition = definition
        self._links = links
        self._random = random_of_life
        self._random_of_content = random.Random(repr(random_of_life.getstate()[1][:4]))  # noqa: S311 (reproducible)
        """Numbers of its own, so that the steps around these faults are those of a life without them."""
        self._is_long = is_long
        self._telemetry = list(definition.readable.values())
        self._telecommands = list(definition.telecommands.values())
        self._attitude_rows = [
            row for row in self._telemetry if any(field.value == "attitude.valid" for field in row.fields)
        ]
        self._count_rows = self._reporting(COUNTING_QUANTITIES)
        self._effects = {
            (row.message_class, row.id, row.kind): self._reporting(EFFECTS.get(row.action or "", ()))
            for row in self._telecommands
        }
        """Rows that report the effect of a telecommand."""
        self._results = self._reporting(("request.", "counters."))
        """Rows that report the result of any telecommand, an unknown one too."""
        self._stream_rows = [
            row for row in self._telecommands if row.action in ("select_unsolicited", "subscribe")
        ]
        self._clock_rows = [row for row in self._telecommands if row.action == "set_clock"]
        self._mode_rows = [row for row in self._telecommands if row.action == "set_mode"]
        self._command_weights = [ACTION_WEIGHTS.get(row.action or "", 1.0) for row in self._telecommands]
        harmless = [row for row in self._telecommands if row.action == "nothing"]
        self._flood_rows = [
            min(kind, key=lambda row: row.size) for kind in (self._telemetry, harmless) if kind
        ]
        """The shortest request of each kind that changes nothing."""
        self._rows = [*self._telecommands, *self._telemetry]
        always = True
        everything: list[tuple[float, Callable[[], Step], object]] = [
            (30, self._wait, always),
            (16, self._read_any, self._telemetry),
            (16, self._read_attitude, self._attitude_rows),
            (18, self._command, self._telecommands),
            (6, self._invalid, self._rows),
            (8, self._mode, self._mode_rows),
            (2, self._burst, self._telemetry),
            (2, self._junk, always),
            (1, self._cut, self._rows),
            (2, self._stream, self._stream_rows),
            (1, self._nmt, "canopen" in links),
            (5, self._truth, always),
            (4, self._fault, always),
            (8, lambda: {"do": "clear"}, always),
            (3, self._power, always),
            (0.5, lambda: {"do": "end_pipeline"}, always),
            (1, lambda: {"do": "disk", "full": self._random.random() < 0.5}, always),
            (0.5, self._peer, always),
            (2, lambda: {"do": "recover"}, always),
        ]
        """Weight of each maker of steps, and what the unit needs for it."""
        left_alone: list[tuple[float, Callable[[], Step], object]] = [
            (22, self._long_wait, always),
            (10, self._read_any, self._telemetry),
            (20, self._read_attitude, self._attitude_rows),
            (20, self._read_count, self._count_rows),
            (12, self._mode, self._mode_rows),
            (3, self._flood, self._flood_rows),
            (5, self._truth, always),
            (6, self._clock, self._clock_rows),
        ]
        possible = [
            (weight, maker) for weight, maker, needed in (left_alone if is_long else everything) if needed
        ]
        self._makers = [maker for _, maker in possible]
        self._weights = [weight for weight, _ in possible]

    def steps(self) -> Iterator[Step]:
        """Generate steps without end; the effect of a telecommand is often read back, as an OBC does."""
        while True:
            if not self._is_long and self._random_of_content.random() < CONTENT_SHARE:
                yield {"do": "fault", "fault": self._content_fault()}
            (maker,) = self._random.choices(self._makers, self._weights)
            step = maker()
            yield step
            row = tuple(step.get("row", ()))
            effects = self._effects.get(row) or (self._results if "telecommand" in row else [])
            if effects and self._random.random() < READ_BACK_SHARE:
                yield self._request(self._random.choice(effects))

    def _reporting(self, beginnings: tuple[str, ...]) -> list[Row]:
        """Return the telemetry that reports a quantity with one of these prefixes."""
        return [
            row
            for row in self._telemetry
            if any(field.quantity.startswith(beginnings) for field in row.fields)
        ]

    # --- time and requests ---

    def _wait(self) -> Step:
        exponent = self._random.uniform(math.log(SHORTEST_S), math.log(LONGEST_S))
        return {"do": "wait", "s": round(math.exp(exponent), 6)}

    def _long_wait(self) -> Step:
        most = MOST_EVENTS_LONG["canopen" in self._links]
        return {"do": "wait", "s": round(self._random.uniform(*LONG_WAIT_S), 3), "most": most}

    def _request(self, row: Row, data: bytes = b"") -> Step:
        return self._raw_request(row.message_class, row.id, row.kind, data)

    def _raw_request(self, message_class: str, row_id: int, kind: str, data: bytes) -> Step:
        step: Step = {
            "do": "request",
            "link": self._random.choice(self._links),
            "row": [message_class, row_id, kind],
        }
        return {**step, "data": data.hex()} if data else step

    def _read_any(self) -> Step:
        return self._request(self._random.choice(self._telemetry))

    def _read_attitude(self) -> Step:
        return self._request(self._random.choice(self._attitude_rows))

    def _command(self) -> Step:
        (row,) = self._random.choices(self._telecommands, self._command_weights)
        return self._request(row, row.encode(self._values(row)))

    def _mode(self) -> Step:
        row = self._random.choice(self._mode_rows)
        values = self._values(row)
        for field in row.named.values():
            if field.argument == "mode" and field.enum is not None:
                wanted = [name for name in ("lost_in_space", "tracking", "standby") if name in field.enum]
                if wanted:
                    values[field.name] = self._random.choice([wanted[0], *wanted])
        return self._request(row, row.encode(values))

    def _read_count(self) -> Step:
        return self._request(self._random.choice(self._count_rows))

    def _clock(self) -> Step:
        row = self._random.choice(self._clock_rows)
        return self._request(row, row.encode(self._values(row)))

    def _stream(self) -> Step:
        """Let the unit send telemetry without requests."""
        row = self._random.choice(self._stream_rows)
        values: dict[str, Value] = {}
        for name, field in row.named.items():
            if field.argument == "rate":
                values[name] = self._random.choice([0.0, 10.0 ** self._random.uniform(-2.0, 0.7)])
            elif (field.argument or "").startswith("telemetry"):
                sent = self._attitude_rows + self._telemetry or list(self._definition.telemetry.values())
                number = self._random.choice(sent).id
                values[name] = number if self._random.random() < 0.5 or row.size < 8 else 0
        return self._request(row, row.encode(values))

    def _flood(self) -> Step:
        """Repeat the shortest request of its kind, often enough in a life if the unit has counters of 16 bits."""
        link = self._random.choice([link for link in self._links if link != "canopen"] or self._links[:1])
        row = self._random.choice(self._flood_rows)
        narrow = any(
            (field.value or "").startswith("counters.") and field.raw_limits[1] <= 0xFFFF
            for other in self._count_rows
            for field in other.fields
        )
        count = self._random.randint(*FLOOD_REQUESTS) if narrow else FLOOD_REQUESTS[0] // 20
        data = bytes(row.size) if row.kind == "telecommand" else b""
        return {**self._request(row, data), "do": "flood", "link": link, "count": count}

    def _cut(self) -> Step:
        row = self._random.choice(self._rows)
        return {**self._request(row), "do": "cut", "share": round(self._random.uniform(0.1, 0.9), 2)}

    def _nmt(self) -> Step:
        return {"do": "nmt", "link": "canopen", "command": self._random.choice(NMT_COMMANDS)}

    def _burst(self) -> Step:
        rows = [self._random.choice(self._telemetry) for _ in range(self._random.randint(2, 6))]
        link = self._random.choice([link for link in self._links if link != "canopen"] or self._links[:1])
        return {"do": "burst", "link": link, "rows": [[row.message_class, row.id, row.kind] for row in rows]}

    # --- values ---

    def _values(self, row: Row) -> dict[str, Value]:
        values = {name: self._value(field) for name, field in row.named.items() if field.const is None}
        if row.action == "set_parameter":
            self._choose_parameter(row, values)
        return values

    def _choose_parameter(self, row: Row, values: dict[str, Value]) -> None:
        """Set one parameter of the unit, mostly to a value within its limits."""
        by_argument = {field.argument: field for field in row.named.values()}
        parameters = list(self._definition.parameters.values())
        if self._random.random() < ADDRESS_SHARE:
            parameters = [known for known in parameters if known.name in ADDRESSES] or parameters
        parameter = self._random.choice(parameters)
        number, value = by_argument.get("parameter"), by_argument.get("value")
        if number is not None and value is not None:
            values[number.name] = parameter.id
            values[value.name] = self._parameter_value(parameter)

    def _parameter_value(self, parameter: Parameter) -> float:
        chance = self._random.random()
        if chance < USUAL_SHARE and parameter.name not in ADDRESSES:
            return parameter.default_number
        if parameter.enum is not None:
            return float(self._random.choice(list(parameter.enum.values())))
        low, high = parameter.minimum, parameter.maximum
        span = high - low
        edges = [low, high, low - 1.0, high + 1.0, low - 1e-3 * span, high + 1e-3 * span, -0.0, 5e-324]
        value = self._random.choice(edges) if chance > 0.9 else self._random.uniform(low, high)
        return value if parameter.type.startswith("f") else float(round(value))

    def _value(self, field: Field) -> Value:
        chance = self._random.random()
        if field.argument in ("unix", "seconds") and chance < 0.5:
            low, high = field.limits
            inside = [second for second in EDGE_CLOCKS_S if low <= second <= high]
            if inside:
                return self._random.choice(inside)
        if field.parameter is not None and chance < USUAL_SHARE:
            default = self._definition.device_parameters[field.parameter].default
            if field.kind in ("integer", "float", "bits") and not isinstance(default, str):
                low, high = field.limits
                return min(max(default, low), high)
            if isinstance(default, str) and default in (field.enum or {}):
                return default
        return field.random_value(self._random, at_limit=chance > 0.9)

    # --- invalid input ---

    def _invalid(self) -> Step:
        row = self._random.choice(self._rows)
        match self._random.randrange(3):
            case 0:
                on_wire = any(item.code is not None for item in self._definition.classes)
                known = {
                    other.id
                    for other in self._rows
                    if not on_wire or other.message_class == row.message_class
                }
                unknown = [number for number in range(256) if number not in known]
                number = self._random.choice(unknown) if unknown else row.id
                kind = row.kind
                if not self._definition.classes:
                    is_telemetry = self._definition.is_telemetry("", number)
                    kind = "telemetry" if is_telemetry else "telecommand"
                return self._raw_request(row.message_class, number, kind, b"")
            case 1:
                size = row.size if row.kind == "telecommand" else 0
                # one byte more may be a CRC
                wrong = self._random.choice([size + 2, size + 7, max(0, size - 1)])
                return self._request(row, self._random.randbytes(wrong))
            case _:
                size = row.size if row.kind == "telecommand" else 0
                return self._request(row, self._random.randbytes(size))

    def _junk(self) -> Step:
        link = self._random.choice(self._links)
        count = self._random.randint(1, 6)
        if LINKS[link].bus == "serial":
            return {"do": "junk", "link": link, "data": self._random.randbytes(count * 3).hex()}
        frames = [
            [self._random.getrandbits(29), self._random.randbytes(self._random.randint(0, 8)).hex()]
            for _ in range(count)
        ]
        return {"do": "junk", "link": link, "frames": frames}

    # --- surroundings ---

    def _truth(self) -> Step:
        attitude = {
            "ra_deg": self._random.choice([0.0, 359.9999, self._random.uniform(0.0, 360.0)]),
            "dec_deg": self._random.choice(
                [-90.0, 90.0, math.degrees(math.asin(self._random.uniform(-1.0, 1.0)))]
            ),
            "roll_deg": self._random.uniform(0.0, 360.0),
        }
        if self._random.random() < 0.6:
            return {"do": "truth", "truth": {"kind": "fixed", "attitude": attitude}}
        scale = 10.0 ** self._random.uniform(-3.0, 1.5)
        rate = [round(self._random.gauss(0.0, scale), 9) for _ in range(3)]
        return {"do": "truth", "truth": {"kind": "rate", "attitude": attitude, "rate_deg_s": rate}}

    def _fault(self) -> Step:
        links = {LINKS[link].bus for link in self._links}
        kinds: list[dict[str, Any]] = [
            {"optical": {"blocked_share": self._random.choice([0.5, 1.0, 1.0])}},
            {"device": {"stuck": True}},
            {"device": {"error": self._random.choice(["sensor", "processing", "injected", "catalogue"])}},
            {"device": {"reset": self._random.choice(["watchdog", "brown_out", "software"])}},
        ]
        for link in sorted(links):
            kinds.append({link: {"drop": self._random.choice([0.1, 1.0])}})
            kinds.append({link: {"corrupt": 0.3, "junk": 0.3}})
            kinds.append(
                {link: {"delay_s": self._random.uniform(0.0, 3.0), "split": 3 if link == "serial" else 0}}
            )
        return {"do": "fault", "fault": self._random.choice(kinds)}

    def _content_fault(self) -> dict[str, Any]:
        """Return a fault of the content of telemetry, or of the clock, whose effect is known exactly."""
        chance = self._random_of_content
        kinds: list[dict[str, Any]] = [
            {"telemetry": [{"turn_deg": [round(chance.gauss(0.0, 10.0), 3) for _ in range(3)]}]},
            {"telemetry": []},
            {"clock": {"drift_ppm": round(chance.uniform(-200.0, 200.0), 3)}},
            {"clock": {"jump_s": chance.choice([-0.25, 0.5, 30.0])}},
        ]
        if "canopen" not in self._links and self._telemetry:
            row = chance.choice(self._telemetry)
            kinds.append({"telemetry": [{"row": row.name, "freeze": "all"}]})
            numbers = [
                name for name, field in row.named.items() if field.kind == "float" and field.scale == 1.0
            ]
            if numbers:
                kinds.append({"telemetry": [{"row": row.name, "set": {chance.choice(numbers): 0.25}}]})
        return chance.choice(kinds)

    def _power(self) -> Step:
        return {"do": "power", "factory": self._random.random() < 0.4}

    def _peer(self) -> Step:
        return {"do": "peer", "link": self._random.choice(self._links), "reads": self._random.random() < 0.6}
