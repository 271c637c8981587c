"""Any order of SDO requests against a model of what the server must answer, and random frames against the whole slave."""

from __future__ import annotations

from binascii import crc_hqx

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule

from starhil.protocol.can.frame import CanFrame
from starhil.protocol.canopen.abort import AbortCode
from starhil.protocol.canopen.context import NmtState

pytestmark = pytest.mark.long

IMAGE = bytes(number * 31 & 0xFF for number in range(100))
IMAGE_MUX = "406001"
EXPOSURE_MUX = "206001"
COMMAND_MUX = "002062"  # set_parameter, 9 bytes
NO_MUX = "000000"
TIMEOUT_S = 1.0


def abort(mux: str, code: AbortCode) -> list[str]:
    return ["80" + mux + code.to_bytes(4, "little").hex()]


class Model:
    """What a client may expect: the transfer under way and how far it is."""

    def __init__(self) -> None:
        self.kind: str | None = None
        self.mux = NO_MUX
        self.clear()

    def clear(self) -> None:
        self.kind, self.mux = None, NO_MUX
        self.position = self.toggle = self.sent = self.good = 0
        self.data = b""
        self.announced: int | None = None
        self.phase = ""
        self.block = 0

    def begin(self, kind: str, mux: str, **fields) -> None:
        self.clear()
        self.kind, self.mux = kind, mux
        for name, value in fields.items():
            setattr(self, name, value)

    def fail(self, code: AbortCode) -> list[str]:
        mux = self.mux
        self.clear()
        return abort(mux, code)


