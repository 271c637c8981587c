"""A sans-I/O CANopen slave per CiA 301 and CiA 305: CAN frames and time in, CAN frames and events out.

The object dictionary comes from the `canopen` library. The state machines are custom, because
`canopen.LocalNode` and the node of durand start their own timers and lack parts of a slave: SDO block transfer
with retransmission, timeouts, error history, store and restore, node guarding, event-driven PDOs that follow
the NMT state. The conformance cases that each of them fails are listed in
tests/protocol/canopen/test_conformance_of_library_node.py and test_conformance_of_durand.py.
"""

from starhil.protocol.canopen.abort import AbortCode, SdoAbortError
from starhil.protocol.canopen.application import Application, GreyImage, check_status
from starhil.protocol.canopen.context import UNCONFIGURED, EventKind, NmtState, SlaveEvent
from starhil.protocol.canopen.device_dictionary import DeviceDictionary, build_dictionary
from starhil.protocol.canopen.dictionary import Deferred
from starhil.protocol.canopen.eds import build_eds
from starhil.protocol.canopen.emergency import EmergencyCode, ErrorRegister
from starhil.protocol.canopen.slave import CanopenSlave
from starhil.protocol.canopen.storage import FileStorage, ParameterStorage, StorageError

__all__ = [
    "UNCONFIGURED",
    "AbortCode",
    "Application",
    "CanopenSlave",
    "Deferred",
    "DeviceDictionary",
    "EmergencyCode",
    "ErrorRegister",
    "EventKind",
    "FileStorage",
    "GreyImage",
    "NmtState",
    "ParameterStorage",
    "SdoAbortError",
    "SlaveEvent",
    "StorageError",
    "build_dictionary",
    "build_eds",
    "check_status",
]
