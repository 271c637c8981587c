import math
from itertools import permutations
from pathlib import Path

import numpy as np
import pytest

from starhil.emulator.control.scenario import Scenario
from starhil.emulator.errors import EmulatorError
from starhil.emulator.links.wire_faults import WireFault
from starhil.emulator.profile import Profile, load_profile
from starhil.emulator.profile.pipeline_setup import pipeline_setup
from starhil.emulator.profile.profile import CALIBRATION, FAULT_HINTS
from starhil.emulator.profile.sections import CanConfig, DeviceConfig
from starhil.emulator.run.faults import DeviceFault, FaultRequest
from starhil.emulator.sensor.pipeline.star_identifiers import StarIdentifierSetup
from starhil.emulator.sensor.sky.view import Sky
from starhil.emulator.truth.config import SlewConfig
from starhil.protocol.errors import listed
from starhil.protocol.files.bundled import bundled
from starid.camera import Camera
from starid.catalog import load_catalog

pytestmark = pytest.mark.lowest("pydantic")


def write(tmp_path, text, name="mine.toml"):
    path = tmp_path / name
    path.write_text(text)
    return str(path)


def refusal(*args) -> str:
    with pytest.raises(EmulatorError) as caught:
        load_profile(*args)
    assert "\n" not in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize("name", bundled("profile"))
def test_every_profile_of_the_product_is_valid(name):
    assert load_profile(name).name == name


def test_a_profile_is_named_as_it_is_loaded(tmp_path):
    own = write(tmp_path, "")
    assert [load_profile(name).name_or_path for name in ("ideal", own)] == ["ideal", own]


def test_default_profile_is_of_the_class_of_the_first_cubestar():
    profile = load_profile()
    camera = Camera.from_dict(profile.camera_values)
    assert (profile.name, camera.width, camera.height) == ("cubestar", 937, 937)
    assert camera.fov_deg == pytest.approx(42.0, abs=0.001)
    assert profile.parameters["update_rate"] == 1.0
    assert profile.parameters.keys() >= CALIBRATION
    assert profile.links.serial.dialect == "b"


def test_cubestar_has_exclusion_angles_wherever_sun_and_earth_come_from():
    there = {"ra_deg": 10.0, "dec_deg": 20.0}
    for bodies in ("typed", "ephemeris"):
        sky = Sky(load_profile("cubestar", [f"sky.bodies={bodies}"]).sky)
        seen = sky.view(1.8e9, np.array([7e6, 0.0, 0.0]), faults={"sun": there, "earth": there}).objects
        assert (seen.sun.exclusion_deg, seen.earth.exclusion_deg) == (40.0, 30.0)
    by_date = sky.view(1.8e9, np.array([7e6, 0.0, 0.0])).objects
    assert by_date.earth.exclusion_deg == 30.0
    typed = Sky(load_profile("cubestar", ["sky.sun.ra_deg=10.0", "sky.sun.dec_deg=20.0"]).sky).view()
    assert typed.objects.sun.exclusion_deg == 40.0


def test_a_profile_extends_another_table_by_table(tmp_path):
    path = write(
        tmp_path,
        'extends = "demo"\nname = "mine"\n[links.serial]\ndialect = "a"\n[parameters]\nexposure = 50\n',
    )
    profile = load_profile(path)
    assert profile.links.serial.dialect == "a"
    assert profile.links.serial.baud == 921600
    assert profile.parameters == {"exposure": 50, "update_rate": 5.0}
    assert isinstance(profile.truth, SlewConfig)
    assert profile.folder == tmp_path


def test_another_kind_of_truth_replaces_the_whole_table(tmp_path):
    path = write(tmp_path, 'extends = "demo"\n[truth]\nkind = "rate"\nrate_deg_s = [0.0, 0.1, 0.0]\n')
    assert load_profile(path).truth.kind == "rate"


def test_a_calibrated_camera_takes_the_place_of_the_field_of_view(tmp_path):
    write(
        tmp_path,
        "[camera]\nfocal_px = [1201.0, 1202.0]\ncentre_px = [460.0, 470.0]\n[calibration]\nstars = 400\n",
        "camera.toml",
    )
    profile = load_profile(write(tmp_path, 'extends = "camera.toml"\n'))
    assert profile.camera_values["focal_px"] == [1201.0, 1202.0]
    both = write(
        tmp_path, 'extends = "cubestar"\n[camera]\nfocal_px = [1201.0, 1202.0]\ncentre_px = [460.0, 470.0]\n'
    )
    assert "fov_deg" not in load_profile(both).camera_values
    back = write(tmp_path, f'extends = "{both}"\n[camera]\nfov_deg = 30.0\n', "back.toml")
    assert "focal_px" not in load_profile(back).camera_values