class SdoMachine(RuleBasedStateMachine):
    """Drives the server and the model side by side."""

    new_bench = None

    @initialize()
    def power_on(self):
        self.bench = type(self).new_bench().power_on()
        self.bench.write(0x1017, 0, 0, 2)
        self.bench.show(IMAGE)
        self.model = Model()
        self.exposure = 100
        self.commands = 0

    def ask(self, request: bytes) -> list[str]:
        answers = self.bench.frame(0x62C, request.ljust(8, b"\0"))
        assert all(identifier == 0x5AC and len(data) == 8 for identifier, data in answers)
        return [data.hex() for _, data in answers]

    # Requests that begin something

    @rule(value=st.integers(0, 0xFFFF))
    def write_exposure(self, value):
        self.ensure_no_stream()
        self.model.clear()
        answer = self.ask(bytes.fromhex("2b" + EXPOSURE_MUX) + value.to_bytes(2, "little"))
        if value < 1:
            assert answer == abort(EXPOSURE_MUX, AbortCode.VALUE_LOW)
        elif value > 5000:
            assert answer == abort(EXPOSURE_MUX, AbortCode.VALUE_HIGH)
        else:
            assert answer == ["60" + EXPOSURE_MUX + "00000000"]
            self.exposure = value

    @rule()
    def read_exposure(self):
        self.ensure_no_stream()
        self.model.clear()
        value = self.exposure.to_bytes(2, "little").hex()
        assert self.ask(bytes.fromhex("40" + EXPOSURE_MUX)) == ["4b" + EXPOSURE_MUX + value + "0000"]

    @rule()
    def begin_upload(self):
        self.ensure_no_stream()
        self.model.begin("upload", IMAGE_MUX, data=IMAGE)
        assert self.ask(bytes.fromhex("40" + IMAGE_MUX)) == ["41" + IMAGE_MUX + "64000000"]

    @rule(size=st.one_of(st.none(), st.integers(0, 12)))
    def begin_download(self, size):
        self.ensure_no_stream()
        request = bytes.fromhex(("20" if size is None else "21") + COMMAND_MUX) + (size or 0).to_bytes(
            4, "little"
        )
        self.model.begin("download", COMMAND_MUX, announced=size)
        answer = self.ask(request)
        if size is not None and size > 9:
            assert answer == self.model.fail(AbortCode.LENGTH_HIGH)
        else:
            assert answer == ["60" + COMMAND_MUX + "00000000"]

    @rule(block=st.integers(0, 130))
    def begin_block_upload(self, block):
        self.ensure_no_stream()
        self.model.begin("block upload", IMAGE_MUX, data=IMAGE, block=block, phase="begun")
        answer = self.ask(bytes.fromhex("a4" + IMAGE_MUX) + bytes([block]))
        if 1 <= block <= 127:
            assert answer == ["c6" + IMAGE_MUX + "64000000"]
        else:
            assert answer == self.model.fail(AbortCode.BLOCK_SIZE)

    @rule()
    def begin_block_download(self):
        self.ensure_no_stream()
        self.model.begin("block download", COMMAND_MUX, phase="stream")
        assert self.ask(bytes.fromhex("c6" + COMMAND_MUX + "09000000")) == ["a4" + COMMAND_MUX + "7f000000"]

    def ensure_no_stream(self):
        """While segments of a block are awaited a request is a segment; a client would abort first."""
        if self.model.kind == "block download" and self.model.phase == "stream":
            self.client_abort()

    # Segments

    @rule(wrong_toggle=st.booleans())
    def upload_segment(self, wrong_toggle):
        self.ensure_no_stream()
        model = self.model
        toggle = model.toggle ^ (0x10 if wrong_toggle else 0)
        answer = self.ask(bytes([0x60 | toggle]))
        if model.kind != "upload":
            assert answer == model.fail(AbortCode.COMMAND)
        elif wrong_toggle:
            assert answer == model.fail(AbortCode.TOGGLE)
        else:
            part = model.data[model.position : model.position + 7]
            model.position += 7
            last = model.position >= len(model.data)
            expected = bytes([toggle | (7 - len(part)) << 1 | last]) + part.ljust(7, b"\0")
            assert answer == [expected.hex()]
            model.toggle ^= 0x10
            if last:
                model.clear()

    @rule(part=st.binary(min_size=1, max_size=7), last=st.booleans(), wrong_toggle=st.booleans())
    def download_segment(self, part, last, wrong_toggle):
        self.ensure_no_stream()
        model = self.model
        toggle = model.toggle ^ (0x10 if wrong_toggle else 0)
        answer = self.ask(bytes([toggle | (7 - len(part)) << 1 | last]) + part)
        if model.kind != "download":
            assert answer == model.fail(AbortCode.COMMAND)
            return
        if wrong_toggle:
            assert answer == model.fail(AbortCode.TOGGLE)
            return
        model.data += part
        if len(model.data) > 9:
            assert answer == model.fail(AbortCode.LENGTH_HIGH)
        elif model.announced is not None and (
            len(model.data) > model.announced or (last and len(model.data) < model.announced)
        ):
            assert answer == model.fail(AbortCode.LENGTH)
        elif last:
            self.finish_download(answer, f"{0x20 | toggle:02x}00000000000000")
        else:
            assert answer == [f"{0x20 | toggle:02x}00000000000000"]
            model.toggle ^= 0x10

    def finish_download(self, answer, good):
        """The stand-in takes any nine bytes that the row's limits allow: two plain numbers without limits."""
        if len(self.model.data) < 9:
            assert answer == self.model.fail(AbortCode.LENGTH_LOW)
        elif answer == [good]:
            self.commands += 1
            self.model.clear()
        else:
            assert answer == self.model.fail(AbortCode.VALUE_RANGE)  # not a finite number

    # Block upload

    @precondition(lambda self: self.model.kind == "block upload")
    @rule()
    def start_block(self):
        model = self.model
        answer = self.ask(b"\xa3")
        if model.phase != "begun":
            assert answer == model.fail(AbortCode.COMMAND)
            return
        model.phase = "stream"
        self.check_block(answer)

    def check_block(self, answer):
        model = self.model
        rest = model.data[model.position :]
        expected = []
        for number in range(model.block):
            part = rest[number * 7 : number * 7 + 7]
            final = (number + 1) * 7 >= len(rest)
            expected.append((bytes([(0x80 if final else 0) | number + 1]) + part.ljust(7, b"\0")).hex())
            if final:
                break
        assert answer == expected
        model.sent = len(expected)

    @precondition(lambda self: self.model.kind == "block upload")
    @rule(share=st.integers(0, 8), block=st.integers(0, 128))
    def confirm_block(self, share, block):
        model = self.model
        good = min(share * 4, model.sent + 1)
        answer = self.ask(bytes([0xA2, good, block]))
        if model.phase != "stream":
            assert answer == model.fail(AbortCode.COMMAND)
        elif good > model.sent:
            assert answer == model.fail(AbortCode.SEQUENCE)
        elif not 1 <= block <= 127:
            assert answer == model.fail(AbortCode.BLOCK_SIZE)
        else:
            model.block = block
            model.position += good * 7
            if model.position < len(model.data):
                self.check_block(answer)
            else:
                unused = -len(IMAGE) % 7
                crc = crc_hqx(IMAGE, 0).to_bytes(2, "little").hex()
                assert answer == [f"{0xC1 | unused << 2:02x}{crc}0000000000"]
                model.phase = "end"

    @precondition(lambda self: self.model.kind == "block upload")
    @rule()
    def end_block_upload(self):
        answer = self.ask(b"\xa1")
        if self.model.phase == "end":
            assert answer == []
            self.model.clear()
        else:
            assert answer == self.model.fail(AbortCode.COMMAND)

    # Block download

    @precondition(lambda self: self.model.kind == "block download" and self.model.phase == "stream")
    @rule(number=st.integers(0, 4), last=st.booleans(), part=st.binary(min_size=7, max_size=7))
    def block_segment(self, number, last, part):
        model = self.model
        if number == 0 and last:
            return  # that is an abort
        answer = self.ask(bytes([number | (0x80 if last else 0)]) + part)
        if number == 0:
            assert answer == model.fail(AbortCode.SEQUENCE)
            return
        good = number == model.good + 1
        if good:
            model.good = number
            model.data += part
        if len(model.data) > 16:
            assert answer == model.fail(AbortCode.LENGTH_HIGH)
        elif last:
            assert answer == [f"a2{model.good:02x}7f0000000000"]
            model.good = 0
            model.phase = "end" if good else "stream"
        else:
            assert answer == []

    @precondition(lambda self: self.model.kind == "block download" and self.model.phase == "end")
    @rule(unused=st.integers(0, 7), good_crc=st.booleans())
    def end_block_download(self, unused, good_crc):
        model = self.model
        model.data = model.data[: len(model.data) - unused]
        crc = crc_hqx(model.data, 0) ^ (0 if good_crc else 0x8000)
        answer = self.ask(bytes([0xC1 | unused << 2]) + crc.to_bytes(2, "little"))
        if len(model.data) > 9:
            assert answer == model.fail(AbortCode.LENGTH_HIGH)
        elif len(model.data) != 9:
            assert answer == model.fail(AbortCode.LENGTH)
        elif not good_crc:
            assert answer == model.fail(AbortCode.CRC)
        else:
            self.finish_download(answer, "a100000000000000")

    # What breaks in

    @rule()
    def client_abort(self):
        assert self.ask(bytes.fromhex("80" + self.model.mux)) == []
        self.model.clear()

    @rule(seconds=st.sampled_from([0.3, 0.9, 1.1]))
    def wait(self, seconds):
        answers = [data.hex() for _, identifier, data in self.bench.advance(seconds) if identifier == 0x5AC]
        if not answers:
            return
        assert answers == self.model.fail(AbortCode.TIMEOUT)

    @rule()
    def long_wait(self):
        answers = [data.hex() for _, identifier, data in self.bench.advance(2.0) if identifier == 0x5AC]
        assert answers == ([] if self.model.kind is None else self.model.fail(AbortCode.TIMEOUT))

    @rule(length=st.integers(0, 7), data=st.binary(min_size=7, max_size=7))
    def short_frame(self, length, data):
        assert self.bench.frame(0x62C, data[:length]) == []

    @rule(command=st.sampled_from([2, 129, 130]))
    def leave_and_come_back(self, command):
        self.bench.nmt(command)
        self.bench.nmt(128)
        self.bench.write(0x1017, 0, 0, 2)
        self.model.clear()

    @invariant()
    def nothing_else_changed(self):
        if hasattr(self, "bench"):
            assert len(self.bench.application.commands) == self.commands
            assert self.bench.slave.sdo.busy == (self.model.kind is not None)


