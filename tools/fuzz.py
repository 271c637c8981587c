"""Fuzzing guided by coverage (atheris) of each decoder and reader in tests/fuzzing.

python tools/fuzz.py [--seconds 60] [TARGET …]     for this long each; all targets by default
python tools/fuzz.py --list
python tools/fuzz.py --growth [CHANNEL …]          work and time per byte of growing messages on each channel

Each target begins with its seeds and its corpus, tests/fuzzing/corpus/TARGET.txt. An input that fails is written to out/fuzz and
printed as a line for that file; the exit status is 1. Afterwards the corpus is renewed with the inputs that reach most for their
size, at most 3 KB; `tests/fuzzing/test_corpus.py` repeats it.
"""

from __future__ import annotations

import argparse
import io
import os
import re
import sys
import tempfile
import traceback
import zlib
from fnmatch import fnmatch
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from tests.fuzzing.targets import Target

ROOT = Path(__file__).parent.parent
CORPUS = ROOT / "tests" / "fuzzing" / "corpus"
FAILURES = ROOT / "out" / "fuzz"
LONGEST = 4096
"""Bytes of the longest input."""
SLOWEST_S = 20
"""An input that takes longer is a failure."""
MEMORY_MB = 3000
CORPUS_BYTES = 3000
INSTRUMENTED = (
    "starhil.protocol", "starhil.hil_tests.session.script", "starhil.hil_tests.session.steps", "starhil.hil_tests.session.step_keys",
    "starhil.hil_tests.session.expect",
    "starhil.hil_tests.client.images", "starhil.hil_tests.client.raw_traffic", "starhil.hil_tests.rig.truth_log",
    "starhil.hil_tests.rig.emulator_process", "starhil.emulator.control", "starhil.emulator.console",
    "starhil.emulator.device", "starhil.emulator.truth", "starhil.emulator.profile",
    "starhil.emulator.launch.replay", "starhil.emulator.launch.replay_differences", "starhil.emulator.cli.endurance",
    "starhil.emulator.run.recorder",
    "starhil.emulator.truth.json_lines", "starhil.emulator.profile.toml_file", "starid.storage.files",
    "starid.imaging.image_io", "starid.camera.file", "starid.catalog.hipparcos", "starid.identification.thesis.database_file",
)  # fmt: skip
"""Modules whose coverage guides; not those with kernels, because numba cannot read instrumented code."""


def modules() -> list[str]:
    """Return the names of all modules of the project."""
    folders = {folder: f"starhil.{folder}" for folder in ("emulator", "protocol", "hil_tests")}
    return [
        ".".join((package, *path.relative_to(ROOT / folder).with_suffix("").parts)).removesuffix(".__init__")
        for folder, package in {**folders, "starid": "starid"}.items()
        for path in (ROOT / folder).rglob("*.py")
    ]


def load_targets() -> dict[str, Target]:
    """Import the targets with instrumented modules, once for all."""
    import atheris

    sys.path.insert(0, str(ROOT))
    plain = [module for module in modules() if not module.startswith(INSTRUMENTED)]
    log, sys.stderr = sys.stderr, io.StringIO()
    try:
        with atheris.instrument_imports(include=["starhil", "starid", "tomllib"], exclude=plain):
            from tests.fuzzing.targets import TARGETS
    finally:
        sys.stderr = log
    return TARGETS


def in_child(target: Target, options: list[str], log: Path, failure: str) -> int:
    """Run libFuzzer on a target in a fork; return its exit status. A failing input becomes a file whose name begins so."""
    import atheris

    child = os.fork()
    if child:
        return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    try:
        with log.open("wb") as stream:
            for descriptor in (1, 2):
                os.dup2(stream.fileno(), descriptor)
        limits = [f"-timeout={SLOWEST_S}", f"-rss_limit_mb={MEMORY_MB}", f"-max_len={LONGEST}"]
        with tempfile.TemporaryDirectory() as folder:
            run = target.runner(Path(folder))

            def reporting(data: bytes) -> None:
                try:
                    run(data)
                except BaseException:
                    Path(f"{failure}{zlib.crc32(data):08x}").write_bytes(data)
                    raise

            atheris.Setup([sys.argv[0], f"-artifact_prefix={failure}", *limits, *options], reporting)
            atheris.Fuzz()  # ends the process
    except Exception:  # noqa: BLE001 (whatever keeps a target from starting)
        traceback.print_exc()
    finally:
        os._exit(1)