def test_a_focal_length_in_millimetres_is_one_of_pixels(tmp_path):
    lens = 'extends = "ideal"\n[camera]\nfocal_mm = 16.0\ncentre_px = [460.0, 470.0]\n'
    profile = load_profile(write(tmp_path, f"{lens}[sensor]\npixel_um = 5.5\n"))
    focal_px = 16.0 / 0.0055
    assert profile.camera_values["focal_px"] == pytest.approx([focal_px, focal_px])
    assert Camera.from_dict(profile.camera_values).fov_deg == pytest.approx(
        math.degrees(math.atan(460.5 / focal_px) + math.atan(476.5 / focal_px))
    )
    again = load_profile("ideal", ["camera.focal_mm=16", "sensor.pixel_um=5.5", "camera.fov_deg=30"])
    assert "focal_mm" not in again.camera_values
    assert refusal(write(tmp_path, lens)).endswith(
        "camera.focal_mm: needs the width of a pixel: give sensor.pixel_um"
    )


@pytest.mark.parametrize("keys", ["focal_mm=16", "focal_px=[2000.0, 2000.0]"])
def test_the_axis_of_a_camera_given_by_its_focal_length_is_in_the_centre(keys):
    settings = [f"camera.{keys}", "camera.width=1024", "camera.height=700", "sensor.pixel_um=8"]
    camera = Camera.from_dict(load_profile("ideal", settings).camera_values)
    assert camera.centre_px == (511.5, 349.5)
    assert camera.focal_px == (2000.0, 2000.0)


def test_errors_of_the_calibration_belong_to_the_camera(tmp_path):
    cubestar = load_profile("cubestar").calibration
    covariance = np.array(cubestar.matrix())
    assert np.sqrt(np.diag(covariance)).tolist() == pytest.approx(cubestar.sigma)
    assert covariance[0, 1] == pytest.approx(cubestar.sigma[0] * cubestar.sigma[1])
    other = write(tmp_path, 'extends = "cubestar"\n[camera]\nfov_deg = 30.0\n')
    assert load_profile(other).calibration.matrix() is None
    assert load_profile("cubestar", ["camera.fov_deg=30"]).calibration.matrix() is None


def test_a_calibration_written_by_starid_is_used(tmp_path):
    rows = np.diag(np.arange(9.0)).tolist()
    written = f"[calibration]\nframes = 3\nsigma = {np.sqrt(np.arange(9.0)).tolist()}\ncovariance = {rows}\n"
    assert load_profile(write(tmp_path, written)).calibration.matrix() == rows


MOUNTS = {
    "quaternion_xyzw": "quaternion_xyzw = [0.0, 0.0, 0.0, 1.0]",
    "matrix": "matrix = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]",
    "euler_deg": 'euler_deg = [1.0, 2.0, 3.0]\nsequence = "213"',
}


@pytest.mark.parametrize(("old", "new"), list(permutations(MOUNTS, 2)))
def test_a_mount_in_another_form_takes_the_place_of_the_old_one(tmp_path, old, new):
    base = write(tmp_path, f'[truth]\nkind = "fixed"\n[truth.mount]\n{MOUNTS[old]}\n', "base.toml")
    extended = write(tmp_path, f'extends = "{base}"\n[truth.mount]\n{MOUNTS[new]}\n')
    typed = load_profile(base, [f"truth.mount.{MOUNTS[new].splitlines()[0].replace(' = ', '=')}"])
    for profile in (load_profile(extended), typed):
        assert getattr(profile.truth.mount, new) is not None
        assert getattr(profile.truth.mount, old) is None


@pytest.mark.parametrize(
    "date", ["2035-01-01T00:00:00Z", '"2035-01-01"', "2051222400", "2035-01-01T00:00:00"]
)
def test_the_start_is_a_date_and_moves_the_stars(date):
    for key in ("run.start_unix_s", "sky.date"):
        profile = load_profile("cubestar", [f"{key}={date}"])
        assert profile.start_unix_s == 2_051_222_400.0
        assert pipeline_setup(profile).epoch == 2035.0
    assert load_profile("cubestar", [f"sky.date={date}", "catalog.epoch=2000.0"]).epoch == 2000.0
    assert load_profile("cubestar").epoch == 2026.0


