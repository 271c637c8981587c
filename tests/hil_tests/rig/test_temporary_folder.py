"""The folder of a run: removed at its end, or by the next run if its owner was killed."""

from __future__ import annotations

import subprocess
import sys

import pytest

from starhil.hil_tests.rig.temporary_folder import temporary_folder

pytestmark = pytest.mark.long

OWNER = """
import sys, time
from pathlib import Path
from starhil.hil_tests.rig.temporary_folder import temporary_folder
with temporary_folder("run-", base=Path(sys.argv[1])) as folder:
    (folder / "state").write_text("content")
    print(folder, flush=True)
    time.sleep(600)
"""


@pytest.mark.process
def test_the_folder_of_a_killed_owner_is_removed_and_that_of_a_running_owner_kept(tmp_path):
    def names() -> set[str]:
        return {path.name for path in tmp_path.iterdir()}

    (tmp_path / "run-notes").mkdir()  # not such a folder
    command = [sys.executable, "-c", OWNER, str(tmp_path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as owner:
        theirs = owner.stdout.readline().strip().rpartition("/")[2]
        with temporary_folder("run-", base=tmp_path) as mine:
            assert names() == {"run-notes", theirs, mine.name}
        assert names() == {"run-notes", theirs}
        owner.kill()
    with temporary_folder("run-", base=tmp_path) as mine:
        assert names() == {"run-notes", mine.name}
    assert names() == {"run-notes"}
