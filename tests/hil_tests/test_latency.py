"""The benchmark of latency: what it takes for a reply."""

from starhil.hil_tests.latency import HubRequester
from starhil.hil_tests.private_can_bus import HubThread
from starhil.protocol.can_framing import encode_reply_frames
from starhil.protocol.icd import load_unit
from starhil.protocol.messages import Reply, ReplyKind

ICD = load_unit()
ROW = ICD.telemetry["quaternion"]


def reply_to(destination):
    """Return a reply of the device on the wire of the hub."""
    reply = Reply(ReplyKind.TELEMETRY, ROW.id, bytes(ROW.size), destination=destination)
    (frame,) = encode_reply_frames(reply, 4)
    data = "".join(f" {byte:02X}" for byte in frame.data)
    return f"< send {frame.id:08X} {len(frame.data)}{data} >".encode()


def test_replies_to_other_nodes_are_ignored():
    with HubThread() as hub:
        own, other = HubRequester(hub.channel, ICD), HubRequester(hub.channel, ICD)
        other._socket.sendall(reply_to(253) * 3)
        assert own.ask(ROW.name) is None
        other._socket.sendall(reply_to(253) + reply_to(1))
        assert own.ask(ROW.name) is not None
        assert own.ask(ROW.name) is None
        own.close()
        other.close()
