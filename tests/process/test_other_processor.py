"""The same seed gives the same bytes on another processor: catalogue, images with and without bodies, detections, attitudes
and replays.

On the processors of `make arm64` beside those of `make test`: what an older server has, and an emulated one of another architecture.
"""

from __future__ import annotations

import contextlib
import io
import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from starhil.hil_tests.client import ObcClient
from starhil.hil_tests.rig.control import ControlClient
from starhil.hil_tests.rig.emulator_process import emulator_command
from starhil.hil_tests.rig.private_can_bus import private_can_bus
from tests.emulator.emulator_thread import EmulatorThread

pytestmark = pytest.mark.process

ROOT = Path(__file__).parents[2]
ARM64 = os.environ.get("ARM64_ROOT", "").split()
"""Words before a command that run it on arm64: `tools/debian_root …`; none if it is not there."""
AT_NIGHT = pytest.mark.skipif(not ARM64, reason="make arm64 runs it")

SCRIPT = """
import hashlib
import numpy as np
from starhil.emulator.sensor.model import SensorModel
from starhil.emulator.sensor.renderer import Renderer
from starhil.emulator.sensor.sky.objects import EarthLimb, Moon, SkyObjects, SunGlare
from starhil.emulator.sensor.sky.view import Sky
from starid.attitude import Attitude
from starid.attitude import random_attitude
from starid.camera import Camera
from starid.catalog.catalog import _tables
from starid.catalog import load_catalog
from starid.identification.geometric.pattern_index import resolved_stars
from starid.catalog.hipparcos import default_path
from starid.imaging.detection import detect
from starid.imaging.normal_table import _CDF, _PDF
from starid.identification.star_identifier import make_identifier

def show(name, *arrays):
    digest = hashlib.sha256()
    for array in arrays:
        digest.update(np.ascontiguousarray(array).tobytes())
    print(name, digest.hexdigest()[:16])

def columns(stars):
    return [getattr(stars, name) for name in ("hip", "vectors", "ra_rad", "dec_rad", "hp", "v")]

show("normal distribution", _CDF, _PDF)
table = _tables(default_path(), 2026.0)
show("catalogue", *(table[name] for name in sorted(table)))
catalog, camera, sensor = load_catalog(), Camera.from_fov(), SensorModel()
show("merged stars", *columns(resolved_stars(catalog, 6.5, 2e-3)))
renderer = Renderer(camera, catalog, sensor, 1)
identifier = make_identifier("geometric", camera, catalog)
rng = np.random.default_rng(1)
for index, rate in enumerate((0.0, 0.0, 0.02, 0.05)):
    frame = renderer.render(random_attitude(rng), np.array([rate, 0.0, 0.0]), index)
    show(f"image {index}", frame.image)
    found = detect(frame.image, sensor.detection_settings())
    show(f"detections {index}", found.xy_px, found.flux, found.xy_sigma_px, found.flux_sigma)
    solution = identifier.identify(found.xy_px, found.flux, found.sigma_px)
    show(f"solution {index}", solution.quaternion_xyzw, solution.covariance)

here = Attitude.from_radec_roll(83.8, -1.2, 30.0)
bodies = dict(moon=Moon(80.0, 2.0, illuminated=0.4), sun=SunGlare(83.8, 60.0))
for radius_deg, dec_deg in ((64.0, -62.0), (5.0, -8.0)):
    earth = EarthLimb(83.8, dec_deg, radius_deg=radius_deg, sun_ra_deg=83.8, sun_dec_deg=60.0)
    show(f"Earth of {radius_deg}", renderer.render(here, objects=SkyObjects(earth=earth, **bodies)).image)
seen = Sky({"bodies": "ephemeris"}).view(1.78e9, np.array([7e6, 0.0, 0.0]), np.array([0.0, 7500.0, 0.0]))
show("apparent directions", seen.observer.directions, seen.observer.apparent_stars(catalog.vectors, 0.0 * catalog.v))
show("sky of a date", renderer.render(here, objects=seen.objects, observer=seen.observer).image)
"""


@dataclass(frozen=True)
class Processor:
    """How commands are run as on another processor."""

    before: tuple[str, ...] = ()
    """Words before a command."""
    environment: tuple[tuple[str, str], ...] = ()

    def run(self, program: str, *words: str) -> str:
        """Run a program that is installed beside Python; return what it printed."""
        command = [*self.before, program] if self.before else [str(Path(sys.executable).with_name(program))]
        done = subprocess.run(
            [*command, *words],
            cwd=ROOT,
            env={**os.environ, **dict(self.environment)},
            capture_output=True,
            text=True,
            timeout=7200,
            check=False,
        )
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout


