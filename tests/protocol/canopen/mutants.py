"""Mutants of the CANopen slave: one defect each, as one change in one module."""

from __future__ import annotations

from contextlib import AbstractContextManager
from dataclasses import dataclass

from tests.planted import Edit, planted


@dataclass(frozen=True)
class Mutant:
    """A defect: in `module` the text `old` is `new`. `area` is where the cases are that ought to find it."""

    name: str
    area: str
    module: str
    old: str
    new: str

    def planted(self) -> AbstractContextManager[None]:
        """Put the defect into the running slave."""
        return planted(Edit(f"canopen.{self.module}", self.old, self.new))


MUTANTS = (
    # SDO, expedited and segmented
    Mutant("upload reports the wrong number of unused bytes", "sdo", "sdo_transfer", "bytes([0x43 | unused << 2])", "bytes([0x43])"),
    Mutant("segmented upload reports no size", "sdo", "sdo_transfer", "bytes([0x41]) + data[1:4]", "bytes([0x40]) + data[1:4]"),
    Mutant("segmented upload reports a wrong size", "sdo", "sdo_transfer", "answer = bytes([0x41]) + data[1:4] + len(value).to_bytes", "answer = bytes([0x41]) + data[1:4] + (len(value) + 1).to_bytes"),
    Mutant("download answered without its multiplexer", "sdo", "sdo_transfer", "answer = bytes([0x60]) + data[1:4] + bytes(4)", "answer = bytes([0x60]) + bytes(7)"),
    Mutant("upload toggle bit not checked", "sdo", "sdo_transfer", "data[0] >> 5 == 3)\n            if command & 0x10 != toggle:", "data[0] >> 5 == 3)\n            if False:"),
    Mutant("download toggle bit not checked", "sdo", "sdo_transfer", "data[0] >> 5 == 0)\n            if command & 0x10 != toggle:", "data[0] >> 5 == 0)\n            if False:"),
    Mutant("upload toggle bit not echoed", "sdo", "sdo_transfer", "bytes([toggle | unused << 1 | last])", "bytes([unused << 1 | last])"),
    Mutant("download toggle bit not echoed", "sdo", "sdo_transfer", "bytes([0x20 | toggle])", "bytes([0x20])"),
    Mutant("last upload segment not marked", "sdo", "sdo_transfer", "toggle | unused << 1 | last", "toggle | unused << 1"),
    Mutant("unused bytes of download segments taken as data", "sdo", "sdo_transfer", "buffer.data += data[1 : 8 - unused]", "buffer.data += data[1:8]"),
    Mutant("too many bytes of a download cut off", "sdo", "sdo_transfer", "        if len(self.data) > self.maximum:\n            raise", "        if len(self.data) > self.maximum:\n            del self.data[self.maximum :]\n        if False:\n            raise"),
    Mutant("unknown command not answered", "sdo", "sdo", '        if self._protocol is None or self._transfer is None:\n            raise SdoAbortError(AbortCode.COMMAND, f"0x{command:02X} without a transfer")', "        if self._protocol is None or self._transfer is None:\n            return []"),
    Mutant("abort of the client answered", "sdo", "sdo", "command == ABORT:\n            self.reset()\n            return\n", "command == ABORT:\n            self._abort(AbortCode.GENERAL, 0, 0)\n            return\n"),
    Mutant("abort of the client not obeyed", "sdo", "sdo", "command == ABORT:\n            self.reset()\n            return\n", "command == ABORT:\n            return\n"),
    Mutant("no time-out of transfers", "sdo", "sdo", "self.next_deadline = self._context.now + patience_s if self.busy else None", "self.next_deadline = None"),
    Mutant("time-out with the wrong code", "sdo", "sdo", "self._abort(AbortCode.TIMEOUT,", "self._abort(AbortCode.GENERAL,"),
    Mutant("transfer goes on after its abort", "sdo", "sdo_transfer", "data[0] >> 5 == 3)\n            if command & 0x10 != toggle:\n                raise SdoAbortError(AbortCode.TOGGLE)", "data[0] >> 5 == 3)\n            if command & 0x10 != toggle:\n                answer = bytes([0x80]) + answer[1:4] + AbortCode.TOGGLE.to_bytes(4, 'little')\n                continue"),
    Mutant("SDO answered in STOPPED", "sdo", "sdo", "if len(data) != LENGTH or not self._context.communicates:", "if len(data) != LENGTH:"),
    Mutant("short frames taken as SDO", "sdo", "sdo", "        if len(data) != LENGTH or not", '        data = data.ljust(LENGTH, b"\\0")\n        if not'),
    Mutant("extended frames answered", "sdo", "slave", "if frame.extended or frame.remote is not guarding", "if frame.remote is not guarding"),
    Mutant("expedited download without a size refused", "sdo", "sdo_transfer", "else min(4, entry.size or 4)", "else 4"),
    Mutant("abort names no object", "sdo", "sdo", "ABORT, index, subindex, code", "ABORT, 0, 0, code"),
    # SDO block transfer
    Mutant("block upload numbers segments from 0", "sdo-block", "sdo_transfer", "bytes([number + 1]) + block", "bytes([number]) + block"),
    Mutant("last segment of a block upload not marked", "sdo-block", "sdo_transfer", "if end >= len(value):", "if False:"),
    Mutant("block upload with a wrong CRC", "sdo-block", "sdo_transfer", "crc_hqx(value, 0) if data", "crc_hqx(value, 0xFFFF) if data"),
    Mutant("block upload ends with wrong unused bytes", "sdo-block", "sdo_transfer", "-len(value) % SEGMENT if value", "len(value) % SEGMENT if value"),
    Mutant("block upload does not repeat", "sdo-block", "sdo_transfer", "position + good * SEGMENT, len", "position + len(segments) * SEGMENT, len"),
    Mutant("block upload takes any block size", "sdo-block", "sdo_transfer", "if not 1 <= size <= MAXIMUM_BLOCK:", "if size > 255:"),
    Mutant("block upload ignores the client's block size", "sdo-block", "sdo_transfer", "block_size = _valid_block_size(data[2])", "_valid_block_size(data[2])\n            block_size = 127"),
    Mutant("more confirmed than sent not noticed", "sdo-block", "sdo_transfer", "if good > len(segments):", "if good > 127:"),
    Mutant("block upload confirmed before its start", "sdo-block", "sdo_transfer", "data[0] >> 5 == 5 and data[0] & 0x03 == 3)", "data[0] >> 5 == 5 and data[0] & 0x03 in (2, 3))"),
    Mutant("block upload ends at any time", "sdo-block", "sdo_transfer", "            _command(data, data[0] >> 5 == 5 and data[0] & 0x03 == 2)\n", "            if data[0] & 0x03 == 1:\n                return []\n            _command(data, data[0] >> 5 == 5 and data[0] & 0x03 == 2)\n"),
    Mutant("block download CRC not checked", "sdo-block", "sdo_transfer", "if has_crc and crc_hqx", "if False and crc_hqx"),
    Mutant("block download confirms a gap", "sdo-block", "sdo_transfer", "bytes([0xA2, good, MAXIMUM_BLOCK])", "bytes([0xA2, number, MAXIMUM_BLOCK])"),
    Mutant("block download takes segments after a gap", "sdo-block", "sdo_transfer", "expected = number == good + 1", "expected = True"),
    Mutant("block download keeps unused bytes", "sdo-block", "sdo_transfer", "del buffer.data[-unused:]", "pass"),
    Mutant("block download without its confirmation", "sdo-block", "sdo_transfer", "return [bytes([0xA1]) + bytes(7)]", "return []"),
    Mutant("protocol switch threshold turned round", "sdo-block", "sdo_transfer", "if threshold and len(value) <= threshold:", "if threshold and len(value) >= threshold:"),
    # Object dictionary
    Mutant("missing object reported as missing sub-index", "od", "dictionary", "raise SdoAbortError(AbortCode.NO_OBJECT,", "raise SdoAbortError(AbortCode.NO_SUBINDEX,"),
    Mutant("missing sub-index reported as missing object", "od", "dictionary", "raise SdoAbortError(AbortCode.NO_SUBINDEX,", "raise SdoAbortError(AbortCode.NO_OBJECT,"),
    Mutant("read-only objects written", "od", "dictionary", "if not entry.variable.writable:", "if False:"),
    Mutant("write-only objects read", "od", "dictionary", "if not entry.variable.readable:", "if False:"),
    Mutant("too long values cut off", "od", "dictionary", "        check_length(entry, len(data))\n", "        data = data[: entry.size]\n        check_length(entry, len(data))\n"),
    Mutant("too short values taken", "od", "dictionary", "        check_length(entry, len(data))\n", "        data = data.ljust(entry.size or 0, b'\\0')\n        check_length(entry, len(data))\n"),
    Mutant("high limit not checked", "od", "dictionary", "if variable.max is not None and value > variable.max:", "if False:"),
    Mutant("low limit off by one", "od", "dictionary", "value < variable.min:", "value < variable.min - 1:"),
    Mutant("values not kept", "od", "dictionary", "        entry.value = data\n        self.changed", "        self.changed"),
    Mutant("a default that is not the EDS's", "od", "dictionary", "            if entry.reader is None:\n                entry.value", "            if entry.reader is None and entry.key[0] != 0x1017:\n                entry.value"),
    Mutant("default identifiers without the node-ID", "od", "dictionary", "        default += node_id\n", "        default += 0\n"),
    # NMT and error control
    Mutant("state is left by an error in PRE-OPERATIONAL only", "error-control", "slave", "behaviour == 0 and self.state is NmtState.OPERATIONAL", "behaviour == 0 and self.state is NmtState.PRE_OPERATIONAL"),
    Mutant("no boot-up message", "nmt", "slave", 'context.send(ERROR_CONTROL + context.node_id, b"\\0")', "pass"),
    Mutant("boot-up message reports PRE-OPERATIONAL", "nmt", "slave", 'context.send(ERROR_CONTROL + context.node_id, b"\\0")', 'context.send(ERROR_CONTROL + context.node_id, b"\\x7f")'),
    Mutant("starts by itself", "nmt", "slave", "        context.state = NmtState.PRE_OPERATIONAL\n", "        context.state = NmtState.OPERATIONAL\n"),
    Mutant("commands to all nodes ignored", "nmt", "slave", "data[1] not in {0, self.node_id}", "data[1] != self.node_id"),
    Mutant("commands to other nodes obeyed", "nmt", "slave", " or data[1] not in {0, self.node_id}", ""),
    Mutant("commands of wrong length obeyed", "nmt", "slave", "len(data) != 2 or", "len(data) < 2 or"),
    Mutant("stop and PRE-OPERATIONAL exchanged", "nmt", "slave", "2: NmtState.STOPPED, 128: NmtState.PRE_OPERATIONAL", "128: NmtState.STOPPED, 2: NmtState.PRE_OPERATIONAL"),
    Mutant("reset of communication ignored", "nmt", "slave", "elif command in {RESET_NODE, RESET_COMMUNICATION}:", "elif command == RESET_NODE:"),
    Mutant("reset does not restore parameters", "nmt", "slave", "        self.store.load()\n", ""),
    Mutant("heartbeat reports PRE-OPERATIONAL always", "error-control", "error_control", "bytes([self._context.state]))\n            self._next", "bytes([0x7F]))\n            self._next"),
    Mutant("heartbeat at a tenth of its period", "error-control", "error_control", "self._producer.number() * 1e-3, now)", "self._producer.number() * 1e-4, now)"),
    Mutant("heartbeat not switched off", "error-control", "error_control", "period_ms * 1e-3 if period_ms else None\n\n    def _producer", "(period_ms or 50) * 1e-3\n\n    def _producer"),
    Mutant("guarding does not toggle", "error-control", "error_control", "self._toggle ^= 0x80", "pass"),
    Mutant("guarding toggle not reset", "error-control", "error_control", "        self._toggle = 0\n        self._life_deadline = None\n", "        self._life_deadline = None\n"),
    Mutant("guarding answered beside the heartbeat", "error-control", "error_control", "if self._producer.number() or self._context.state", "if self._context.state"),
    Mutant("no life guarding", "error-control", "error_control", "self._context.now + life_s if life_s else None", "None"),
    Mutant("watch begins at once", "error-control", "error_control", "self._monitors[node_id] = Monitor(period_ms * 1e-3)", "self._monitors[node_id] = Monitor(period_ms * 1e-3, self._context.now + period_ms * 1e-3)"),
    Mutant("watched node's silence not noticed", "error-control", "error_control", "monitor.deadline = self._context.now + monitor.period_s", "monitor.deadline = None"),
    Mutant("watched node's return not noticed", "error-control", "error_control", "        if monitor.lost:\n", "        if False:\n"),
    Mutant("error behaviour ignored", "error-control", "slave", "if behaviour == 0 and", "if behaviour != 2 and"),
    Mutant("one node watched twice", "error-control", "error_control", "if period_ms and any(", "if False and any("),
    # SYNC, TIME, EMCY
    Mutant("SYNC of wrong length taken", "sync", "sync", "wrong = len(data) != (1 if self._overflow.number() else 0)", "wrong = False"),
    Mutant("counter overflow of 1 taken", "sync", "sync", "if data[0] == 1 or data[0] > LARGEST_OVERFLOW:", "if data[0] > LARGEST_OVERFLOW:"),
    Mutant("counter overflow changed while a period is set", "sync", "sync", "if self._period.number():", "if False:"),
    Mutant("SYNC counter begins at 0", "sync", "sync", "self._counter = self._counter % overflow + 1", "self._counter = (self._counter + 1) % overflow"),
    Mutant("SYNC produced in STOPPED", "sync", "sync", "        if not self._context.communicates:\n            return\n        overflow", "        overflow"),
    Mutant("restricted identifiers taken", "sync", "cob", "if any(first <= can_id <= last for first, last in RESTRICTED_IDS):", "if False:"),
    Mutant("extended identifiers taken", "sync", "cob", "if cob_id & EXTENDED or can_id > 0x7FF:", "if False:"),
    Mutant("TIME moved while it is consumed", "time", "timestamp", "enabled=lambda value: bool(value & CONSUMER_BIT)", "enabled=lambda value: False"),
    Mutant("EMCY without the generic bit", "emcy", "emergency", "= bits | ErrorRegister.GENERIC", "= bits & ~ErrorRegister.GENERIC"),
    Mutant("EMCY repeated", "emcy", "emergency", "        if (code, key) in self._active:\n            return\n", ""),
    Mutant("EMCY of 7 bytes", "emcy", "emergency", "MESSAGE.build(fields)", "MESSAGE.build(fields)[:7]"),
    Mutant("error register stays", "emcy", "emergency", "if self._active.pop((code, key), None) is None:", "if (code, key) not in self._active:"),
    Mutant("history oldest first", "emcy", "emergency", "self._history.insert(0, code |", "self._history.append(code |"),
    Mutant("history without end", "emcy", "emergency", "        del self._history[self._capacity :]\n", ""),
    Mutant("history cannot be cleared", "emcy", "emergency", "        self._history.clear()\n\n    def _check", "        self._history\n\n    def _check"),
    Mutant("history takes any number", "emcy", "emergency", 'if data != b"\\0":', "if False:"),
    Mutant("EMCY sent though it is off", "emcy", "emergency", "if exists(self._cob_id.number()):", "if True:"),
    Mutant("EMCY inhibit time ignored", "emcy", "emergency", "self._inhibit.number() * INHIBIT_UNIT_S", "0"),
    Mutant("EMCY sent in STOPPED", "emcy", "emergency", "while self._queue and self._context.communicates and", "while self._queue and"),
    # PDO
    Mutant("TPDO sent in PRE-OPERATIONAL", "tpdo", "pdo", "self.exists and self._context.state is NmtState.OPERATIONAL", "self.exists and self._context.communicates"),
    Mutant("cyclic TPDO one SYNC late", "tpdo", "pdo", "if self._syncs >= kind:", "if self._syncs > kind:"),
    Mutant("cyclic TPDO at every SYNC", "tpdo", "pdo", "if self._syncs >= kind:", "if self._syncs >= 1:"),
    Mutant("acyclic TPDO at every SYNC", "tpdo", "pdo", "            if self._event:\n                self._send()\n            return", "            self._send()\n            return"),
    Mutant("SYNC start value ignored", "tpdo", "pdo", "if counter and counter != self._sync_start.number():", "if False:"),
    Mutant("event-driven TPDO at SYNC", "tpdo", "pdo", "if not self.active or not self._synchronous:\n            return", "if not self.active:\n            return\n        if not self._synchronous:\n            self._send()\n            return"),
    Mutant("event timer not restarted", "tpdo", "pdo", "        self._event = False\n        self._restart_timer()\n        try:", "        self._event = False\n        self._event_at = None\n        try:"),
    Mutant("inhibit time ignored", "tpdo", "pdo", "self._free_at = self._context.now + self._inhibit.number() * 1e-4", "self._free_at = self._context.now"),
    Mutant("inhibit time in milliseconds", "tpdo", "pdo", "self._inhibit.number() * 1e-4", "self._inhibit.number() * 1e-3"),
    Mutant("no event at a write", "design", "slave", "            self.pdos.trigger(changed)\n", ""),
    Mutant("mapping changed while it counts", "tpdo", "pdo_mapping", "        if self._count.number():\n            raise", "        if False:\n            raise"),
    Mutant("mapping changed while the PDO is in use", "tpdo", "pdo_mapping", "    def _require_disabled(self) -> None:\n        if self._valid:", "    def _require_disabled(self) -> None:\n        if False:"),
    Mutant("more than 64 bits mapped", "tpdo", "pdo_mapping", "if size > LARGEST_PDO:", "if size > 64:"),
    Mutant("unmappable objects mapped", "tpdo", "pdo_mapping", "if not variable.pdo_mappable or not usable", "if not usable"),
    Mutant("wrong lengths mapped", "tpdo", "pdo_mapping", "if entry.size is None or bits != entry.size * 8:", "if entry.size is None:"),
    Mutant("reserved transmission types taken", "tpdo", "pdo_mapping", "if data[0] > LAST_CYCLIC and data[0] not in EVENT_DRIVEN:", "if False:"),
    Mutant("inhibit time of a PDO in use changed", "tpdo", "pdo", "self._inhibit.writer = self._check_disabled", "pass"),
    Mutant("identifier of a PDO in use changed", "tpdo", "pdo_mapping", "        check_change(self._cob_id.number(), new, enabled=exists)\n", ""),
    Mutant("changed PDO keeps its old configuration", "tpdo", "slave", "            self.pdos.configure(changed)\n", ""),
    Mutant("TPDOs of one SYNC from different samples", "design", "device_dictionary", "if self._sample is None or self._sample[0] != self.instant:", "if True:"),
    Mutant("RPDO acts in PRE-OPERATIONAL", "rpdo", "pdo", "        if self._context.state is not NmtState.OPERATIONAL:\n", "        if not self._context.communicates:\n"),
    Mutant("synchronous RPDO acts at once", "rpdo", "pdo", "            self._pending = data\n", "            self._apply(data)\n"),
    Mutant("short RPDO processed", "rpdo", "pdo", "        if len(data) < self._size:\n", "        data = data.ljust(self._size, b'\\0')\n        if not data:\n"),
    Mutant("short RPDO not reported", "rpdo", "pdo", "            self._error(EmergencyCode.PDO_LENGTH_LOW, detail)\n", ""),
    Mutant("long RPDO not reported", "rpdo", "pdo", "active=len(data) > self._size)", "active=False)"),
    Mutant("place holders do not count", "rpdo", "pdo", "                position += mapped.size\n", "                position += mapped.size if mapped.entry is not None else 0\n"),
    Mutant("RPDO deadline ignored", "rpdo", "pdo", "self._context.now + self._event_s if self._event_s else None\n        if", "None\n        if"),
    Mutant("RPDO with the type of a remote TPDO", "rpdo", "pdo_mapping", "EVENT_DRIVEN: Final = frozenset({254, 255})", "EVENT_DRIVEN: Final = frozenset({252, 253, 254, 255})"),
    # Store, restore and LSS
    Mutant("stored without the signature", "store", "store_restore", "if data != SAVE:", "if False:"),
    Mutant("restored without the signature", "store", "store_restore", "if data != LOAD:", "if False:"),
    Mutant("nothing is stored", "store", "store_restore", "self._apply(subindex, self._changed, self._on_save)", "self._apply(subindex, dict, self._on_save)"),
    Mutant("restore changes nothing", "store", "store_restore", "self._apply(subindex, dict, self._on_restore)", "self._apply(APPLICATION_ONLY, dict, self._on_restore)"),
    Mutant("restore counts at once", "store", "store_restore", "deferred = self._apply(subindex, dict, self._on_restore)", "deferred = self._apply(subindex, dict, self._on_restore)\n        self.load()"),
    Mutant("groups are not kept apart", "store", "store_restore", "        if subindex == APPLICATION_ONLY:", "        if False:"),
    Mutant("LSS selected by part of the identity", "lss", "lss", "matches=number == self._identity(step)", "matches=True"),
    Mutant("LSS obeys while it waits", "lss", "lss", "        elif self.configuring:\n            self._configuration", "        elif True:\n            self._configuration"),
    Mutant("LSS takes any node-ID", "lss", "lss", "valid = 1 <= data[1] <= 127 or data[1] == UNCONFIGURED_NODE", "valid = True"),
    Mutant("LSS node-ID never used", "lss", "slave", "            self.lss.restart(self._default_node_id)\n        context.node_id = self.lss.pending_node_id\n", "            pass\n"),
    Mutant("LSS reports the pending node-ID", "lss", "lss", "self._send(command, bytes([self._context.node_id]))", "self._send(command, bytes([self.pending_node_id ^ 1]))"),
    Mutant("LSS takes reserved bit rates", "lss", "lss", "BIT_RATES.get(data[2], 0)", "BIT_RATES.get(data[2], 125_000)"),
    Mutant("LSS identify ignores ranges", "lss", "lss", "number <= own if step % 2 == 0 else number >= own", "True"),
    Mutant("LSS identify answered by another command", "lss", "lss", "matches=matches):\n                self._send(Command.IDENTIFIED)", "matches=matches):\n                self._send(Command.NON_CONFIGURED)"),
    Mutant("configured node answers fastscan", "lss", "lss", "if not self._unconfigured or self.configuring:", "if self.configuring:"),
    Mutant("fastscan compares wrong bits", "lss", "lss", "if number >> bit != self._identity(part) >> bit:", "if number >> bit + 1 != self._identity(part) >> bit + 1:"),
    Mutant("fastscan does not end in configuration", "lss", "lss", "self.configuring = following < part", "self.configuring = False"),
    # EDS
    Mutant("EDS with wrong defaults", "od", "eds", 'number = f"0x{item.default:X}" if item.default >= 0 else str(item.default)', 'number = f"0x{item.default ^ 1:X}"'),
    Mutant("EDS leaves out an object", "eds", "eds", '        lists[f"{kind}Objects"].append(index)\n', '        if index != 0x1005:\n            lists[f"{kind}Objects"].append(index)\n'),
    Mutant("EDS with another number of PDOs", "eds", "eds", "tpdos=information.nr_of_TXPDO", "tpdos=information.nr_of_TXPDO + 1"),
    Mutant("EDS with high limits too low", "eds", "eds", "key: str(int(limit))", "key: str(int(limit) // 1000)"),
    Mutant("EDS calls everything mappable", "tpdo", "eds", '{"PDOMapping": str(int(item.pdo_mappable))}', '{"PDOMapping": "1"}'),
)  # fmt: skip
