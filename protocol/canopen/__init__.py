"""A CANopen slave after CiA 301 and CiA 305, without input or output: frames and the time in, frames and events out.

It stands on the `canopen` library's object dictionary; that library's own local node, and durand's node, keep their
own clocks and lack parts that a slave must have (block transfer with repetition, time-outs, error history, store and
restore, node guarding, event-driven PDOs that obey the NMT state), so the state machines here are our own.
"""

from starhil.protocol.canopen.abort import AbortCode, SdoAbortError
from starhil.protocol.canopen.application import Application, Picture, StandInApplication, check_status
from starhil.protocol.canopen.context import UNCONFIGURED, EventKind, NmtState, SlaveEvent
from starhil.protocol.canopen.device_dictionary import DeviceDictionary, build_dictionary
from starhil.protocol.canopen.dictionary import Deferred
from starhil.protocol.canopen.eds import build_eds
from starhil.protocol.canopen.emergency import ErrorCode, ErrorRegister
from starhil.protocol.canopen.slave import CanopenSlave
from starhil.protocol.canopen.storage import FileStorage, MemoryStorage, ParameterStorage, StorageError

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
