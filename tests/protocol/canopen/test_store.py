"""Store and restore (1010h, 1011h), and the file of stored parameters."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from unittest.mock import Mock

import pytest

from starhil.protocol.canopen.abort import AbortCode, SdoAbortError
from starhil.protocol.canopen.dictionary import Deferred
from starhil.protocol.canopen.storage import FileStorage, ParameterStorage, StorageError
from starhil.protocol.canopen.store_restore import write_at_once

SAVE = b"save"
LOAD = b"load"


@pytest.fixture(params=["memory", "file"])
def storage(request, tmp_path):
    return ParameterStorage() if request.param == "memory" else FileStorage(tmp_path / "sub" / "node.json")


@pytest.fixture
def stored(new_bench, storage):
    return new_bench(storage=storage).power_on()


def changed(bench):
    """Change one communication parameter, and a PDO."""
    assert bench.write(0x1017, 0, 250, 2) == 0
    assert bench.write(0x1801, 2, 5, 1) == 0


def values(bench):
    return bench.number(0x1017), bench.number(0x1801, 2)


@pytest.mark.parametrize("subindex", [1, 2])
def test_saved_parameters_survive_a_power_cycle(stored, new_bench, storage, subindex):
    changed(stored)
    assert stored.write(0x1010, subindex, SAVE) == 0
    stored.write(0x1017, 0, 333, 2)
    assert values(new_bench(storage=storage).power_on()) == (250, 5)


@pytest.mark.parametrize("command", [129, 130])
def test_saved_parameters_return_after_a_reset(stored, command):
    changed(stored)
    stored.write(0x1010, 1, SAVE)
    stored.write(0x1017, 0, 333, 2)
    stored.nmt(command)
    assert values(stored) == (250, 5)


def test_unsaved_parameters_are_lost_at_power_off(stored, new_bench, storage):
    changed(stored)
    stored.write(0x1010, 3, SAVE)  # application parameters only
    assert values(new_bench(storage=storage).power_on()) == (1000, 254)


@pytest.mark.parametrize("subindex", [1, 2])
def test_a_restore_takes_effect_at_the_next_reset(stored, new_bench, storage, subindex):
    changed(stored)
    stored.write(0x1010, 1, SAVE)
    assert stored.write(0x1011, subindex, LOAD) == 0
    assert values(stored) == (250, 5)
    stored.nmt(130)
    assert values(stored) == (1000, 254)
    assert values(new_bench(storage=storage).power_on()) == (1000, 254)


def test_restoring_application_parameters_keeps_communication_parameters(stored):
    changed(stored)
    stored.write(0x1010, 1, SAVE)
    stored.write(0x1011, 3, LOAD)
    stored.nmt(129)
    assert values(stored) == (250, 5)


def test_a_saved_default_cob_id_still_follows_the_node_id(stored, new_bench, storage):
    stored.write(0x1010, 1, SAVE)
    other = new_bench(0x30, storage=storage).power_on()
    assert other.number(0x1014) == 0xB0
    assert other.number(0x1800, 1) == 0x4000_01B0


@pytest.mark.parametrize("index", [0x1010, 0x1011])
@pytest.mark.parametrize("signature", [b"SAVE", b"LOAD", b"evas", b"daol", b"\0\0\0\0", b"\1\0\0\0"])
def test_a_wrong_signature_is_refused(stored, index, signature):
    assert stored.write(index, 1, signature) == AbortCode.NOT_STORED


def test_the_signature_of_the_other_object_is_refused(stored):
    assert stored.write(0x1010, 1, LOAD) == AbortCode.NOT_STORED
    assert stored.write(0x1011, 1, SAVE) == AbortCode.NOT_STORED


@pytest.mark.parametrize("index", [0x1010, 0x1011])
def test_each_group_is_stored_on_command_only(stored, index):
    assert [stored.number(index, subindex) for subindex in range(4)] == [3, 1, 1, 1]


def test_application_parameters_are_stored_by_the_application(new_bench, storage):
    save, restore = Mock(return_value=None), Mock(return_value=None)
    stored = new_bench(storage=storage, on_save=save, on_restore=restore).power_on()
    stored.write(0x1010, 2, SAVE)
    stored.write(0x1011, 2, LOAD)
    assert (save.call_count, restore.call_count) == (0, 0)
    stored.write(0x1010, 3, SAVE)
    stored.write(0x1010, 1, SAVE)
    stored.write(0x1011, 3, LOAD)
    assert (save.call_count, restore.call_count) == (2, 1)
    save.side_effect = SdoAbortError(AbortCode.DEVICE_STATE)
    assert stored.write(0x1010, 3, SAVE) == AbortCode.DEVICE_STATE


class SlowDisk:
    """Keeps the writes until the test performs them."""

    def __init__(self):
        self.waiting = []

    def __call__(self, work, ended):
        self.waiting.append((work, ended))

    def write(self):
        write_at_once(*self.waiting.pop(0))


def test_a_flood_of_new_node_ids_waits_for_one_deletion_of_what_lss_has_stored(new_bench):
    disk, storage = SlowDisk(), ParameterStorage()
    bench = new_bench(storage=storage, background=disk).power_on()
    store, saved = bench.slave.store, []
    store.save_lss(5, 1_000_000, saved.append)
    for _ in range(100):
        store.clear_lss()
    assert len(disk.waiting) == 2
    while disk.waiting:
        disk.write()
    assert saved == [None]
    assert storage.load("lss") == {}
    store.save_lss(6, 1_000_000, saved.append)
    disk.write()
    store.clear_lss()
    disk.write()
    assert storage.load("lss") == {}


STORE_ALL, STORED = "23 10 10 01 73 61 76 65", "6010100100000000"


def answers(bench):
    return [frame.data.hex() for frame in bench.slave.tick(bench.now)]


def test_a_slow_disk_delays_only_the_answer_to_the_store(new_bench):
    disk, storage = SlowDisk(), ParameterStorage()
    bench = new_bench(storage=storage, background=disk).power_on()
    changed(bench)
    assert bench.sdo(STORE_ALL) == ""
    assert bench.nmt(130) == [(0x700 + bench.node, b"\0")]  # the node works, with what is being stored
    assert values(bench) == (250, 5)
    assert storage.load("communication") == {}
    assert bench.sdo("23 10 10 02 73 61 76 65") == "8010100222000008"  # a second one would wait for the first
    disk.write()
    assert answers(bench) == []  # the client has begun another transfer
    assert storage.load("communication")
    assert bench.sdo(STORE_ALL) == ""
    disk.write()
    assert answers(bench) == [STORED]


def test_what_is_stored_is_collected_only_when_it_is_written(new_bench, monkeypatch):
    """A flood of stores collected the values of all objects for each, and slowed replies from 4 to 48 ms."""
    disk = SlowDisk()
    bench = new_bench(background=disk).power_on()
    collected = Mock(return_value={})
    monkeypatch.setattr(bench.slave.store, "_changed", collected)
    for _ in range(10):
        bench.sdo(STORE_ALL)
    assert collected.call_count == 1


def test_an_error_of_a_slow_disk_is_an_abort_and_the_old_values_remain(new_bench):
    disk, storage = SlowDisk(), ParameterStorage()
    storage.save = Mock(side_effect=StorageError("disk full"))
    bench = new_bench(storage=storage, background=disk).power_on()
    changed(bench)
    assert bench.sdo(STORE_ALL) == ""
    disk.write()
    assert answers(bench) == ["8010100100000606"]
    assert ("storage_error", 0) in bench.events()
    bench.nmt(130)
    assert values(bench) == (1000, 254)


@pytest.mark.parametrize(("fails", "answer"), [(False, STORED), (True, "8010100100000606")])
def test_a_store_of_all_is_answered_after_both_writes(new_bench, fails, answer):
    disk, storage, of_application = SlowDisk(), ParameterStorage(), Deferred()
    if fails:
        storage.save = Mock(side_effect=StorageError("disk full"))
    bench = new_bench(storage=storage, background=disk, on_save=lambda: of_application).power_on()
    changed(bench)
    assert bench.sdo(STORE_ALL) == ""
    disk.write()
    assert answers(bench) == []
    assert [frame.data.hex() for frame in bench.slave.finish_write(of_application, bench.now)] == [answer]


@pytest.mark.parametrize(("error", "status"), [(None, "00"), (StorageError("disk full"), "02")])
def test_lss_answers_its_store_when_a_slow_disk_has_written(new_bench, error, status):
    disk, storage = SlowDisk(), ParameterStorage()
    if error is not None:
        storage.save = Mock(side_effect=error)
    bench = new_bench(storage=storage, background=disk).power_on()
    for command in ("04 01", "11 30"):
        bench.frame(0x7E5, bytes.fromhex(command).ljust(8, b"\0"))
    store = b"\x17".ljust(8, b"\0")
    assert bench.frame(0x7E5, store) == []
    assert bench.frame(0x7E5, store) == [(0x7E4, b"\x17\x02".ljust(8, b"\0"))]  # still being written
    assert bench.sdo("40 00 10 00").startswith("43")
    disk.write()
    assert answers(bench) == [f"17{status}000000000000"]
    assert bench.slave.store.load_lss() == (None if error else (0x30, 1_000_000))


def test_a_failing_storage_gives_defaults_an_event_and_hardware_aborts(new_bench):
    storage = ParameterStorage()
    storage.save = Mock(side_effect=StorageError("disk full"))
    storage.clear = Mock(side_effect=StorageError("disk full"))
    storage.load = Mock(side_effect=StorageError("damaged"))
    bench = new_bench(storage=storage).power_on()
    assert values(bench) == (1000, 254)
    assert ("storage_error", 0) in bench.events()
    assert bench.write(0x1010, 1, SAVE) == AbortCode.HARDWARE
    assert bench.write(0x1011, 1, LOAD) == AbortCode.HARDWARE


def test_defaults_replace_a_stored_mapping_that_no_longer_fits(new_bench):
    storage = ParameterStorage()
    storage.save("communication", {"1017:00": b"\x05\x00", "1A00:01": (0x5FFF_0008).to_bytes(4, "little")})
    bench = new_bench(storage=storage).power_on()
    assert values(bench) == (1000, 254)
    assert ("storage_error", 0) in bench.events()


@pytest.mark.parametrize("name", ["1017:00", "1000:00", "5FFF:01", "1001:00"])
def test_stored_values_of_wrong_size_or_of_unknown_objects_are_ignored(new_bench, name):
    storage = ParameterStorage()
    storage.save("communication", {name: b"\x01\x02\x03"})
    assert values(new_bench(storage=storage).power_on()) == (1000, 254)


# The file


def test_the_file_keeps_groups_separate(tmp_path):
    storage = FileStorage(tmp_path / "node.json")
    assert storage.load("a") == {}
    storage.save("a", {"x": b"\x01"})
    storage.save("b", {"y": b"\x02\x03"})
    storage.save("a", {"z": b""})
    again = FileStorage(tmp_path / "node.json")
    assert (again.load("a"), again.load("b")) == ({"z": b""}, {"y": b"\x02\x03"})
    again.clear("a")
    assert (storage.load("a"), storage.load("b")) == ({}, {"y": b"\x02\x03"})
    assert [path.name for path in tmp_path.iterdir()] == ["node.json"]


@pytest.mark.parametrize(
    "text",
    [
        "",
        "{",
        "[]",
        "null",
        "\xff",
        '{"crc32": 0, "groups": {"a": {"x": "01"}}}',
        '{"groups": {}}',
        '{"crc32": 0}',
        "[" * 5000,
    ],
)
def test_a_damaged_file_is_an_error_until_the_next_save(tmp_path, text):
    path = tmp_path / "node.json"
    path.write_text(text, encoding="latin-1")
    storage = FileStorage(path)
    with pytest.raises(StorageError, match=r"node\.json"):
        storage.load("a")
    storage.save("a", {"x": b"\x01"})
    assert storage.load("a") == {"x": b"\x01"}


def test_a_restore_replaces_a_damaged_file(tmp_path):
    path = tmp_path / "node.json"
    path.write_text("{", encoding="ascii")
    storage = FileStorage(path)
    storage.clear("a")
    assert storage.load("a") == {}


def test_a_stored_name_that_is_no_entry_is_ignored(new_bench):
    storage = ParameterStorage()
    storage.save("communication", {"HELLO:00": b"\0", "1017": b"\0\0", "1017:00": b"\xfa\0"})
    assert new_bench(storage=storage).power_on().number(0x1017) == 250


def test_a_changed_value_fails_the_checksum(tmp_path):
    path = tmp_path / "node.json"
    storage = FileStorage(path)
    storage.save("a", {"x": b"\x10"})
    path.write_text(path.read_text(encoding="ascii").replace('"10"', '"11"'), encoding="ascii")
    with pytest.raises(StorageError, match="checksum"):
        storage.load("a")


def test_a_folder_that_cannot_be_written_is_an_error(tmp_path):
    blocker = tmp_path / "file"
    blocker.write_text("", encoding="ascii")
    with pytest.raises(StorageError, match="cannot be written"):
        FileStorage(blocker / "node.json").save("a", {})


def test_a_failed_save_keeps_the_old_file(tmp_path, monkeypatch):
    storage = FileStorage(tmp_path / "node.json")
    storage.save("a", {"x": b"\x01"})
    monkeypatch.setattr(os, "fsync", Mock(side_effect=OSError(28, "No space left on device")))
    with pytest.raises(StorageError, match="No space left"):
        storage.save("a", {"x": b"\x02"})
    assert storage.load("a") == {"x": b"\x01"}
    assert [path.name for path in tmp_path.iterdir()] == ["node.json"]


WRITER = """
import sys
from pathlib import Path
from starhil.protocol.canopen.storage import FileStorage
storage = FileStorage(Path(sys.argv[1]))
number = 0
while True:
    storage.save("a", {str(key): bytes([number & 255]) * 64 for key in range(50)})
    number += 1
    print(number, flush=True)
