"""`starhil render`: an image of the sky, and its truth."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from starhil.emulator.cli.option_groups import with_option_groups
from starhil.emulator.cli.options import OrbitChoice, Settings, names_of, with_orbit
from starhil.emulator.cli.output import compiles
from starhil.emulator.errors import EmulatorError
from starid.cli.output import output_help, prepare_output, report_stream

if TYPE_CHECKING:
    from starhil.emulator.sensor.model import SensorModel
    from starhil.emulator.sensor.renderer import Frame
    from starhil.emulator.sensor.sky.view import SkyView
    from starid.camera import Camera
    from starid.catalog import StarCatalog

_NUMBERED_TO_MAGNITUDE = 3.6
_TURN_DEG = 360.0
_NARROWEST_DEG = 0.1
_FASTEST_DEG_S = 1000.0


@dataclass(frozen=True)
class PointingOptions:
    """Where the sensor points and how it turns."""

    ra: Annotated[float, typer.Option(help="Right ascension of the boresight, degrees.")]
    dec: Annotated[float, typer.Option(help="Declination of the boresight, degrees.")]
    roll: Annotated[
        float, typer.Option(help="Angle of celestial north in the image, counter-clockwise from up, degrees.")
    ] = 0.0
    rate: Annotated[
        tuple[float, float, float],
        typer.Option(metavar="X Y Z", help="Body rate during the exposure, sensor frame, degrees/s."),
    ] = (0.0, 0.0, 0.0)

    def check(self) -> None:
        for name, value in (("ra", self.ra), ("dec", self.dec), ("roll", self.roll)):
            if not -_TURN_DEG <= value <= _TURN_DEG:
                raise EmulatorError(f"--{name} {value:g}: must be between -360 and 360 degrees")
        if not -90.0 <= self.dec <= 90.0:
            raise EmulatorError(f"--dec {self.dec}: must be between -90 and 90 degrees")
        if not math.hypot(*self.rate) <= _FASTEST_DEG_S:
            raise EmulatorError(
                f"--rate {' '.join(f'{value:g}' for value in self.rate)}: must be at most {_FASTEST_DEG_S:g} degrees/s in total"
            )


@dataclass(frozen=True)
class ExposureOptions:
    """What replaces keys of the sensor."""

    exposure: Annotated[float | None, typer.Option(help="Exposure, seconds.")] = None
    limit: Annotated[float | None, typer.Option(help="Limiting magnitude of the stars, V.")] = None
    bits: Annotated[int | None, typer.Option(help="Bits per pixel: 8, 12 or 16.")] = None
    gain: Annotated[float | None, typer.Option(help="Analog gain, as a factor.")] = None

    def applied(self, sensor: SensorModel) -> SensorModel:
        changes = {
            "exposure_s": self.exposure,
            "limiting_magnitude": self.limit,
            "bits": self.bits,
            "gain": self.gain,
        }
        return sensor.with_(**{name: value for name, value in changes.items() if value is not None})


@dataclass(frozen=True)
class LensOptions:
    """What replaces keys of the camera."""

    fov: Annotated[float | None, typer.Option(help="Horizontal field of view, edge to edge, degrees.")] = None
    size: Annotated[
        str | None, typer.Option(metavar="WIDTH[xHEIGHT]", help="Size in pixels, such as 1024x768.")
    ] = None
    model: Annotated[str | None, typer.Option(help="Projection: pinhole or equidistant.")] = None

    def applied(self, camera: Camera) -> Camera:
        from starid.camera import Camera

        if self == LensOptions():
            return camera
        width, height = (camera.width, camera.height) if self.size is None else _size(self.size)
        values = {
            "fov_deg": camera.fov_deg if self.fov is None else self.fov,
            "width": width,
            "height": height,
            "model": camera.model if self.model is None else self.model,
            "distortion": camera.distortion,
        }
        return Camera.from_dict(values)


@compiles
@with_option_groups
def command(
    *,
    pointing: PointingOptions,
    output: Annotated[
        Path, typer.Option("--output", "-o", help=output_help("Image to write: .png or .tiff."))
    ],
    light: ExposureOptions,
    lens: LensOptions,
    seed: Annotated[int, typer.Option(help="Seed of the noise.")] = 0,
    profile: Annotated[
        str | None,
        typer.Option(
            help="Device profile with camera, sensor, exposure, gain, catalogue and sky: a name or a TOML file.",
            autocompletion=names_of("profile"),
        ),
    ] = None,
    orbit: OrbitChoice = None,
    overrides: Settings = None,
    as_annotated: Annotated[
        bool, typer.Option("--annotate", help="Stretch the image and mark the stars on it.")
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print the truth of the image as JSON.")] = False,
) -> None:
    """Render an image of the sky; the same options give the same bytes."""
    from starhil.emulator.sensor.renderer import Renderer
    from starid.attitude import Attitude
    from starid.imaging.image_io import image_suffix, write_image

    pointing.check()
    image_suffix(output)
    prepare_output(output, "-o")
    if lens.fov is not None and not lens.fov >= _NARROWEST_DEG:
        raise EmulatorError(f"--fov {lens.fov:g}: must be at least {_NARROWEST_DEG:g} degrees")
    settings = with_orbit(overrides, orbit)
    if settings and profile is None:
        raise EmulatorError("--set and --orbit: change the profile given by --profile; give both")
    camera, sensor, sky, catalog = _scene(profile, settings)
    camera, sensor = lens.applied(camera), light.applied(sensor)
    renderer = Renderer(camera, catalog, sensor, seed, sky.objects)
    frame = renderer.render(
        Attitude.from_radec_roll(pointing.ra, pointing.dec, pointing.roll),
        [math.radians(value) for value in pointing.rate],
        observer=sky.observer,
        satellites=sky.satellites,
    )
    write_image(output, _marked(frame) if as_annotated else frame.image)
    if as_json:
        text = json.dumps(_truth(frame, camera, sensor, output))
    else:
        text = (
            f"{output}: {camera.width}×{camera.height} of {sensor.bits} bits, {len(frame.stars.hip)} stars "
            f"to V {sensor.limiting_magnitude:g}, {frame.exposure_s:g} s"
        )
    typer.echo(text, file=report_stream(output))


def _scene(profile: str | None, settings: list[str]) -> tuple[Camera, SensorModel, SkyView, StarCatalog]:
    """Return camera, sensor, sky and catalogue of a profile; without one, the defaults and an empty sky."""
    from starhil.emulator.sensor.model import SensorModel
    from starhil.emulator.sensor.sky.objects import SkyObjects
    from starhil.emulator.sensor.sky.view import Sky, SkyView
    from starid.camera import Camera
    from starid.catalog import load_catalog

    if profile is None:
        return Camera.from_fov(), SensorModel(), SkyView(SkyObjects()), load_catalog()
    from starhil.emulator.device.device import profile_defaults
    from starhil.emulator.device.parameters import Parameters
    from starhil.emulator.device.surroundings import orbit_of
    from starhil.emulator.profile import load_profile
    from starhil.emulator.profile.pipeline_setup import pipeline_setup
    from starhil.protocol.unit import load_unit

    loaded = load_profile(profile, settings)
    icd = load_unit(loaded.unit_source)
    parameters = Parameters(icd, profile_defaults(loaded, icd))
    setup = pipeline_setup(loaded)
    sensor = SensorModel().with_(**setup.sensor)
    orbit = orbit_of(loaded)
    at_start = None if orbit is None else orbit.state(loaded.start_unix_s)
    place = (None, None) if at_start is None else (at_start.position_m, at_start.velocity_m_s)
    return (
        Camera.from_dict(setup.camera),
        sensor.with_(
            exposure_s=float(parameters["exposure"]) / 1000.0, gain=float(parameters["analog_gain"])
        ),
        Sky(setup.sky).view(loaded.start_unix_s, *place),
        load_catalog(setup.catalog_path or None, setup.epoch),
    )


def _size(text: str) -> tuple[int, int]:
    """Parse `1024` or `1024x768`."""
    numbers = text.lower().replace("×", "x").split("x")
    if len(numbers) not in (1, 2) or not all(number.isdecimal() for number in numbers):
        raise EmulatorError(f"--size {text}: must be WIDTH or WIDTHxHEIGHT in pixels, such as 1024x768")
    width, height = int(numbers[0]), int(numbers[-1])
    if not (16 <= width <= 8192 and 16 <= height <= 8192):
        raise EmulatorError(f"--size {text}: must be 16 to 8192 pixels in each direction")
    return width, height


def _marked(frame: Frame) -> Any:
    """Mark the stars of an image, with names or Hipparcos numbers for the bright ones."""
    from starid.photograph.annotation import annotate, star_label

    stars = frame.stars
    labels = [
        star_label(int(hip), float(magnitude), _NUMBERED_TO_MAGNITUDE)
        for hip, magnitude in zip(stars.hip, stars.magnitude, strict=True)
    ]
    return annotate(frame.image, stars.xy_px, labels)


def _truth(frame: Frame, camera: Camera, sensor: SensorModel, output: Path) -> dict[str, Any]:
    """Return the truth of an image as plain values."""
    stars = frame.stars
    return {
        "image": str(output),
        "width": camera.width,
        "height": camera.height,
        "bits": sensor.bits,
        "fov_deg": camera.fov_deg,
        "ra_deg": frame.attitude.ra_deg,
        "dec_deg": frame.attitude.dec_deg,
        "roll_deg": frame.attitude.roll_deg,
        "quaternion_xyzw": frame.attitude.quaternion_xyzw.tolist(),
        "rate_deg_s": [math.degrees(value) for value in frame.rate_rad_s],
        "exposure_s": frame.exposure_s,
        "seed": frame.seed,
        "stars": [
            {"hip": int(hip), "x_px": float(x), "y_px": float(y), "v": float(v), "electrons": float(e)}
            for hip, (x, y), v, e in zip(
                stars.hip, stars.xy_px, stars.magnitude, stars.electrons, strict=True
            )
        ],
    }
