"""Runs a life on a unit: its surroundings, power and time; `Obc` sends its requests, and the oracle judges."""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Mapping
from typing import Any, Final

from starhil.hil_tests.endurance.attitude_judge import Motion
from starhil.hil_tests.endurance.life import MOST_EVENTS, Life, Outcome
from starhil.hil_tests.endurance.obc import Obc
from starhil.hil_tests.endurance.oracle import RECOVERY_S, Oracle
from starhil.hil_tests.endurance.unit import LiveUnit
from starhil.hil_tests.endurance.violation import Violation
from starhil.hil_tests.judge.definition import Unit

DELAYED_S: Final = 10.0
"""Steps in which output that faults have delayed is awaited once they have ended, seconds."""
LONGEST_DELAY_S: Final = 86_400.0
"""Time after which delayed output must have come: streams queue up behind slow messages during waits of half a day."""
ORION: Final = {"kind": "fixed", "attitude": {"ra_deg": 83.8, "dec_deg": -1.2, "roll_deg": 0.0}}


class LifeRun:
    """Executes the steps of a life on a unit; `sigma_arcsec` are the largest standard deviations that it may leave unstated."""

    def __init__(
        self, life: Life, definition: Unit, unit: LiveUnit, sigma_arcsec: tuple[float, float]
    ) -> None:
        self._life = life
        self._definition = definition
        self._unit = unit
        parameters = dict(life.profile.get("parameters", {}))
        start_unix_s = life.profile.get("run", {}).get("start_unix_s", 1_767_225_600.0)
        self.outcome = Outcome()
        self._oracle = Oracle(definition, parameters, start_unix_s, sigma_arcsec)
        self._obc = obc = Obc(definition, unit, self._oracle, self.outcome)
        self._not_read: set[str] = set()
        """Links whose peer does not read."""
        self._lived_s = 0.0
        self._actions: dict[str, Callable[..., Awaitable[None]]] = {
            "wait": self._wait,
            "request": obc.request,
            "burst": obc.burst,
            "flood": obc.flood,
            "cut": obc.cut,
            "junk": obc.junk,
            "nmt": obc.set_state,
            "truth": self._truth,
            "fault": self._fault,
            "clear": self._clear,
            "power": self._power,
            "end_pipeline": self._end_pipeline,
            "disk": self._disk,
            "peer": self._peer,
            "recover": self._recover,
        }
        """What a step does; its other keys are the arguments."""

    async def run(self) -> Outcome:
        """Execute all steps, or those up to the first violation."""
        try:
            await self._live()
        finally:
            self._unit.set_disk(full=False)
            await self._unit.power_off()
        return self.outcome

    async def _live(self) -> None:
        unit, outcome = self._unit, self.outcome
        try:
            await unit.power_on()
            self._powered(factory=True)
            for step in self._life.steps:
                outcome.step += 1
                await self._actions[step["do"]](**{key: value for key, value in step.items() if key != "do"})
                self._obc.hear()
                self._oracle.time_passed(unit.now_s)
                outcome.violation = unit.defect()
                if outcome.violation:
                    break
        except Violation as violation:
            outcome.violation = str(violation)
        outcome.attitudes = self._oracle.attitudes.count
        outcome.device_s = self._lived_s + unit.now_s
        outcome.frames, outcome.exposed_s = unit.frames, unit.exposed_s

    # --- time and power ---

    async def _wait(self, s: float, most: int = MOST_EVENTS) -> None:
        await self._obc.pass_time(s, most=most)

    async def _power(self, *, factory: bool) -> None:
        self._lived_s += self._unit.now_s
        await self._unit.power_off(factory=factory)
        await self._unit.power_on()
        self._powered(factory=factory)

    def _powered(self, *, factory: bool) -> None:
        self._oracle.powered(factory=factory, motion=Motion.of(ORION, 0.0))
        self._oracle.disturbed |= self._not_read
        self._obc.connect()

    # --- surroundings ---

    async def _truth(self, truth: Mapping[str, Any]) -> None:
        await self._unit.set_truth(truth)
        self._oracle.moved(Motion.of(truth, self._unit.now_s))

    async def _fault(self, fault: Mapping[str, Any]) -> None:
        self._obc.hear()  # what was sent before
        self._unit.fault(fault)
        self._oracle.fault_injected(fault, self._unit.links, self._unit.now_s)
        if "reset" in fault.get("device", {}):
            self._obc.connect()

    async def _clear(self) -> None:
        self._obc.hear()  # what was sent before
        self._unit.clear_faults()
        oracle = self._oracle
        oracle.faults_ended(self._unit.now_s)
        if oracle.disturbed:
            end_s = self._unit.now_s + LONGEST_DELAY_S
            await self._unit.step(DELAYED_S)
            while any(self._unit.is_late(link) for link in oracle.disturbed):
                if self._unit.now_s > end_s:
                    raise Violation(
                        f"output that faults delayed has not come {LONGEST_DELAY_S:.0f} s after their end"
                    )
                await self._unit.step(DELAYED_S)
            for link in oracle.disturbed:
                self._unit.take(link)
            self._obc.hear()
            oracle.time_passed(self._unit.now_s)
            oracle.disturbed = set(self._not_read)
            self._obc.connect()

    async def _end_pipeline(self) -> None:
        if not await self._unit.end_pipeline():
            raise Violation("the image pipeline has not been restarted")
        self._oracle.pipeline_ended()

    async def _disk(self, *, full: bool) -> None:
        self._unit.set_disk(full=full)
        self._oracle.disk_full = full

    async def _peer(self, link: str, *, reads: bool) -> None:
        self._unit.set_peer(link, reads=reads)
        self._not_read = self._not_read - {link} if reads else self._not_read | {link}
        if not reads:
            self._oracle.disturbed.add(link)

    async def _recover(self) -> None:
        """End all faults and restore the unit; its attitude must become valid."""
        for link in self._unit.links:
            await self._peer(link, reads=True)
        await self._disk(full=False)
        await self._clear()
        await self._power(factory=True)
        await self._truth(ORION)
        await self._obc.pass_time(RECOVERY_S / 3.0)
        self._obc.connect()
        for row in self._definition.telecommands.values():
            if row.action == "set_mode":
                fields = [field for field in row.named.values() if field.argument == "mode"]
                data = row.encode({fields[0].name: "lost_in_space"})
                await self._obc.request(
                    self._unit.links[0], (row.message_class, row.id, row.kind), data.hex()
                )
                break
        await self._obc.pass_time(RECOVERY_S)
        for row in self._definition.readable.values():
            valid = [field for field in row.named.values() if field.value == "attitude.valid"]
            if valid:
                await self._obc.expect_valid(row, valid[0].name, RECOVERY_S)
                break