"""


@pytest.mark.process
def test_the_file_is_whole_after_a_kill_during_a_save(tmp_path):
    path = tmp_path / "node.json"
    for saves in (1, 2, 5, 10, 20):
        writer = subprocess.Popen([sys.executable, "-c", WRITER, str(path)], stdout=subprocess.PIPE)
        assert writer.stdout is not None
        for _ in range(saves):  # and some more that the pipe still holds
            writer.stdout.readline()
        writer.send_signal(signal.SIGKILL)
        writer.wait()
        writer.stdout.close()
        values = FileStorage(path).load("a")
        assert len(values) == 50
        assert len(set(values.values())) == 1
        json.loads(path.read_text(encoding="ascii"))
        assert {item.name for item in tmp_path.iterdir()} <= {"node.json", "node.json.new"}
    FileStorage(path).save("a", {})
    assert [item.name for item in tmp_path.iterdir()] == ["node.json"]


def test_interrupted_saves_leave_one_temporary_file_which_the_next_save_replaces(tmp_path, monkeypatch):
    storage = FileStorage(tmp_path / "node.json")
    with monkeypatch.context() as patch:
        patch.setattr(
            os, "fsync", Mock(side_effect=KeyboardInterrupt)
        )  # not an OSError: the temporary file stays
        for _ in range(2):
            with pytest.raises(KeyboardInterrupt):
                storage.save("a", {"x": b"\x01"})
    assert [item.name for item in tmp_path.iterdir()] == ["node.json.new"]
    storage.save("a", {"x": b"\x02"})
    assert [item.name for item in tmp_path.iterdir()] == ["node.json"]
