"""A CANopen slave after CiA 301 and CiA 305, without input or output: frames and the time in, frames and events out.

It stands on the `canopen` library's object dictionary; that library's own local node, and durand's node, keep their
own clocks and lack parts that a slave must have (block transfer with repetition, time-outs, error history, store and
restore, node guarding, event-driven PDOs that obey the NMT state), so the state machines here are our own.
"""

from protocol.canopen.abort import AbortCode, SdoAbortError
from protocol.canopen.application import Application, Picture, StandInApplication, check_status
from protocol.canopen.context import UNCONFIGURED, EventKind, NmtState, SlaveEvent
from protocol.canopen.device_dictionary import DeviceDictionary, build_dictionary
from protocol.canopen.dictionary import Deferred
from protocol.canopen.eds import build_eds
from protocol.canopen.emergency import ErrorCode, ErrorRegister
from protocol.canopen.slave import CanopenSlave
from protocol.canopen.storage import FileStorage, MemoryStorage, ParameterStorage, StorageError

__all__ = [
    "UNCONFIGURED",
    "AbortCode",
    "Application",
    "CanopenSlave",
    "Deferred",
    "DeviceDictionary",
    "ErrorCode",
    "ErrorRegister",
    "EventKind",
    "FileStorage",
    "MemoryStorage",
    "NmtState",
    "ParameterStorage",
    "Picture",
    "SdoAbortError",
    "SlaveEvent",
    "StandInApplication",
    "StorageError",
    "build_dictionary",
    "build_eds",
    "check_status",
]