@pytest.mark.parametrize("key", ["fov_deg = 18.0", "width = 1024"])
def test_another_camera_does_not_inherit_the_limiting_magnitude(tmp_path, key):
    assert "limiting_magnitude" in load_profile("cubestar").parameters
    mine = f'extends = "cubestar"\n[camera]\n{key}\n'
    assert "limiting_magnitude" not in load_profile(write(tmp_path, mine)).parameters
    own = load_profile(write(tmp_path, f"{mine}[parameters]\nlimiting_magnitude = 5.5\n"))
    assert own.parameters["limiting_magnitude"] == 5.5
    kept = load_profile(write(tmp_path, 'extends = "mine.toml"\n', "child.toml"))
    assert kept.parameters["limiting_magnitude"] == 5.5


def test_a_profile_s_camera_is_known_exactly_by_default(tmp_path):
    mine = 'extends = "cubestar"\n[camera]\nfov_deg = 20.0\n'
    assert not load_profile(write(tmp_path, mine)).parameters.keys() & CALIBRATION
    corrected = load_profile(write(tmp_path, f"{mine}[parameters]\nk1 = -0.14\n")).parameters
    assert {name: corrected[name] for name in corrected.keys() & CALIBRATION} == {"k1": -0.14}
    typed = load_profile("cubestar", ["parameters.k1=-0.14", "camera.fov_deg=20"])
    assert typed.camera_values["fov_deg"] == 20.0
    assert "focal_px" not in typed.camera_values
    assert {name: typed.parameters[name] for name in typed.parameters.keys() & CALIBRATION} == {"k1": -0.14}


def test_a_profile_extends_a_path_beside_it(tmp_path):
    write(tmp_path, "[run]\nseed = 77\n", "base.toml")
    assert load_profile(write(tmp_path, 'extends = "base.toml"\n')).run.seed == 77


def test_paths_of_overrides_are_relative_to_the_working_directory(tmp_path, monkeypatch):
    (tmp_path / "profiles").mkdir()
    (tmp_path / "profiles" / "own.toml").write_text(
        '[truth]\nkind = "file"\npath = "own.csv"\n[catalog]\npath = "own.npz"\n'
    )
    monkeypatch.chdir(tmp_path)
    name = "profiles/own.toml"
    profile = load_profile(name, ["truth.path=slew.aem", "run.state_dir=", "images.dark=~/dark.png"])
    assert profile.folder / profile.truth.path == tmp_path / "slew.aem"
    assert profile.images.dark == str(Path.home() / "dark.png")
    assert (profile.run.state_dir, profile.catalog.path) == ("", "own.npz")
    assert (profile.folder / load_profile(name).truth.path).resolve() == tmp_path / "profiles" / "own.csv"


def test_overrides_are_toml_or_text():
    profile = load_profile(
        "demo", ["run.seed=5", "run.clock=stepped", "camera.distortion=[0.1]", "truth.kind=fixed"]
    )
    assert (profile.run.seed, profile.run.clock, profile.camera.distortion) == (5, "stepped", [0.1])
    assert profile.truth.kind == "fixed"


@pytest.mark.parametrize(("key", "message"), [("unit", "unit: unit 'aaa"), ("extends", "File name too long")])
def test_a_name_of_300_letters_is_not_found_and_named(tmp_path, key, message):
    assert message in refusal(write(tmp_path, f'{key} = "{"a" * 300}"\n'))


