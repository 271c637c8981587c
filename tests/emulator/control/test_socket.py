"""Where the control channel listens, who may use it, and what it leaves behind."""

import asyncio
import os
import socket
import stat
import subprocess
import sys
import time
from pathlib import Path

import pytest

from starhil.emulator.control.channel import MAX_LINE, ControlServer
from starhil.emulator.control.socket import ControlSocket
from starhil.emulator.control.token import check_token
from starhil.emulator.errors import EmulatorError
from starhil.emulator.launch import RunOptions
from starhil.emulator.links.name_lock import lock_name
from tests.emulator.runs import Control
from tests.waiting import until


@pytest.fixture(autouse=True)
def runtime_folder(tmp_path, monkeypatch):
    """A folder such as a session of a user has; paths of sockets are short."""
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    return tmp_path


def mode(path) -> int:
    return stat.S_IMODE(Path(path).stat().st_mode)


def test_the_socket_is_private_to_its_user_and_removed_at_the_end(run, runtime_folder):
    async def scenario(emulation, line):
        path = emulation.ready_fields["control"].removeprefix("unix:")
        assert f"control=unix:{path}" in line
        assert path == str(runtime_folder / "starhil" / f"control-{os.getpid()}")
        assert mode(path) == 0o600
        assert mode(runtime_folder / "starhil") == 0o700
        async with Control(emulation) as control:
            assert (await control.do("status"))["ok"]
        return path

    assert not os.path.lexists(run(scenario))


@pytest.mark.parametrize("base", ["", "/nonexistent"])
def test_without_a_folder_of_the_session_it_is_one_of_the_user(run, tmp_path, monkeypatch, base):
    monkeypatch.setenv("XDG_RUNTIME_DIR", base)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    (tmp_path / f"starhil-{os.geteuid()}").mkdir(mode=0o777)

    async def scenario(emulation, _line):
        return emulation.ready_fields["control"].removeprefix("unix:")

    path = run(scenario)
    assert path.startswith(f"{tmp_path}/starhil-{os.geteuid()}/")
    assert mode(tmp_path / f"starhil-{os.geteuid()}") == 0o700