def processors() -> dict[str, Processor]:
    dispatched = (getattr(np, "_core", None) or np.core)._multiarray_umath.__cpu_dispatch__
    wide = [name for name in dispatched if "512" in name or name == "X86_V4"]
    return {
        "generic": Processor(  # of the year 2003
            environment=(
                ("NUMBA_CPU_NAME", "generic"),
                ("NPY_DISABLE_CPU_FEATURES", " ".join(dispatched)),
                ("OPENBLAS_CORETYPE", "Prescott"),
                ("GLIBC_TUNABLES", "glibc.cpu.hwcaps=-AVX512F,-AVX2,-FMA,-FMA4"),
            ),
        ),
        "haswell": Processor(
            environment=(
                ("NUMBA_CPU_NAME", "haswell"),
                ("NPY_DISABLE_CPU_FEATURES", " ".join(wide)),
                ("OPENBLAS_CORETYPE", "Haswell"),
                ("OPENCV_CPU_DISABLE", "AVX512-SKX,AVX512-ICL,AVX512-COMMON"),
            ),
        ),
        "arm64": Processor(before=tuple(ARM64), environment=(("NUMBA_CPU_NAME", "cortex-a72"),)),
    }


ALL = ["generic", pytest.param("haswell", marks=AT_NIGHT), pytest.param("arm64", marks=AT_NIGHT)]


@pytest.fixture(scope="module")
def here() -> list[str]:
    output = io.StringIO()
    with contextlib.redirect_stdout(output):
        exec(compile(SCRIPT, "SCRIPT", "exec"), {})
    lines = output.getvalue().splitlines()
    assert len(lines) == 19
    return lines


@pytest.mark.parametrize("name", ALL)
def test_another_processor_gives_the_same_bytes(name: str, here: list[str]) -> None:
    without_garbage = "import gc; gc.disable()\n"  # compiling makes many objects and little of it
    assert processors()[name].run("python", "-c", without_garbage + SCRIPT).splitlines() == here


@dataclass(frozen=True)
class Recording:
    """A run that is recorded: what the emulator is, and what an OBC reads."""

    profile: str
    rows: tuple[str, ...]
    unit: str = "cubestar"
    can: bool = False


RECORDINGS = {
    "cubestar": Recording("cubestar", ("precise_attitude", "star_performance_2", "device_status")),
    "sagitta": Recording("ideal", ("solution", "blobs", "centroids"), unit="sagitta"),
    "thesis": Recording("thesis", ("precise_attitude", "feature_identification"), can=True),
}


def record(what: Recording, folder: Path) -> None:
    """Let the sensor turn for 20 s of simulated time, and read it every second."""
    with private_can_bus() as bus:
        command = emulator_command(
            profile=what.profile,
            unit=what.unit,
            serial="off" if what.can else "auto",
            can=bus if what.can else "off",
            seed=1,
            settings=[
                "run.worker=thread",  # also of the replay: one process instead of two
                "parameters.start_mode=lost_in_space",
                "truth.kind=rate",
                "truth.rate_deg_s=[0.05, 0.1, -0.1]",
            ],
            extra=["--clock", "stepped", "--control", "auto", "--record", str(folder)],
        )
        with EmulatorThread(command) as emulator, ControlClient(emulator.ready["control"]) as control:
            link = {"can": bus} if what.can else {"serial": emulator.ready["serial"]}
            with ObcClient.open(**link, unit=what.unit, timeout_s=20.0) as obc:
                for _ in range(20):
                    control.wait(1.0)
                    for row in what.rows:
                        obc.telemetry(row)
            status = control.do("status")
    assert status["frames_valid"] >= 10, status


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """Record a run by its name, once."""
    folders: dict[str, Path] = {}

    def get(name: str) -> Path:
        if name not in folders:
            folder = tmp_path_factory.mktemp("recorded") / name
            record(RECORDINGS[name], folder)
            folders[name] = folder
        return folders[name]

    return get


@pytest.mark.parametrize(
    ("name", "run"),
    [
        ("generic", "cubestar"),
        *(
            pytest.param(name, run, marks=AT_NIGHT)
            for name in ("generic", "haswell", "arm64")
            for run in RECORDINGS
            if (name, run) != ("generic", "cubestar")
        ),
    ],
)
def test_another_processor_replays_a_recording_to_the_byte(name: str, run: str, recorded) -> None:
    assert "entries played: identical" in processors()[name].run("starhil", "replay", str(recorded(run)))


@AT_NIGHT
def test_arm64_passes_conformance() -> None:
    done = processors()["arm64"].run(
        "starhil", "conformance", "--start", "--serial", "auto", "--unit", "nos3"
    )
    assert "0 failed" in done


@AT_NIGHT
def test_a_recording_of_arm64_is_replayed_to_the_byte_here(tmp_path: Path) -> None:
    """The session of `record` in simulated time, on arm64."""
    arm64 = processors()["arm64"]
    script = (
        "from pathlib import Path; from tests.process.test_other_processor import RECORDINGS, record; "
        f"record(RECORDINGS['cubestar'], Path({str(tmp_path / 'recorded')!r}))"
    )
    arm64.run("python", "-c", script)
    assert "entries played: identical" in Processor().run("starhil", "replay", str(tmp_path / "recorded"))