def test_all_errors_of_a_profile_are_listed_each_with_its_source_key_and_remedy(tmp_path):
    base = write(
        tmp_path, "[sky]\nfals_stars = 4\nmon = 3\n[run]\nsede = 1\n[parameters]\nk11 = 1.0\n", "base.toml"
    )
    path = write(
        tmp_path,
        'extends = "base.toml"\n[camera]\nfov_deg = 400\nwidht = 5\n[sensor]\nread_nois = 4.0\nbits = 9\n'
        '[identifier]\nfoo = 3\n[optical]\nblocked_share = 1.0\n[device]\nstuck = true\n[health]\nt = "x"\n',
    )
    with pytest.raises(EmulatorError) as caught:
        load_profile(
            path, ["run.clok=x", "parameters.exposure=0", "parameters.update_rat=5", "links.can.drop=1"]
        )
    fault = "a fault belongs in a scenario (--scenario) or on the control channel"
    of_device = listed(sorted(DeviceConfig.model_fields))
    assert sorted(caught.value.args) == sorted(
        [
            f"profile {base}: run.sede: unknown key; did you mean seed?",
            f"profile {base}: sky.fals_stars: unknown key; did you mean false_stars, fixed_false_stars, false_star_magnitudes?",
            f"profile {base}: sky.mon: unknown key; did you mean moon?",
            f"profile {path}: camera.fov_deg: must be at most 120 (given: 400)",
            f"profile {path}: camera.widht: unknown key; did you mean width?",
            f"profile {path}: sensor.read_nois: unknown key; did you mean read_noise_e, dead_pixels?",
            f"profile {path}: sensor.bits: must be one of 8, 12, 16 (given: 9)",
            f"profile {path}: identifier.foo: not an option of the algorithm geometric; known: blend_px, cache, fov_tolerance",
            f"profile {path}: optical: unknown key; {fault}",
            f"profile {path}: device.stuck: unknown key; known: {of_device}; {fault}",
            f"profile {path}: health.t: must be a number (given: 'x')",
            "--set run.clok=x: run.clok: unknown key; did you mean clock?",
            "--set parameters.exposure=0: parameters.exposure: 0 is outside 1 to 5000 ms",
            "--set parameters.update_rat=5: parameters.update_rat: unknown key; did you mean update_rate, max_rate?",
            f"--set links.can.drop=1: links.can.drop: unknown key; known: {listed(sorted(CanConfig.model_fields))}; {fault}",
            f"profile {base}: parameters.k11: unknown key; did you mean k1?",
        ]
    )


@pytest.mark.parametrize(
    ("option", "key"),
    [
        ("largest_error_deg", "device.largest_error_deg"),
        ("limiting_magnitude", "parameters.limiting_magnitude"),
    ],
)
def test_what_follows_from_the_device_is_no_option_of_the_algorithm(option, key):
    with pytest.raises(EmulatorError) as caught:
        load_profile("ideal", [f"identifier.{option}=1.0"])
    (problem,) = caught.value.args
    assert problem.endswith(
        f"identifier.{option}: not an option of the algorithm geometric; the device has it: {key}"
    )


def test_the_hint_for_faults_is_given_for_every_key_of_a_fault_and_no_key_of_a_profile():
    assert {*FaultRequest.model_fields, "fault", "faults"} == {*FAULT_HINTS, "device"}
    keys = [f"device.{key}" for key in DeviceFault.model_fields]
    keys += [f"links.{bus}.{key}" for key in WireFault.model_fields for bus in ("serial", "can")]
    for key in {*keys} - {"links.can.gap_s"}:  # like frame_gap_s, which is named instead
        assert refusal("ideal", [f"{key}=1"]).endswith(
            "a fault belongs in a scenario (--scenario) or on the control channel"
        )


def test_a_profile_that_extends_itself_is_rejected(tmp_path):
    path = write(tmp_path, 'extends = "mine.toml"\n')
    assert "extend itself" in refusal(path)


def test_errors_about_unknown_names_list_the_known_ones():
    assert "cubestar" in refusal("cubestr")


@pytest.mark.parametrize("override", ["seed", "run.seed", "=3", "run.seed.x=3", ".=1"])
def test_a_bad_override_is_named(override):
    assert override in refusal(
        "cubestar", [override, *(["run.seed=1"] if override == "run.seed.x=3" else [])]
    )


def test_an_invalid_override_is_named_in_the_error(tmp_path):
    path = write(tmp_path, "[run]\nseed = 1\n")
    assert refusal(path, ["run.seed=-1"]).startswith("--set run.seed=-1: run.seed: must be at least 0")
    assert refusal(path, ["camera=3"]).startswith("--set camera=3: camera: must be a table")
    bad = write(tmp_path, "[run]\nseed = -1\n")
    assert path in refusal(bad, ["run.clock=real"])


