"""The quantities of the device: name, type, unit, meaning and function of each, declared here and nowhere else.

The function of a `Snapshot` returns the value in the declared unit, or None if there is none; the field then has its
default or 0. The function of a numbered quantity, such as `stars[n].x`, also takes the number, from 1 to `count`.

`protocol/`, which validates and exports units without the emulator, reads the declarations from
`configs/units/model.toml`. `python tools/make_reference.py` writes them there and into docs/quantities.md.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final, TypeAlias, TypeVar

import numpy as np

from starhil.emulator.device.measurement import Measurement
from starhil.emulator.device.refusal import Refused
from starhil.emulator.device.reported import SEQUENCES
from starhil.emulator.device.snapshot import Snapshot
from starhil.emulator.device.stored_images import BMP_TYPE, StoredImage, msdos_time
from starhil.emulator.sensor.pipeline.messages import MatchedStar, Triple, as_triple
from starhil.protocol.icd.conventions import DAY_NS, NANOSECONDS
from starhil.protocol.icd.device_model import HEALTH, PARAMETER, QuantityModel, generic, number_in
from starhil.protocol.icd.values import Parameter, Value
from starhil.protocol.image_transfer import (
    burst_packet,
    file_checksum,
    frame_checksum,
    parse_burst_packet,
)
from starhil.protocol.messages import ErrorCode
from starid.identification.solution import FeatureReport

Getter: TypeAlias = Callable[[Snapshot], Value | None]
Kind = TypeVar("Kind", bool, int, float, str, bytes)

MAX_STARS: Final = 64
"""Highest number in `stars[n]`."""

UINT32: Final = 0xFFFF_FFFF


@dataclass(frozen=True)
class Quantity:
    """A declared quantity and its function."""

    declared: QuantityModel
    function: Callable[..., Value | None]


QUANTITIES: Final[dict[str, Quantity]] = {}
"""Name → quantity, in the order of the documentation."""


def getter_of(name: str) -> Getter:
    """Return the function of a quantity such as `attitude.w`, `stars[3].x` or `parameter.exposure`."""
    if name.startswith(PARAMETER):
        parameter = name.removeprefix(PARAMETER)
        return lambda shot: shot.parameters[parameter]
    if name.startswith(HEALTH):
        key = name.removeprefix(HEALTH)
        return lambda shot: shot.constants.health.get(key)
    function, number = QUANTITIES[generic(name)].function, number_in(name)
    return function if number is None else lambda shot: function(shot, number)


# --- how a quantity is declared ---


def _declare(name: str, kind: type, doc: str, function: Callable[..., Value | None], **keys: Any) -> None:
    keys |= {"name": name, "type": "text" if kind is str else kind.__name__, "doc": doc}
    declared = QuantityModel.model_validate(keys)
    if name in QUANTITIES:
        raise ValueError(f"quantity {name} is declared twice")
    QUANTITIES[name] = Quantity(declared, function)


def _quantity(
    name: str, kind: type[Kind], unit: str, doc: str, function: Callable[[Snapshot], Kind | None]
) -> None:
    _declare(name, kind, doc, function, unit=unit)


def _vector(name: str, unit: str, doc: str, function: Callable[[Snapshot], Triple]) -> None:
    """Declare the components x, y and z of a vector."""
    for axis, letter in enumerate("xyz"):

        def component(shot: Snapshot, axis: int = axis) -> float:
            return function(shot)[axis]

        _quantity(name + letter, float, unit, doc.format(letter), component)


def _named(name: str, enum: str, doc: str, function: Callable[[Snapshot], str | None]) -> None:
    """Declare a quantity whose values are names of an enumeration of the model."""
    _declare(name, str, doc, function, enum=enum)


def _attitude(
    name: str, unit: str, doc: str, function: Callable[..., float], count: int | None = None
) -> None:
    """Declare a form of the reported attitude, which has no value if the attitude is invalid."""

    def of_attitude(shot: Snapshot, *number: int) -> float | None:
        return function(shot.reported, *number) if shot.reported.valid else None

    _declare(name, float, doc + "; 0 if invalid.", of_attitude, unit=unit, count=count)


def _frame(name: str, kind: type[Kind], unit: str, doc: str, function: Callable[[Measurement], Kind]) -> None:
    """Declare a quantity of the last frame, which has no value without a frame."""
    _quantity(name, kind, unit, doc, lambda shot: None if shot.frame is None else function(shot.frame))


def _solution(
    name: str, unit: str, doc: str, function: Callable[[Measurement], float]
) -> Callable[[Snapshot], float | None]:
    """Declare a quantity of the last frame, which has no value if the attitude is invalid."""

    def of_solution(shot: Snapshot) -> float | None:
        return function(shot.frame) if shot.frame is not None and shot.frame.valid else None

    _quantity(name, float, unit, doc + "; 0 if invalid.", of_solution)
    return of_solution


def _features(
    name: str, kind: type[Kind], unit: str, doc: str, function: Callable[[FeatureReport], Kind]
) -> None:
    """Declare a quantity of the features of the last frame, which has no value for the algorithm `geometric`."""

    def of_features(shot: Snapshot) -> Kind | None:
        known = None if shot.frame is None else shot.frame.result.features
        return None if known is None else function(known)

    _quantity(f"features.{name}", kind, unit, doc, of_features)


def _star(
    name: str, kind: type[Kind], unit: str, doc: str, function: Callable[[Snapshot, MatchedStar], Kind | None]
) -> None:
    """Declare a quantity of the nth identified star, which has no value if there are fewer."""

    def of_star(shot: Snapshot, number: int) -> Kind | None:
        return function(shot, shot.stars[number - 1]) if number <= len(shot.stars) else None

    _declare(f"stars[n].{name}", kind, doc, of_star, unit=unit, count=MAX_STARS)


def _star_direction(name: str, doc: str, function: Callable[[Snapshot, MatchedStar], Triple]) -> None:
    """Declare the components x, y and z of a direction of the nth identified star."""
    for axis, letter in enumerate("xyz"):

        def component(shot: Snapshot, star: MatchedStar, axis: int = axis) -> float:
            return function(shot, star)[axis]

        _star(name + letter, float, "", doc.format(letter), component)


def _flag(name: str, doc: str) -> None:
    """Declare a flag of the links."""
    _quantity(f"link.{name}", bool, "", doc, lambda shot: name in shot.counters.flags)


def _identity(name: str, doc: str) -> None:
    """Declare a number that identifies the device."""
    _quantity(f"identity.{name}", int, "", doc, lambda shot: int(getattr(shot.constants.identity, name)))


def _selected(name: str, doc: str, function: Callable[[Snapshot, Parameter], float]) -> None:
    """Declare a quantity of the selected parameter, which has no value if no parameter has the ID."""

    def of_selected(shot: Snapshot) -> float | None:
        return None if shot.selected is None else function(shot, shot.selected)

    _quantity(f"selected.{name}", float, "", doc, of_selected)


def _file(name: str, unit: str, doc: str, function: Callable[[StoredImage], int]) -> None:
    """Declare a number of the current file of the list, which is 0 if there is none."""

    def of_file(shot: Snapshot) -> int:
        return 0 if shot.file is None else function(shot.file)

    _quantity(f"file.{name}", int, unit, doc, of_file)


# fmt: off
# --- attitude and rate ---

_vector("attitude.", "", "Quaternion of the last frame from ICRS to the reported frame, {}, in the unit's convention; 0 if invalid.",
        lambda shot: shot.reported.quaternion_xyzw[:3])
_quantity("attitude.w", float, "",
          "Quaternion of the last frame from ICRS to the reported frame, scalar part; 0 if invalid.",
          lambda shot: shot.reported.quaternion_xyzw[3])
_quantity("attitude.valid", bool, "", "Whether the attitude of the last frame is valid.",
          lambda shot: bool(shot.frame is not None and shot.frame.valid))
_quantity("attitude.stable", int, "", "Valid attitudes in a row, up to the last frame; 0 if it is invalid.",
          lambda shot: shot.valid_in_a_row)
_named("attitude.reason", "attitude_reason", "Why the attitude is invalid, `ok` if it is valid.",
       lambda shot: str(shot.reported.reason))
_solution("attitude.sigma_cross", "arcsec", "One sigma about an axis across the boresight, with known errors of the calibration, "
          "which change with the attitude and not from frame to frame",
          lambda frame: float(frame.result.sigma_cross_arcsec))
_solution("attitude.sigma_roll", "arcsec", "One sigma about the boresight, with known errors of the calibration",
          lambda frame: float(frame.result.sigma_roll_arcsec))
_confidence = _solution("attitude.confidence", "%", "Probability that the identification is right",
                        lambda frame: 100.0 * (1.0 - frame.result.probability_false))

_attitude("attitude.ra", "deg", "Right ascension of the boresight, mounting angles included, 0 to 360",
          lambda reported: reported.mounted.ra_deg)
_attitude("attitude.dec", "deg", "Declination of the boresight, mounting angles included",
          lambda reported: reported.mounted.dec_deg)
_attitude("attitude.roll", "deg",
          "Angle of celestial north, counter-clockwise in the image from image up, mounting angles included, 0 to 360",
          lambda reported: reported.mounted.roll_deg)
_vector("attitude.rotation_", "rad",
        "Rotation vector of the quaternion in the unit's convention, {}; its length is at most pi; 0 if invalid.",
        lambda shot: shot.reported.rotation_vector_rad)
for _axis, _letter in enumerate("xyz"):
    _attitude(f"attitude.dcm_{_letter}[n]", "",
              f"Row {_axis + 1} of the direction cosine matrix ICRS to reported frame, nth element: "
              f"component of the reported {_letter} axis along the nth ICRS axis",
              lambda reported, number, axis=_axis: float(reported.attitude.matrix[axis, number - 1]), count=3)
for _sequence in SEQUENCES:
    _attitude(f"attitude.euler_{_sequence}[n]", "rad",
              "Euler angles that turn the ICRS axes to the axes of the reported frame, nth rotation: "
              f"about {_sequence[0]}, then the new {_sequence[1]}, then the new {_sequence[2]}",
              lambda reported, number, sequence=_sequence: reported.euler_rad(sequence)[number - 1], count=3)

_vector("rate.", "rad/s",
        "Body rate about the reported frame's {} axis, mean over the last frame interval; 0 if unknown.",
        lambda shot: shot.reported.rate_rad_s)
_frame("rate.valid", bool, "", "Whether the body rate is valid.", lambda frame: frame.rate_valid)
_quantity("rate.clipped", bool, "", "Whether a rate is beyond the range of a field that reports it.",
          lambda shot: shot.frame is not None and any(
              field.clips(shot.reported.rate_rad_s[axis] * factor) for field, axis, factor in shot.constants.rate_fields))

# --- the last frame ---

_quantity("frame.available", bool, "", "Whether there is a frame that is not outdated.",
          lambda shot: shot.frame is not None)
_frame("frame.counter", int, "", "Frames since start-up, invalid ones included.", lambda frame: int(frame.counter))
_quantity("frame.time", float, "s", "Middle of the exposure on the device's clock.",
          lambda shot: None if shot.exposure_ns is None else shot.exposure_ns / NANOSECONDS)
_quantity("frame.time_seconds", int, "s", "Middle of the exposure on the device's clock, whole seconds.",
          lambda shot: None if shot.exposure_ns is None else shot.exposure_ns // NANOSECONDS)
_quantity("frame.time_nanoseconds", int, "ns", "Middle of the exposure on the device's clock, fraction of the second.",
          lambda shot: None if shot.exposure_ns is None else shot.exposure_ns % NANOSECONDS)
_frame("frame.time_of_day", float, "s", "Middle of the exposure on the device's clock, since midnight UTC.",
       lambda frame: frame.mid_unix_ns % DAY_NS / NANOSECONDS)
_quantity("frame.period", float, "s", "Time between frames.",
          lambda shot: 1.0 / float(shot.parameters["update_rate"]) if shot.frame is None else shot.frame.period_s)
_frame("frame.latency", float, "s", "Time from the middle of the exposure to the result.",
       lambda frame: float(frame.latency_s))
_quantity("frame.age", float, "s", "Time since the middle of the exposure.",
          lambda shot: None if shot.frame is None else (shot.now_ns - shot.frame.mid_ns) / NANOSECONDS)
_frame("frame.capture", float, "s", "Duration of exposure and read-out.", lambda frame: float(frame.capture_s))
_frame("frame.detect", float, "s", "Duration of the detection.", lambda frame: float(frame.detect_s))
_frame("frame.identify", float, "s", "Duration of the identification.", lambda frame: float(frame.identify_s))
_named("frame.mode", "mode", "Mode of the device at the exposure; without a frame, the current mode.",
       lambda shot: (shot.mode if shot.frame is None else shot.frame.mode).value)
_named("frame.method", "identification_mode", "How the identification was attempted, also if it failed.",
       lambda shot: None if shot.frame is None else "tracking" if shot.frame.result.tracked else "lost_in_space")
_frame("frame.tracking", bool, "", "Whether identification was by tracking, also if it failed.",
       lambda frame: bool(frame.result.tracked))
_frame("frame.capture_ok", bool, "", "Whether the capture succeeded.",
       lambda frame: frame.reason not in {"no_frame", "processing_error"})
_frame("frame.detection_ok", bool, "", "Whether stars were found.", lambda frame: frame.result.detected > 0)
_frame("frame.identification_ok", bool, "", "Whether stars were identified.", lambda frame: frame.result.matched > 0)
_frame("frame.late", bool, "", "Whether the frame took longer than allowed.",
       lambda frame: bool(frame.late or frame.reason == "timeout"))
_frame("frame.index_pending", bool, "", "Whether the frame was solved with the star index of earlier parameters.",
       lambda frame: bool(frame.result.index_pending))
_frame("frame.background", float, "DN", "Mean level of the background.",
       lambda frame: float(frame.result.background_dn))
_frame("frame.noise", float, "DN", "Noise of the background.", lambda frame: float(frame.result.noise_dn))

# --- features: how an algorithm of the thesis worked ---

_features("available", bool, "", "Whether the last frame was identified by features (`run.algorithm` lsi or rsi).",
          lambda known: known.observed is not None)
_features("region_searched", bool, "", "Whether the answer is from the region of search, not from the whole database.",
          lambda known: known.search == "rsi")
_features("triggered", bool, "", "Whether the region's answer was not good enough, so that the whole database was searched.",
          lambda known: known.triggered)
_features("refined", bool, "", "Whether the attitude was refined and verified with matched stars.", lambda known: known.refined)
_features("error_psi", float, "", "Error of the reconstructed features, normalised units; 0 with too few stars.",
          lambda known: 0.0 if math.isnan(known.error_psi) else known.error_psi)
_features("cell", int, "", "Cell of the nearest neighbour, numbered from 1 as in the thesis; 0 with too few stars.",
          lambda known: known.cell + 1)
_features("weights", int, "", "Number of cells of the dictionary with a weight.", lambda known: known.weights)
_features("region", float, "deg", "Side of the region of search; 0 if there was none.", lambda known: known.region_deg)
_features("stars", int, "", "Detections that the false-star filter kept.", lambda known: known.stars)
_features("removed", int, "", "Detections that the false-star filter removed.", lambda known: known.removed)
_features("rotation", float, "deg", "Measured rotation of the image since the last one, about the boresight; 0 if unknown.",
          lambda known: known.rotation_deg)
_features("translation", float, "deg", "Measured shift of the image since the last one; 0 if unknown.",
          lambda known: known.translation_deg)

# --- stars ---

_frame("stars.detected", int, "", "Stars found in the frame.", lambda frame: int(frame.result.detected))
_frame("stars.matched", int, "", "Stars used for the attitude.", lambda frame: int(frame.result.matched))
_frame("stars.refused", int, "", "Detections that were rejected.", lambda frame: int(frame.result.refused))
_quantity("stars.reported", int, "", "Number of stars available as stars[n].", lambda shot: len(shot.stars))
_star("hip", int, "", "Hipparcos number of the nth brightest identified star; 0 for none.",
      lambda _shot, star: star.hip)
_star("x", float, "px", "Column of the nth star.", lambda _shot, star: star.x)
_star("y", float, "px", "Row of the nth star.", lambda _shot, star: star.y)
_star("centred_x", float, "px", "Column of the nth star from the image centre, (width - 1) / 2.",
      lambda shot, star: star.x - (shot.constants.image_size[0] - 1) / 2.0)
_star("centred_y", float, "px", "Row of the nth star from the image centre, (height - 1) / 2.",
      lambda shot, star: star.y - (shot.constants.image_size[1] - 1) / 2.0)
_star("magnitude", float, "mag", "Measured magnitude of the nth star.", lambda _shot, star: star.magnitude)
_star("confidence", float, "%", "Confidence in the nth star.", lambda shot, _star: _confidence(shot))
_star_direction("vector_", "Measured direction of the nth star, {} in the reported frame.",
                lambda shot, star: as_triple(shot.reported.in_reported_frame(np.array(star.vector))))
_star_direction("icrs_", "Modelled direction of the nth star, {} in ICRS: that of the catalogue at its epoch, without aberration.",
                lambda _shot, star: star.icrs)

# --- time ---

_quantity("clock.unix", float, "s", "The device's clock, since the unit's epoch.",
          lambda shot: shot.clock_ns / NANOSECONDS)
_quantity("clock.seconds", int, "s", "The device's clock, whole seconds.",
          lambda shot: shot.clock_ns // NANOSECONDS & UINT32)
_quantity("clock.milliseconds", int, "ms", "The device's clock, fraction of the second.",
          lambda shot: shot.clock_ns % NANOSECONDS // 1_000_000)
_quantity("clock.microseconds", int, "us", "The device's clock, fraction of the second.",
          lambda shot: shot.clock_ns % NANOSECONDS // 1_000)
_quantity("clock.nanoseconds", int, "ns", "The device's clock, fraction of the second.",
          lambda shot: shot.clock_ns % NANOSECONDS)
_quantity("clock.day", int, "", "The device's clock, whole days since the unit's epoch.",
          lambda shot: shot.clock_ns // DAY_NS)
_quantity("clock.day_milliseconds", int, "ms", "The device's clock, whole milliseconds of the day.",
          lambda shot: shot.clock_ns % DAY_NS // 1_000_000)
_quantity("clock.submilliseconds", int, "us", "The device's clock, fraction of the millisecond.",
          lambda shot: shot.clock_ns % 1_000_000 // 1_000)
_quantity("clock.set", bool, "", "Whether the clock has been set since start-up.",
          lambda shot: shot.clock_set)
_quantity("uptime", float, "s", "Time since start-up.", lambda shot: shot.uptime_ns / NANOSECONDS)
_quantity("uptime.seconds", int, "s", "Time since start-up, whole seconds.",
          lambda shot: shot.uptime_ns // NANOSECONDS)
_quantity("uptime.milliseconds", int, "ms", "Time since start-up, fraction of the second.",
          lambda shot: shot.uptime_ns % NANOSECONDS // 1_000_000)

# --- state ---

_named("mode", "mode", "Mode of the device.", lambda shot: shot.mode.value)
_quantity("mode.changes", int, "", "Mode changes since start-up.", lambda shot: shot.mode_changes)
_named("error", "device_error", "Why the mode is `error`.", lambda shot: shot.error or "none")
_quantity("error.active", bool, "", "Whether the mode is `error`.", lambda shot: bool(shot.error))
_named("boot.reset_cause", "reset_cause", "Why the device restarted.", lambda shot: shot.reset_cause)
_named("boot.cause", "boot_cause", "What started the running program.",
       lambda shot: "power" if shot.reset_cause == "power_on" else "command")
_quantity("boot.count", int, "", "Starts since the parameter store was created.", lambda shot: shot.boot_count)
_quantity("boot.program", int, "", "Number of the running program.", lambda _shot: 1)
_identity("node_type", "Kind of node, from the profile.")
_identity("interface_version", "Version of the interface definition, from the profile.")
_identity("firmware_major", "Firmware version, major, from the profile.")
_identity("firmware_minor", "Firmware version, minor, from the profile.")
_quantity("counters.telecommands", int, "", "Telecommands received.", lambda shot: shot.counters.telecommands)
_quantity("counters.telemetry", int, "", "Telemetry requests received.", lambda shot: shot.counters.telemetry)
_quantity("counters.requests", int, "", "Telecommands and telemetry requests received.",
          lambda shot: shot.counters.telecommands + shot.counters.telemetry)
_quantity("counters.frames", int, "", "Frames since start-up.", lambda shot: shot.frames)
_quantity("counters.frames_valid", int, "", "Frames with a valid attitude since start-up.",
          lambda shot: shot.frames_valid)

_quantity("link.error", bool, "", "Whether any flag of the links is set.",
          lambda shot: bool(shot.counters.flags))
_flag("telecommand_overrun", "A telecommand arrived before the previous one was finished.")
_flag("uart_protocol_error", "Bytes that violate the serial framing.")
_flag("uart_incomplete", "A serial message was not completed.")
_flag("uart_check_error", "A serial message had a wrong checksum.")
_flag("uart_address_error", "A serial message was for another address.")
_flag("can_telecommand_error", "Bad segment order, length or type of CAN frames.")
_quantity("link.faults", int, "", "Invalid inputs of all kinds.",
          lambda shot: sum(shot.counters.faults.values()))
_quantity("request.last", int, "", "ID of the last telecommand.",
          lambda shot: shot.acknowledge.last_telecommand)
_quantity("request.processed", bool, "", "Whether the last telecommand has been processed.",
          lambda shot: shot.acknowledge.processed)
_named("request.error", "error_code", "Result of the last telecommand.",
       lambda shot: shot.acknowledge.error.name.lower())
_quantity("request.index", int, "",
          "Index of the field because of which the telecommand was refused with invalid_parameter.",
          lambda shot: shot.acknowledge.parameter_index)

# --- parameters ---

_quantity("parameters.changed", bool, "", "Whether a parameter differs from its stored value.",
          lambda shot: shot.parameters.differs_from_store)
_quantity("parameters.store_fault", bool, "", "Whether the stored parameters were damaged at start-up.",
          lambda shot: shot.store_fault)
_quantity("selected.id", int, "", "ID of the selected parameter.", lambda shot: shot.selected_id)
_selected("value", "Value of the selected parameter.",
          lambda shot, chosen: chosen.to_number(shot.parameters[chosen.name]))
_selected("minimum", "Minimum of the selected parameter.", lambda _shot, chosen: float(chosen.minimum))
_selected("maximum", "Maximum of the selected parameter.", lambda _shot, chosen: float(chosen.maximum))
_selected("default", "Default of the selected parameter.",
          lambda shot, chosen: float(chosen.to_number(shot.parameters.defaults[chosen.name])))

# --- images and files ---


def _image_chunk(shot: Snapshot) -> bytes:
    if shot.images.busy and shot.images.download is None:
        raise Refused(ErrorCode.BUSY)
    return shot.images.chunk


_quantity("image.stored", bool, "", "Whether an image is stored for download.",
          lambda shot: shot.images.stored is not None)
_quantity("image.percent", int, "%", "Progress of save_image.", lambda shot: shot.images.percent)
_named("image.status", "image_status", "State of save_image.", lambda shot: shot.images.status)
_quantity("image.chunk", bytes, "",
          "The loaded chunk, 128 bytes, of the opened image; refused while an image is being opened.", _image_chunk)
_quantity("image.chunk_number", int, "", "Number of the loaded chunk.", lambda shot: shot.images.chunk_number)
_quantity("image.chunk_checksum", int, "", "Sum of the loaded chunk's bytes modulo 256.",
          lambda shot: frame_checksum(shot.images.chunk))
_quantity("file.ready", bool, "", "Whether a block of a file is loaded.", lambda shot: bool(shot.files.block))
_quantity("file.parameter_error", bool, "", "Whether the requested file or range does not exist.",
          lambda shot: shot.files.parameter_error)
_quantity("file.checksum", int, "", "CRC-16/XMODEM of the loaded block.", lambda shot: file_checksum(shot.files.block))
_quantity("file.length", int, "B", "Bytes in the loaded block.", lambda shot: len(shot.files.block))
_quantity("file.packet_number", int, "", "Number of the current packet of the last burst.",
          lambda shot: shot.files.packets[0])
_quantity("file.packet", bytes, "", "The current packet of the last burst, 20 bytes.",
          lambda shot: parse_burst_packet(burst_packet(shot.files.block, shot.files.packets[0]))[1])
_file("type", "", "Type of the current file of the list: 4 for an image, 0 at the end of the list.",
      lambda _image: BMP_TYPE)
_quantity("file.updating", bool, "",
          "Whether the current file of the list is still being looked up; its other quantities are 0 until then.",
          lambda shot: shot.file_updating)
_file("counter", "", "Number of the current file of the list.", lambda image: image.number)
_file("size", "B", "Size of the current file of the list.", lambda image: image.file_size)
_file("time", "", "Date and time of the current file of the list, in MS-DOS format.",
      lambda image: msdos_time(image.unix_ns))
_file("crc", "", "CRC-16/XMODEM of the current file of the list.", lambda image: image.file_crc)
_quantity("card.formatting", bool, "", "Whether format_card is erasing all files.",
          lambda shot: shot.erasing and shot.files.formatting)
_quantity("card.erasing", bool, "", "Whether erase_file is erasing all files.",
          lambda shot: shot.erasing and not shot.files.formatting)
_declare("file.hole_map[n]", bytes, "The nth eighth of the map of packets that have arrived.",
         lambda shot, number: shot.files.arrived.part(number), count=8)

# --- health ---

_named("power.phase", "phase", "Phase of the frame cycle.", lambda shot: shot.phase.value)
_quantity("power.voltage", float, "V", "Supply voltage, `power.voltage_v` of the profile.",
          lambda shot: shot.constants.power.config.voltage_v)
_quantity("power.current", float, "A", "Current in this phase.",
          lambda shot: shot.constants.power.current_a(shot.phase))
_quantity("power.now", float, "W", "Power in this phase.", lambda shot: shot.constants.power.power_w(shot.phase))
_quantity("power.mean", float, "W", "Power averaged over a frame period.",
          lambda shot: shot.constants.power.mean_power_w(shot.timing))
_quantity("temperature.mounting", float, "degC", "Temperature of the mounting.",
          lambda shot: shot.thermal.mounting_c(shot.now_ns))
_quantity("temperature.detector", float, "degC", "Temperature of the detector and the lens.",
          lambda shot: shot.thermal.temperature_c(shot.now_ns))
_frame("sky.sun_in_field", bool, "",
       "The Sun is in the field of view of the last frame or within its exclusion angle.",
       lambda frame: "sun" in frame.result.in_field)
_frame("sky.moon_in_field", bool, "", "The Moon is in the field of view of the last frame.",
       lambda frame: "moon" in frame.result.in_field)
_frame("sky.earth_in_field", bool, "",
       "The Earth covers part of the field of view of the last frame, or its lit side is within its exclusion angle.",
       lambda frame: "earth" in frame.result.in_field)
_frame("rate.too_high", bool, "", "The body turned faster than max_rate in the last frame.",
       lambda frame: frame.reason == "rate_too_high")
# fmt: on