def keep(name: str, target: Target, found: Path, scratch: Path) -> int:
    """Write the corpus: of the inputs found, those that reach most for their size; return its size in bytes."""
    files = sorted(found.iterdir(), key=lambda path: (path.stat().st_size, path.name))
    control = scratch / "control"
    control.write_text("".join(f"{line}\n" for line in (len(files), 0, *files)), "ascii")
    in_child(target, ["-merge_inner=1", f"-merge_control_file={control}"], scratch / "merge", f"{scratch}/")
    reached: dict[Path, set[str]] = {}
    for line in control.read_text("ascii").splitlines()[len(files) + 2 :]:
        kind, number, *features = line.split()
        if kind == "FT" and features:
            reached[files[int(number)]] = set(features)  # those that no shorter input has
    corpus: list[bytes] = []
    left = CORPUS_BYTES
    for path in sorted(
        reached, key=lambda path: len(reached[path]) / (path.stat().st_size + 20), reverse=True
    ):
        data = path.read_bytes()
        if len(repr(data)) < left:
            corpus.append(data)
            left -= len(repr(data)) + 1
    CORPUS.mkdir(exist_ok=True)
    (CORPUS / f"{name}.txt").write_text("".join(f"{data!r}\n" for data in sorted(corpus)), "ascii")
    return CORPUS_BYTES - left


def fuzz(name: str, target: Target, kept: list[bytes], seconds: float) -> bool:
    """Fuzz a target and renew its corpus; return whether no input failed."""
    FAILURES.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        scratch = Path(folder)
        corpus, log = scratch / "found", scratch / "log"
        corpus.mkdir()
        for number, data in enumerate([*target.seeds(), *kept]):
            (corpus / f"seed{number}").write_bytes(data)
        before = set(FAILURES.glob(f"{name}-*"))
        options = [f"-max_total_time={seconds:.0f}", "-print_final_stats=1", str(corpus)]
        begin, status = os.times(), in_child(target, options, log, f"{FAILURES}/{name}-")
        end, text = os.times(), log.read_text("utf-8", "replace")
        failures = sorted(set(FAILURES.glob(f"{name}-*")) - before)
        if status or failures:
            print(f"{name}: FAILED with exit status {status}\n" + "\n".join(text.splitlines()[-40:]))
            for path in failures:
                print(f"{path}: {path.read_bytes()!r}", flush=True)
            return False
        units = re.search(r"number_of_executed_units: (\d+)", text)
        size = keep(name, target, corpus, scratch)
    spent = end.children_user + end.children_system - begin.children_user - begin.children_system
    print(
        f"{name}: {int(units[1]) if units else 0:,} inputs in {spent:.0f} s, corpus {size} bytes", flush=True
    )
    return True


def measure_growth(patterns: list[str]) -> bool:
    """Print for each channel the largest growth of calls and of time per byte; return whether the calls stay within the limit."""
    sys.path.insert(0, str(ROOT))
    from tests.fuzzing import growth

    good = True
    for name, channel in growth.channels().items():
        if patterns and not any(fnmatch(name, pattern) for pattern in patterns):
            continue
        calls, times = [], []
        for label, small, large in growth.pairs(channel):
            growth.processed(channel, small)  # what is computed once
            longer = max(1.0, len(large) / len(small))
            few, many = growth.work(channel, small), growth.work(channel, large)
            calls.append((max(0, many - growth.FIXED_WORK) / (few * longer), label))
            short_s, long_s = growth.seconds(channel, small), growth.seconds(channel, large)
            times.append((long_s / (longer * short_s + growth.FIXED_S), label, 1e9 * long_s / len(large)))
        (by_calls, where), (by_time, slow, ns) = max(calls), max(times)
        good = good and by_calls <= growth.GROWTH
        print(
            f"{name:22s} {len(calls):4d} messages, per byte from {growth.SMALL} to {growth.LARGE} bytes: calls × {by_calls:.2f} "
            f"({where}), time × {by_time:.2f} ({slow}, {ns:.0f} ns)",
            flush=True,
        )
    return good


def main() -> None:
    """Fuzz the targets one after the other."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("targets", nargs="*", metavar="TARGET", help="a name, or a pattern such as serial-*")
    parser.add_argument("--seconds", type=float, default=60.0, help="time for each target")
    parser.add_argument("--list", action="store_true", help="print the targets")
    parser.add_argument(
        "--growth", action="store_true", help="measure growing messages; the names are those of channels"
    )
    options = parser.parse_args()
    if options.growth:
        sys.exit(not measure_growth(options.targets))
    targets = load_targets()
    from tests.fuzzing.targets import read_corpus

    names = [
        name
        for name in targets
        if not options.targets or any(fnmatch(name, pattern) for pattern in options.targets)
    ]
    if options.list or not names:
        sys.exit("\n".join(targets) if options.list else "no such target; see --list")
    failed = [name for name in names if not fuzz(name, targets[name], read_corpus(name), options.seconds)]
    print(f"{len(names) - len(failed)} of {len(names)} targets without a failure {' '.join(failed)}")
    sys.exit(bool(failed))


if __name__ == "__main__":
    main()
