"""The OBC's end of a CANopen bus: a master that executes telecommands and reads telemetry by SDO."""

from __future__ import annotations

from starhil.hil_tests.client.links import HostLink
from starhil.hil_tests.client.wire_log import WireLog
from starhil.hil_tests.errors import BenchError
from starhil.protocol.can.frame import CanFrame
from starhil.protocol.canopen.abort import AbortCode, SdoAbortError, error_of
from starhil.protocol.canopen.cob import SDO_RECEIVE, SDO_TRANSMIT
from starhil.protocol.canopen.device_dictionary import DeviceDictionary
from starhil.protocol.canopen.sdo_client import SdoTransfer, row_transfer
from starhil.protocol.errors import IcdError
from starhil.protocol.icd import InterfaceDefinition
from starhil.protocol.messages import LinkFault, Reply, ReplyKind, Request, RequestKind
from starhil.protocol.transports.can import open_can


class CanopenHostLink(HostLink[CanFrame]):
    """A CANopen bus with one node.

    The rows of the unit must be in its object dictionary. `node` is the unit's by default.
    """

    name = "can"

    def __init__(
        self, icd: InterfaceDefinition, spec: str, *, node: int | None = None, log: WireLog | None = None
    ) -> None:
        super().__init__(open_can(spec), f"CANopen {spec}", log, lambda: self)
        self._icd = icd
        self._dictionary = DeviceDictionary(icd)
        self._node = int(icd.device_parameters["canopen_node"].default) if node is None else node
        self._under_way: tuple[Request, SdoTransfer] | None = None

    def request(self, request: Request) -> None:
        """Start the transfers of a request.

        Raises BenchError: the object dictionary does not hold the row.
        """
        row = self._icd.row(request.id, request.message_class)
        if row is None:
            raise BenchError(f"{self.description}: request {request.id} is not in the object dictionary")
        try:
            transfer = row_transfer(self._dictionary, row, request.data)
        except IcdError as error:
            raise BenchError(str(error)) from None
        self._under_way = request, transfer
        self._send(next(transfer))

    def is_from_device(self, item: CanFrame) -> bool:
        """Return whether the CAN ID of a frame is one of the node's."""
        return not item.extended and item.id & 0x7F == self._node

    @property
    def busy(self) -> bool:
        """Whether a transfer is active."""
        return self._under_way is not None

    def feed(self, frame: CanFrame, _now: float) -> list[Reply | LinkFault]:
        """Continue the transfers with a response of the node; after the last one return the reply."""
        if self._under_way is None or frame.extended or frame.id != SDO_TRANSMIT + self._node:
            return []
        request, transfer = self._under_way
        try:
            self._send(transfer.send(frame.data.ljust(8, b"\0")))
        except StopIteration as done:
            kind = ReplyKind.ACK if request.kind is RequestKind.TELECOMMAND else ReplyKind.TELEMETRY
            return self._reply(Reply(kind, request.id, done.value, message_class=request.message_class))
        except SdoAbortError as abort:
            code = self._icd.error_number(error_of(abort.code))
            return self._reply(
                Reply(ReplyKind.NACK, request.id, code=code, message_class=request.message_class)
            )
        return []

    def flush(self, _now: float) -> list[LinkFault]:
        """Do nothing: transfers do not time out; the client abandons them with `reset_receiver`."""
        return []

    def reset_receiver(self) -> None:
        """Abort the active transfer."""
        if self._under_way is not None:
            self._under_way = None
            self._send(bytes([0x80, 0, 0, 0]) + AbortCode.TIMEOUT.to_bytes(4, "little"))

    def _send(self, data: bytes) -> None:
        self.send(CanFrame(SDO_RECEIVE + self._node, data, extended=False))

    def _reply(self, reply: Reply) -> list[Reply | LinkFault]:
        self._under_way = None
        return [reply]