def test_any_order_of_requests(new_bench):
    machine = type("BoundSdoMachine", (SdoMachine,), {"new_bench": new_bench})
    limits = settings(
        max_examples=25,
        stateful_step_count=50,
        deadline=None,
        derandomize=True,
        suppress_health_check=list(HealthCheck),
    )
    from hypothesis.stateful import run_state_machine_as_test

    run_state_machine_as_test(machine, settings=limits)


FRAMES = st.lists(
    st.tuples(
        st.one_of(
            st.sampled_from([0x000, 0x080, 0x100, 0x22C, 0x32C, 0x62C, 0x72C, 0x705, 0x7E5]),
            st.integers(0, 0x7FF),
        ),
        st.binary(max_size=8),
        st.booleans(),
        st.sampled_from([0.0, 0.0, 0.001, 0.2, 1.5]),
    ),
    min_size=1,
    max_size=120,
)


@given(frames=FRAMES)
@settings(
    max_examples=50,
    deadline=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
def test_random_frames(new_bench, frames):
    """No exception, nothing but this node's own identifiers, and after a reset all is as before."""
    bench = new_bench().power_on()
    for identifier, data, remote, pause in frames:
        frame = CanFrame(identifier, b"" if remote else data, extended=False, remote=remote)
        sent = bench.slave.receive(frame, bench.now)
        assert all(not answer.extended and not answer.remote and len(answer.data) <= 8 for answer in sent)
        bench.advance(pause)
    bench.frame(0x7E5, "0400000000000000")
    bench.now += 200.0  # past any silence that an LSS command asked for
    bench.slave.tick(bench.now)
    bench.slave.store.clear_lss()
    bench.slave.reset_node(bench.now)
    assert bench.slave.state is NmtState.PRE_OPERATIONAL
    assert bench.sdo("40 18 10 02") == "4318100252415453"
