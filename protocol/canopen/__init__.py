"""A sans-I/O CANopen slave per CiA 301 and CiA 305: CAN frames and time in, CAN frames and events out.

The object dictionary comes from the `canopen` library. The state machines are custom, because
`canopen.LocalNode` and the node of durand start their own timers and lack parts of a slave: SDO block transfer
with retransmission, timeouts, error history, store and restore, node guarding, event-driven PDOs that follow
the NMT state. The conformance cases that each of them fails are listed in
tests/protocol/canopen/test_conformance_of_library_node.py and test_conformance_of_durand.py.
"""