@pytest.mark.parametrize(
    "override",
    [
        "device.boot_s=1e12",
        "timing.readout_s=1e9",
        "timing.detect_s=100.0",
        "timing.detect_per_star_s=1.0",
        "timing.identify_lost_s=1e300",
        "timing.identify_tracking_s=1e300",
        "links.can.frame_gap_s=1e9",
        "camera.focal_px=[1e300, 1e300]",
        "camera.centre_px=[1e300, 0.0]",
        "camera.distortion=[1e300]",
        "truth.attitude={ra_deg=1e300, dec_deg=0.0}",
        "truth.attitude={ra_deg=0.0, dec_deg=0.0, roll_deg=-1e6}",
    ],
)
def test_an_impossible_value_is_named_with_its_bound(override):
    message = refusal("cubestar", [override])
    key = override.partition("=")[0]
    assert message.startswith(f"--set {override}: {key}")
    assert "must be at " in message


@pytest.mark.parametrize(
    ("override", "why"),
    [
        ("parameters.exposur=1", "parameters.exposur: unknown key; did you mean exposure?"),
        ("parameters.exposure=99999", "parameters.exposure: 99999 is outside"),
    ],
)
def test_an_impossible_parameter_is_named_with_its_option(override, why):
    assert refusal("cubestar", ["parameters.update_rate=2", override]).startswith(f"--set {override}: {why}")
    with pytest.raises(
        EmulatorError, match=r"^--set parameters.serial_baud=5: parameters.serial_baud: set links"
    ):
        load_profile("cubestar", ["parameters.serial_baud=5"])


@pytest.mark.parametrize(
    "override", ["run.start_unix_s=1e300", "run.start_unix_s=5e9", "run.start_unix_s=soon"]
)
def test_an_impossible_date_is_named_with_its_bounds(override):
    message = refusal("cubestar", [override])
    assert message.startswith(f"--set {override}: run.start_unix_s: must be a date from 1970 to 2100")


def _numbers(schema, path=(), definitions=None):
    """Path and schema of every number in a JSON schema."""
    definitions = definitions or schema.get("$defs", {})
    if "$ref" in schema:
        schema = definitions[schema["$ref"].rpartition("/")[2]]
    if schema.get("type") in ("number", "integer") and "enum" not in schema:
        yield ".".join(path), schema
    for key, below in schema.get("properties", {}).items():
        yield from _numbers(below, (*path, key), definitions)
    for below in (*schema.get("anyOf", ()), *schema.get("oneOf", ())):
        yield from _numbers(below, path, definitions)
    if isinstance(schema.get("items"), dict):
        yield from _numbers(schema["items"], path, definitions)


BOUNDED_BY_LENGTH_1 = "quaternion_xyzw"


@pytest.mark.parametrize("model", [Profile, Scenario])
def test_every_number_of_a_profile_and_a_scenario_has_both_bounds(model):
    numbers = dict(_numbers(model.model_json_schema()))
    assert len(numbers) > 30
    unbounded = [
        path
        for path, schema in numbers.items()
        if not ({"minimum", "exclusiveMinimum"} & schema.keys() and "maximum" in schema)
        and not path.endswith(BOUNDED_BY_LENGTH_1)
    ]
    assert unbounded == []


def test_a_byte_order_mark_is_accepted(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_bytes(b'\xef\xbb\xbfextends = "cubestar"\nname = "mine"\n')
    assert load_profile(str(path)).name == "mine"


def test_a_device_in_place_of_a_profile_is_rejected(tmp_path):
    path = tmp_path / "zero.toml"
    path.symlink_to("/dev/zero")
    with pytest.raises(EmulatorError, match="not a regular file"):
        load_profile(str(path))


@pytest.mark.parametrize("text", ["42", '"42"', "'42'"])
def test_a_kind_that_looks_like_a_number_is_a_name(text):
    assert load_profile("cubestar", [f"truth.kind={text}"]).truth.kind == "42"


def test_cubestar_2013_has_the_field_and_the_catalogue_that_its_maker_published():
    """50° × 26° and 410 stars to V 3.8 (Erlank, 2nd Interplanetary CubeSat Workshop, 2013)."""
    profile = load_profile("cubestar-2013")
    camera, limit = profile.camera, profile.parameters["limiting_magnitude"]
    fields = [
        math.degrees(2.0 * math.atan(0.5 * size / focal))
        for size, focal in zip((camera.width, camera.height), camera.focal_px, strict=True)
    ]
    assert fields == pytest.approx([50.0, 26.0], abs=0.1)
    setup = StarIdentifierSetup(
        "geometric", Camera.from_dict(profile.camera_values), 1.0, (("limiting_magnitude", limit),)
    )
    assert len(setup.make(load_catalog(epoch=profile.epoch)).stars) == pytest.approx(410, abs=5)
