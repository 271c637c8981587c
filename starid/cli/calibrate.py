"""`starid calibrate`: estimate the parameters of a camera from images of the sky."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from starid.cli.options import AsJson
from starid.cli.output import output_help, prepare_output, report_stream
from starid.errors import StaridError

if TYPE_CHECKING:
    from starid.photograph.self_calibration import SelfCalibration, Stars

_UNITS = {"fx": "px", "fy": "px", "cx": "px", "cy": "px"}


def command(
    images: Annotated[
        list[Path],
        typer.Argument(help="PNG, TIFF, JPEG or BMP images from one camera, all of the same size."),
    ],
    output: Annotated[
        Path, typer.Option("--output", "-o", help=output_help("Camera profile (TOML) to write."))
    ],
    fov: Annotated[float, typer.Option(help="Rough horizontal field of view, edge to edge, degrees.")],
    fov_tolerance: Annotated[
        float, typer.Option(min=0.0, max=0.3, help="Relative uncertainty of --fov.")
    ] = 0.1,
    model: Annotated[str, typer.Option(help="pinhole or equidistant.")] = "pinhole",
    estimate: Annotated[
        list[str] | None,
        typer.Option(
            help="Parameter to estimate: focal, aspect, centre, k1, k2, p1, p2, k3. Repeatable. "
            "Default: those that can be determined from the images."
        ),
    ] = None,
    epoch: Annotated[float | None, typer.Option(help="Julian year of the images; default 2026.")] = None,
    allow_colour: Annotated[
        bool,
        typer.Option("--allow-colour/--refuse-colour", help="Convert colour images to grey, or reject them."),
    ] = True,
    as_json: AsJson = False,
) -> None:
    """Estimate focal length, centre and distortion from stars in several images and write a camera profile.

    The exit status is 1 if an image could not be identified; the profile is then based on the others.
    """
    from starid.camera import Camera
    from starid.camera.file import save_camera
    from starid.catalog import DEFAULT_EPOCH, load_catalog
    from starid.photograph.self_calibration import self_calibrate

    prepare_output(output, "-o", images)
    frames, (height, width) = _stars(images, allow_colour=allow_colour)
    start = Camera.from_dict({"fov_deg": fov, "width": width, "height": height, "model": model})
    catalog = load_catalog(epoch=DEFAULT_EPOCH if epoch is None else epoch)
    result = self_calibrate(frames, start, catalog, fov_tolerance=fov_tolerance, estimate=estimate)
    save_camera(output, result.calibration.camera, result.calibration)
    if as_json:
        print(json.dumps(_report(images, result)), file=report_stream(output))
    else:
        _show(images, output, result)
    if result.unidentified:
        raise typer.Exit(1)


def _stars(images: list[Path], *, allow_colour: bool) -> tuple[list[Stars], tuple[int, int]]:
    """Return the detections of each image, and the common size (height, width)."""
    from starid.imaging.detection import detect
    from starid.imaging.image_io import read_image
    from starid.photograph.self_calibration import Stars

    frames: list[Stars] = []
    size: tuple[int, int] | None = None
    for path in images:
        image = read_image(path, allow_colour=allow_colour)
        shape = (int(image.shape[0]), int(image.shape[1]))
        size = size or shape
        if shape != size:
            raise StaridError(
                f"calibrate {path}: {shape[1]}×{shape[0]} pixels, the first image has {size[1]}×{size[0]}; "
                "give images of one camera and size"
            )
        found = detect(image)
        frames.append(Stars(found.xy_px, found.flux, found.xy_sigma_px))
    return frames, size or (0, 0)


def _report(images: list[Path], result: SelfCalibration) -> dict[str, Any]:
    """Return the results of the calibration as plain values."""
    calibration = result.calibration
    frames = zip(
        result.frame_index, calibration.attitudes, calibration.used, calibration.residual_px, strict=True
    )
    return {
        "camera": calibration.camera.to_dict(),
        "fov_deg": calibration.camera.fov_deg,
        "estimated": list(calibration.estimated),
        "sigma": calibration.sigmas,
        "rms_px": calibration.rms_px,
        "sigma_px": calibration.sigma_px,
        "stars": calibration.star_count,
        "frames": [
            {
                "image": str(images[index]),
                "ra_deg": attitude.ra_deg,
                "dec_deg": attitude.dec_deg,
                "roll_deg": attitude.roll_deg,
                "stars": int(used.sum()),
                "rms_px": float((residual[used] ** 2).sum(axis=1).mean() ** 0.5),
            }
            for index, attitude, used, residual in frames
        ],
        "refused": {str(images[index]): reason for index, reason in result.unidentified.items()},
    }


def _show(images: list[Path], output: Path, result: SelfCalibration) -> None:
    from rich.box import SIMPLE
    from rich.console import Console
    from rich.table import Table

    from starid.attitude import turn_text

    report, calibration = _report(images, result), result.calibration
    console = Console(file=report_stream(output))
    table = Table(title=f"camera, {calibration.camera.fov_deg:.4f}° wide", box=SIMPLE)
    for head in ("parameter", "value", "±"):
        table.add_column(head, justify="left" if head == "parameter" else "right")
    camera = calibration.camera
    values = (*camera.focal_px, *camera.centre_px, *camera.distortion)
    for (name, sigma), value in zip(calibration.sigmas.items(), values, strict=True):
        shown = f"{sigma:.2g}" if sigma > 0.0 else "held"
        table.add_row(f"{name} {_UNITS.get(name, '')}".strip(), f"{value:.6g}", shown)
    console.print(table)
    table = Table(title=f"{calibration.star_count} stars, rms {calibration.rms_px:.3f} px", box=SIMPLE)
    for head in ("image", "RA °", "Dec °", "roll °", "stars", "rms px"):
        table.add_column(
            head, justify="left" if head == "image" else "right", no_wrap=head != "image", overflow="fold"
        )
    for frame in report["frames"]:
        ra, roll = (turn_text(frame[key], 4) for key in ("ra_deg", "roll_deg"))
        angles = (ra, f"{frame['dec_deg']:.4f}", roll)
        table.add_row(Path(frame["image"]).name, *angles, str(frame["stars"]), f"{frame['rms_px']:.3f}")
    console.print(table)
    for image, reason in report["refused"].items():
        console.print(f"not identified: {image} ({reason})", soft_wrap=True)
    console.print(f"written: {output}", soft_wrap=True)
