"""`starid identify`: the stars and the attitude of an image."""

from __future__ import annotations

import json
import math
import time
from importlib.metadata import entry_points
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, cast

import typer

from starid.cli.options import AsJson
from starid.cli.output import output_help, prepare_output, report_stream
from starid.errors import StaridError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray
    from rich.console import Console

    from starid.camera import Camera, Model
    from starid.catalog import StarCatalog
    from starid.photograph.solver import ImageSolution

_NUMBERED_TO_MAGNITUDE = 5.0
_SHOWN_STARS = 12
_BRIGHTEST = 10
"""Number of brightest detections of which the report says why they are not identified."""
_AXIS_OFF_ARCSEC = 1.0
"""Distance of the optical axis from the centre of the image from which both are shown."""
ANY_FIELD = "auto"
_TOLERANCE = 0.1
TIME_LIMIT_S = 15.0
_PROGRESS_EVERY_S = 2.0
_MODELS: dict[str, Model] = {"pinhole": "pinhole", "equidistant": "equidistant"}


def command(
    image: Annotated[
        Path, typer.Argument(help="PNG, TIFF, JPEG or BMP, 8 or 16 bits; grey, or colour with --fov.")
    ],
    profile: Annotated[
        str | None,
        typer.Option(
            help="Device or camera profile with the camera: a TOML file, or the name of a profile of starhil."
        ),
    ] = None,
    fov: Annotated[
        str | None,
        typer.Option(
            metavar="DEGREES|auto",
            help="For any other camera: rough horizontal field of view, edge to edge, degrees; or auto to "
            "try 5 to 66 degrees.",
        ),
    ] = None,
    fov_tolerance: Annotated[
        float | None,
        typer.Option(min=0.0, max=0.3, help="Relative uncertainty of --fov; default 0.1. Not with auto."),
    ] = None,
    model: Annotated[str, typer.Option(help="With --fov: pinhole or equidistant.")] = "pinhole",
    time_limit: Annotated[
        float,
        typer.Option(
            min=0.0,
            metavar="SECONDS",
            help="With --fov: give up after this time; 0 for no limit. Building an index, which is done once, does not "
            "count.",
        ),
    ] = TIME_LIMIT_S,
    epoch: Annotated[float | None, typer.Option(help="Julian year of the image; default 2026.")] = None,
    date: Annotated[
        str | None,
        typer.Option(
            metavar="UTC",
            help="Date of the image, e.g. 2026-03-20T21:30, to correct the aberration due to the Earth's orbit (20″) and "
            "use the star positions of this year.",
        ),
    ] = None,
    observer_velocity: Annotated[
        str | None,
        typer.Option(
            metavar="X,Y,Z",
            help="Velocity of the camera in m/s, ICRS: relative to the Earth's centre with --date, otherwise to the "
            "barycentre of the solar system.",
        ),
    ] = None,
    allow_colour: Annotated[
        bool | None,
        typer.Option(
            "--allow-colour/--refuse-colour",
            help="Convert a colour image to grey, or reject it; default: convert with --fov, otherwise reject.",
        ),
    ] = None,
    dark: Annotated[
        Path | None,
        typer.Option(help="Dark image of the same camera, exposure and temperature, to be subtracted."),
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", help=output_help("Write the image with the identified stars marked.")),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Identify the stars in an image, lost in space.

    Without --profile or --fov, the image must be from the default camera of starhil, 937×937 pixels and
    42° wide. With --fov, it may be from any camera, mirrored or a negative; field of view and distortion are
    estimated. The exit status is 1 if the stars cannot be identified.
    """
    from starid.catalog import DEFAULT_EPOCH, load_catalog
    from starid.catalog.earth import julian_year
    from starid.imaging.image_io import image_suffix, read_image, write_image

    if output is not None:
        image_suffix(output)
        prepare_output(output, "-o", (image, dark))
    colour = fov is not None if allow_colour is None else allow_colour
    pixels = read_image(image, allow_colour=colour)
    if dark is not None:
        from starid.imaging.dark_frame import dark_excess, without_dark

        pixels = without_dark(pixels, dark_excess(read_image(dark, allow_colour=colour)))
    unix_s = None if date is None else _unix_time(date)
    if epoch is None:
        epoch = DEFAULT_EPOCH if unix_s is None else float(round(julian_year(unix_s)))
    catalog = load_catalog(epoch=epoch)
    velocity = _velocity(unix_s, observer_velocity)
    result = _solve(pixels, catalog, profile, fov, fov_tolerance, model, velocity, time_limit or math.inf)
    report = _report(image, result, _advice(result, fov, model, time_limit))
    if output is not None:
        write_image(output, _marked(pixels, result))
    if as_json:
        typer.echo(json.dumps(report), file=report_stream(output))
    else:
        _show(report, output)
    if not result.solution.valid:
        raise typer.Exit(1)


def _solve(
    pixels: Any,
    catalog: StarCatalog,
    profile: str | None,
    fov: str | None,
    fov_tolerance: float | None,
    model: str,
    observer_velocity: NDArray[np.float64] | None,
    time_limit_s: float,
) -> ImageSolution:
    """Solve an image with the camera that the options select."""
    from starid.camera import Camera
    from starid.photograph.field_sweep import solve_any_field
    from starid.photograph.solver import solve_image
    from starid.storage.files import read_number

    if fov is None:
        return solve_image(pixels, _camera(profile), catalog, observer_velocity=observer_velocity)
    if profile is not None:
        raise StaridError("identify: --profile and --fov exclude each other; give one of them")
    if model not in _MODELS:
        raise StaridError(f"identify --model: must be {' or '.join(_MODELS)}, not {model!r}")
    if fov == ANY_FIELD:
        if fov_tolerance is not None:
            raise StaridError(
                "identify: --fov-tolerance has no effect with --fov auto; omit it, or give --fov in degrees"
            )
        return solve_any_field(
            pixels,
            catalog,
            model=_MODELS[model],
            observer_velocity=observer_velocity,
            time_limit_s=time_limit_s,
            progress=_Progress(),
        )
    try:
        width_deg = read_number(fov)
    except ValueError:
        raise StaridError(f"identify --fov: must be degrees or {ANY_FIELD}, not {fov!r}") from None
    try:
        camera = Camera.from_fov(width_deg, pixels.shape[1], pixels.shape[0], _MODELS[model])
    except StaridError as error:
        raise StaridError(str(error).replace("camera fov_deg", "identify --fov")) from None
    return solve_image(
        pixels,
        camera,
        catalog,
        fov_tolerance=_TOLERANCE if fov_tolerance is None else fov_tolerance,
        observer_velocity=observer_velocity,
        time_limit_s=time_limit_s,
        progress=_Progress(),
    )


class _Progress:
    """Reports the progress of a search on stderr every two seconds, counted from its first attempt: kernels are compiled before."""

    _begin = 0.0
    _reported = 0.0

    def __call__(self, attempt: str) -> None:
        now = time.monotonic()
        if not self._begin:
            self._begin = self._reported = now
        if now - self._reported >= _PROGRESS_EVERY_S:
            self._reported = now
            typer.echo(f"searching for {now - self._begin:.0f} s: {attempt}", err=True)


def _unix_time(date: str) -> float:
    from starid.catalog.earth import unix_time

    try:
        return unix_time(date)
    except ValueError as error:
        raise StaridError(f"identify --date: {error} (given: {date!r})") from None


def _velocity(unix_s: float | None, text: str | None) -> NDArray[np.float64] | None:
    """Return the barycentric velocity of the camera, m/s; None if neither date nor velocity is given."""
    import numpy as np

    from starid.catalog.earth import earth_velocity
    from starid.storage.files import read_number

    velocity: NDArray[np.float64] | None = None if unix_s is None else earth_velocity(unix_s)
    if text is None:
        return velocity
    try:
        x, y, z = (read_number(part) for part in text.split(","))
    except ValueError:
        raise StaridError(
            f"identify --observer-velocity: must be three numbers in m/s as X,Y,Z, not {text!r}"
        ) from None
    own = np.array([x, y, z])
    return own if velocity is None else velocity + own


def _camera(profile: str | None) -> Camera:
    """Return the camera of a profile, or the emulator's default."""
    from starid.camera import Camera
    from starid.camera.file import load_camera

    if profile is None:
        return Camera.from_fov()
    if Path(profile).suffix == ".toml":
        return load_camera(profile)
    for device in entry_points(group="starid.cameras"):
        return cast("Camera", device.load()(profile))
    raise StaridError(f"identify --profile {profile}: give a TOML file with a table [camera]")


def _advice(result: ImageSolution, fov: str | None, model: str, time_limit_s: float) -> str:
    """Return a suggestion for an image that was not identified; empty if it was identified."""
    solution, detections = result.solution, result.detections
    if solution.valid:
        return ""
    if solution.reason == "too_few_stars":
        problem = detections.reason or f"only {len(detections)} stars detected"
        return f"{problem}; expose longer, or crop the image to the sky"
    if solution.reason == "uncertain":
        from starid.identification.options import LARGEST_ERROR_DEG

        return (
            f"the identified stars do not exclude an error above {LARGEST_ERROR_DEG:g}°; use an image with more stars, "
            "or one that is not edited"
        )
    advice = _advice_on_camera(fov, model)
    return advice if result.complete else f"given up after {time_limit_s:g} s (--time-limit); {advice}"


def _advice_on_camera(fov: str | None, model: str) -> str:
    """Return a suggestion about the camera of an image with stars."""
    if fov is None:
        return "give the camera's profile with --profile, or its rough field of view in degrees with --fov"
    if fov == ANY_FIELD:
        return (
            "give the field of view with --fov if it is outside 5 to 66 degrees, or try --model equidistant"
        )
    other = next(name for name in _MODELS if name != model)
    return (
        f"check that the image is {fov}° wide within the tolerance, or try --fov {ANY_FIELD}, --model {other}, "
        "or the image cropped to the sky"
    )


def _report(image: Path, result: ImageSolution, advice: str) -> dict[str, Any]:
    """Return the result as plain values; angles and quaternion are None if it is not valid."""
    solution, detections = result.solution, result.detections
    report: dict[str, Any] = {
        "image": str(image),
        "valid": solution.valid,
        "reason": solution.reason.value,
        "advice": advice,
        "mirrored": result.mirrored,
        **dict.fromkeys(("ra_deg", "dec_deg", "roll_deg", "quaternion_xyzw", "centre")),
        "stars": [],
        "stars_detected": len(detections.flux),
        "rms_px": None,
        "fov_deg": result.camera.fov_deg,
        **dict.fromkeys(("sigma_cross_arcsec", "sigma_roll_arcsec", "probability_false")),
        "missing_stars": [],
        "unidentified": [],
        "elapsed_s": solution.elapsed,
    }
    if not solution.valid:
        return report
    from starid.catalog import load_catalog
    from starid.catalog.star_names import STAR_NAMES
    from starid.identification.undetected import missing_stars

    attitude = solution.attitude
    missing = missing_stars(solution, result.camera, result.stars, detections.xy_px)
    stars: list[dict[str, Any]] = [
        {
            "hip": int(hip),
            "name": STAR_NAMES.get(int(hip)),
            "v": float(v),
            "x_px": float(x),
            "y_px": float(y),
            "flux": float(flux),
        }
        for hip, v, (x, y), flux in zip(
            solution.hip,
            load_catalog().v[solution.catalog_index],
            result.on_image(detections.xy_px[solution.detection_index]),
            detections.flux[solution.detection_index],
            strict=True,
        )
    ]
    return report | {
        "centre": _centre(result),
        "unidentified": _unidentified(result),
        "ra_deg": attitude.ra_deg,
        "dec_deg": attitude.dec_deg,
        "roll_deg": attitude.roll_deg,
        "quaternion_xyzw": [float(value) for value in solution.quaternion_xyzw],
        "stars": sorted(stars, key=lambda star: -star["flux"]),
        "rms_px": solution.rms_px,
        "sigma_cross_arcsec": solution.cross_boresight_sigma_arcsec,
        "sigma_roll_arcsec": solution.roll_sigma_arcsec,
        "probability_false": solution.probability_false,
        "missing_stars": [
            {"hip": int(hip), "x_px": float(x), "y_px": float(y), "v": float(v)}
            for hip, (x, y), v in zip(
                missing.hip, result.on_image(missing.xy_px), missing.magnitude, strict=True
            )
        ],
    }


def _centre(result: ImageSolution) -> dict[str, float]:
    """Return where the centre of the image points, which the optical axis of a calibrated lens misses."""
    import numpy as np

    camera = result.camera
    middle = np.array([[(camera.width - 1) / 2.0, (camera.height - 1) / 2.0]])
    direction = camera.back_project(middle)[0]
    x, y, z = result.solution.attitude.to_icrs(direction)
    return {
        "ra_deg": math.degrees(math.atan2(y, x)) % 360.0,
        "dec_deg": math.degrees(math.asin(max(-1.0, min(1.0, z)))),
        "off_axis_arcsec": 3600.0 * math.degrees(math.atan2(math.hypot(*direction[:2]), direction[2])),
    }


def _unidentified(result: ImageSolution) -> list[dict[str, Any]]:
    """Return which of the brightest detections are not identified, and why as far as image and catalogue show it."""
    import numpy as np

    from starid.catalog import load_catalog

    detections, camera = result.detections, result.camera
    catalog = load_catalog()
    catalog = catalog.brighter_than(float(catalog.v[result.solution.catalog_index].max()))
    close_px = 6.0 * detections.psf_sigma_px
    brightest = np.argsort(-detections.flux, kind="stable")[:_BRIGHTEST]
    identified = set(result.solution.detection_index.tolist())
    xy = result.on_image(detections.xy_px)
    rows = []
    for index in brightest.tolist():
        if index in identified:
            continue
        apart = np.hypot(*(detections.xy_px - detections.xy_px[index]).T)
        apart[index] = math.inf
        why = "not where the catalogue has a star: a planet, an aircraft, a reflection, a hot pixel"
        if detections.saturated[index]:
            why = "saturated, so its place is uncertain"
        elif detections.edge[index]:
            why = "cut off by the edge of the image"
        elif apart.min() < close_px:
            why = "close to another, so the two have one light"
        elif not camera.project(direction := camera.back_project(detections.xy_px[index][None]))[1][0]:
            why = "outside the calibrated field of the lens"
        else:
            place = result.solution.attitude.to_icrs(direction[0])
            near = catalog.in_cone(place, close_px / max(camera.focal_px))
            if len(near) > 1:
                why = f"{len(near)} stars of the catalogue in one spot, so its place is that of none"
            elif len(near):
                why = f"beside HIP {catalog.hip[near[0]]}, but not in its place"
        rows.append({"x_px": float(xy[index, 0]), "y_px": float(xy[index, 1]), "why": why})
    return rows


def _marked(pixels: Any, result: ImageSolution) -> Any:
    """Return the image with identified stars and unidentified detections circled."""
    import numpy as np

    from starid.catalog import load_catalog
    from starid.photograph.annotation import annotate, star_label

    solution, detections = result.solution, result.detections
    v = load_catalog().v[solution.catalog_index]
    labels = [
        star_label(int(hip), float(magnitude), _NUMBERED_TO_MAGNITUDE)
        for hip, magnitude in zip(solution.hip, v, strict=True)
    ]
    xy = result.on_image(detections.xy_px)
    others = np.delete(xy, solution.detection_index, axis=0)
    return annotate(pixels, xy[solution.detection_index], labels, missed_xy_px=others)


def _show(report: dict[str, Any], annotated: Path | None) -> None:
    """Print the result as text, and the file with the image."""
    from rich.console import Console

    console = Console(file=report_stream(annotated), soft_wrap=True)
    _print_solution(report, console)
    if annotated is not None:
        console.print(f"written: {annotated}", markup=False)


def _print_solution(report: dict[str, Any], console: Console) -> None:
    from rich.box import SIMPLE
    from rich.table import Table

    from starid.attitude import turn_text

    if not report["valid"]:
        console.print(
            f"{report['image']}: not identified ({report['reason']}); {report['stars_detected']} stars found; "
            f"{report['advice']}"
        )
        return
    console.print(
        f"{report['image']}: RA {turn_text(report['ra_deg'], 4)}°, Dec {report['dec_deg']:.4f}°, "
        f"roll {turn_text(report['roll_deg'], 3)}°, "
        f"field {report['fov_deg']:.3f}° wide"
    )
    console.print(
        f"{len(report['stars'])} of {report['stars_detected']} stars identified, unweighted rms {report['rms_px']:.3f} px, "
        f"1σ {report['sigma_cross_arcsec']:.2f}″ across and {report['sigma_roll_arcsec']:.1f}″ about the boresight, "
        f"false with probability < {max(report['probability_false'], 1e-300):.1g}"
    )
    centre = report["centre"]
    if centre["off_axis_arcsec"] > _AXIS_OFF_ARCSEC:
        console.print(
            f"that is the optical axis, {centre['off_axis_arcsec'] / 60.0:.1f}′ from the centre of the image: "
            f"RA {turn_text(centre['ra_deg'], 4)}°, Dec {centre['dec_deg']:.4f}°"
        )
    if report["mirrored"]:
        console.print("the image is mirrored: roll and attitude refer to the image flipped left to right")
    if report["missing_stars"]:
        brightest = min(report["missing_stars"], key=lambda star: star["v"])
        console.print(
            f"{len(report['missing_stars'])} expected stars were not detected, the brightest HIP {brightest['hip']}, "
            f"V {brightest['v']:.1f}"
        )
    for star in report["unidentified"]:
        console.print(f"bright at ({star['x_px']:.0f}, {star['y_px']:.0f}) px, not identified: {star['why']}")
    table = Table("HIP", "name", "V", "x px", "y px", "flux", box=SIMPLE, title="brightest identified stars")
    for star in report["stars"][:_SHOWN_STARS]:
        place = (f"{star['x_px']:.2f}", f"{star['y_px']:.2f}", f"{star['flux']:.0f}")
        table.add_row(str(star["hip"]), star["name"] or "", f"{star['v']:.2f}", *place)
    console.print(table)