def test_a_folder_of_another_user_is_not_used(run, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_RUNTIME_DIR", "")
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    (tmp_path / "theirs").mkdir()
    (tmp_path / f"starhil-{os.geteuid()}").symlink_to(tmp_path / "theirs")
    with pytest.raises(EmulatorError, match=r"belongs to another user; give --control unix:/PATH"):
        run(lambda *_: None)


def test_a_socket_that_a_killed_emulator_left_is_replaced(run, tmp_path):
    path = tmp_path / "control"
    program = "import socket, sys, os; socket.socket(socket.AF_UNIX).bind(sys.argv[1]); os._exit(1)"
    subprocess.run([sys.executable, "-c", program, str(path)], check=False)
    assert path.is_socket()

    async def scenario(emulation, _line):
        assert emulation.ready_fields["control"] == f"unix:{path}"
        async with Control(emulation) as control:
            assert (await control.do("status"))["ok"]

    run(scenario, options=RunOptions(control=f"unix:{path}"))
    assert not path.exists()


def test_default_sockets_of_killed_emulators_are_removed_and_others_are_left(run, runtime_folder):
    folder = runtime_folder / "starhil"
    folder.mkdir(mode=0o700)
    (folder / "control-text").write_text("of great worth")
    for name in ("control-1", "control-2", "other-1"):
        with socket.socket(socket.AF_UNIX) as dead:
            dead.bind(str(folder / name))
    with (
        socket.socket(socket.AF_UNIX) as listening,
        socket.socket(socket.AF_UNIX) as starting,
        lock_name("control", os.fsencode(folder / "control-4")),
    ):
        listening.bind(str(folder / "control-3"))
        listening.listen()
        starting.bind(str(folder / "control-4"))

        async def scenario(emulation, _line):
            return {path.name for path in folder.iterdir()}

        found = run(scenario)
    assert found == {"control-3", "control-4", "control-text", "other-1", f"control-{os.getpid()}"}


def test_a_path_in_use_is_rejected_and_left_alone(run, tmp_path):
    path, text = tmp_path / "control", tmp_path / "text"
    text.write_text("of great worth")
    options = RunOptions(control=f"unix:{path}")
    with socket.socket(socket.AF_UNIX) as other:
        other.bind(str(path))
        other.listen()
        with pytest.raises(EmulatorError, match="in use by another program; choose another path"):
            run(lambda *_: None, options=options)
        assert path.is_socket()
    path.unlink()
    with pytest.raises(EmulatorError, match="is not a socket; choose another path"):
        run(lambda *_: None, options=RunOptions(control=f"unix:{text}"))
    assert text.read_text() == "of great worth"

    async def twice(_emulation, _line):
        with pytest.raises(EmulatorError, match=r"in use by another emulator, process \d+"):
            ControlSocket(path)
        assert path.is_socket()

    run(twice, options=options)


@pytest.mark.parametrize(
    ("path", "said"),
    [
        ("relative", "absolute path"),
        ("/tmp/with space", "absolute path"),
        ("/tmp/zero\0", "absolute path"),
        ("/nonexistent/control", "No such file"),
        ("/tmp/" + "x" * 200, "too long"),
    ],
)
def test_a_path_that_cannot_be_is_rejected_in_one_line(run, path, said):
    with pytest.raises(EmulatorError, match=said) as refusal:
        run(lambda *_: None, options=RunOptions(control=f"unix:{path}"))
    assert "\n" not in str(refusal.value)


@pytest.mark.long
def test_requests_without_the_token_have_turns_and_those_with_it_do_not_wait(run, monkeypatch):
    """50 connections that sent long requests without the token held up replies on the bus by 130 ms."""
    count, peers, taken, answered = 20, 8, [], []
    line = ("{" + ",".join(f'"key {number}": 1' for number in range(4000)) + "}\n").encode()
    answer = ControlServer.answer

    async def timed(self, request):
        begin_s = time.thread_time()
        result = await answer(self, request)
        if request == line:
            taken.append(time.thread_time() - begin_s)
            answered.append(asyncio.get_running_loop().time())
        return result

    monkeypatch.setattr(ControlServer, "answer", timed)

    async def scenario(emulation, _line):
        async def stranger():
            reader, writer = await asyncio.open_unix_connection(address)
            for _ in range(count):
                writer.write(line)
            for _ in range(count):
                assert b"token" in await reader.readline()
            writer.close()

        address = emulation.ready_fields["control"].removeprefix("unix:")
        async with Control(emulation) as control:
            assert (await control.do("status", token="sesame"))["ok"]
            strangers = asyncio.gather(*(stranger() for _ in range(peers)))
            await until(lambda: answered)
            for _ in range(50):
                assert (await control.do("status", token="sesame"))["ok"]
            assert len(answered) < count * peers / 2
            await strangers

    run(scenario, options=RunOptions(control="auto", control_token="sesame"))
    assert len(taken) == count * peers
    assert sum(taken) < 0.4 * (answered[-1] - answered[0])


@pytest.mark.parametrize("control", ["auto", "127.0.0.1:0"])
def test_with_a_token_nothing_is_done_without_it(run, control):
    async def scenario(emulation, _line):
        async with Control(emulation) as control:
            for wrong in (
                {},
                {"token": ""},
                {"token": "sesam"},
                {"token": 3},
                {"token": None},
                {"token": "\ud800"},
            ):
                answer = await control.do("quit", id=7, **wrong)
                assert answer == {
                    "id": 7,
                    "ok": False,
                    "error": "token: missing or wrong; give the token set with --control-token",
                }
            assert not run.launched.ended.is_set()
            assert (await control.do("status", token="sésame"))["ok"]

    run(scenario, options=RunOptions(control=control, control_token="sésame"))


def test_an_unneeded_token_does_no_harm(run):
    async def scenario(emulation, _line):
        async with Control(emulation) as control:
            assert (await control.do("status", token="any"))["ok"]

    run(scenario)


@pytest.mark.parametrize("size", [MAX_LINE + 1, 10_000_000])
def test_a_line_that_is_too_long_is_answered_and_the_channel_continues(run, size):
    async def scenario(emulation, _line):
        async with Control(emulation) as control:
            answer = await asyncio.wait_for(control.raw(b"x" * size), 60.0)
            assert answer["ok"] is False
            assert "line too long" in answer["error"]
            assert (await control.do("status"))["ok"]
            assert (await control.raw(b'{"do": "status", "x": "' + bytes(1000) + b'"}'))["ok"] is False

    run(scenario)


def test_a_key_given_twice_is_rejected(run):
    async def scenario(emulation, _line):
        async with Control(emulation) as control:
            for line in (
                b'{"do": "status", "do": "quit"}',
                b'{"do": "fault", "can": {"drop": 0, "drop": 1}}',
            ):
                answer = await control.raw(line)
                assert answer["ok"] is False
                assert "is repeated" in answer["error"]
            assert not run.launched.ended.is_set()

    run(scenario)


def test_no_answer_quotes_a_file(run, tmp_path):
    path = tmp_path / "shadow"
    path.write_text("root:$6$s3cr3t:19000:0:99999:7:::\n")

    async def scenario(emulation, _line):
        async with Control(emulation) as control:
            answer = await control.do("set_truth", truth={"kind": "file", "path": str(path)})
            assert answer["ok"] is False
            assert "line 1" in answer["error"]
            assert "s3cr3t" not in answer["error"]

    run(scenario)


@pytest.mark.parametrize("token", ["", "a\nb", "\udcff"])
def test_a_token_that_cannot_stand_in_an_address_is_rejected(token):
    with pytest.raises(EmulatorError, match="--view-token: must be a text that can be printed"):
        check_token("--view-token", token)
