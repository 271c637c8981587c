"""Telemetry: a function for each row of the interface definition, by its name, that returns its values."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Final, TypeAlias

from starhil.emulator.clock import NANOSECONDS, split_unix
from starhil.emulator.device.device import Device
from starhil.emulator.device.refusal import Refused
from starhil.emulator.device.reported import Reported, reported
from starhil.emulator.pipeline.messages import MatchedStar
from starhil.protocol.image_transfer import frame_checksum
from starhil.protocol.messages import ErrorCode
from starhil.protocol.values import Value

Values: TypeAlias = dict[str, Value]

REPORTED_STARS: Final = 3
MAGNITUDE_OF_NONE: Final = 63.535
"""Magnitude reported where there is no star: the maximum of the field."""

IDENTIFIED_STARS: Final = 8


def identification(device: Device) -> Values:
    """128: type, version and uptime of the device."""
    run_ms = (device.clock.now_ns() - device.started_ns) // 1_000_000
    unit = device.profile.device
    return {
        "node_type": unit.node_type,
        "interface_version": unit.interface_version,
        "firmware_major": unit.firmware_major,
        "firmware_minor": unit.firmware_minor,
        "runtime_s": run_ms // 1000,
        "runtime_ms": run_ms % 1000,
    }


def boot_status(device: Device) -> Values:
    """129: causes and number of starts."""
    unit = device.profile.device
    return {
        "reset_cause": device.reset_cause,
        "boot_cause": "power" if device.reset_cause == "power_on" else "command",
        "boot_count": device.boot_count,
        "program_index": 1,
        "firmware_major": unit.firmware_major,
        "firmware_minor": unit.firmware_minor,
    }


def unix_time(device: Device) -> Values:
    """140: the device's clock."""
    seconds, milliseconds, _ = split_unix(device.time.unix_ns())
    return {"seconds": seconds, "milliseconds": milliseconds}


def communication_status(device: Device) -> Values:
    """144: counters and error flags of the links."""
    counters = device.counters
    flags: Values = dict.fromkeys(counters.flags, True)
    return {"telecommand_count": counters.telecommands, "telemetry_count": counters.telemetry, **flags}


def acknowledge(device: Device) -> Values:
    """240: outcome of the last telecommand."""
    last = device.acknowledge
    return {
        "last_telecommand": last.last_telecommand,
        "processed": last.processed,
        "error": last.error.name.lower(),
        "parameter_index": last.parameter_index,
    }


def _brightest(device: Device, count: int) -> list[MatchedStar]:
    last = device.fresh
    return [] if last is None or not last.valid else list(last.result.stars[:count])


def star_magnitudes(device: Device) -> Values:
    """187: magnitudes of the three brightest identified stars."""
    stars = _brightest(device, REPORTED_STARS)
    values: Values = {f"magnitude_{n}": MAGNITUDE_OF_NONE for n in range(1, REPORTED_STARS + 1)}
    return values | {f"magnitude_{n}": star.magnitude for n, star in enumerate(stars, 1)}


def star_performance_1(device: Device) -> Values:
    """188: star counts and image statistics of the last exposure."""
    last = device.fresh
    if last is None:
        return {"identification_mode": "lost_in_space"}
    result = last.result
    return {
        "stars_detected": result.detected,
        "image_noise": result.noise_dn,
        "invalid_stars": result.refused,
        "stars_identified": result.matched,
        "identification_mode": "tracking" if result.tracked else "lost_in_space",
        "image_dark": round(result.background_dn),
    }


def star_timing(device: Device) -> Values:
    """189: duration of the processing steps of the last exposure."""
    last = device.fresh
    if last is None:
        return {}
    return {
        "capture_duration": round(last.capture_s * 1000.0),
        "detection_duration": round(last.detect_s * 1000.0),
        "identification_duration": round(last.identify_s * 1000.0),
    }


def _star_raw(number: int) -> Callable[[Device], Values]:
    def star_raw(device: Device) -> Values:
        """212 to 214: catalogue number and image position of an identified star."""
        stars = _brightest(device, number)
        if len(stars) < number:
            return {}
        star = stars[number - 1]
        camera = device.profile.camera
        return {
            f"star_{number}_catalogue": star.hip,
            f"star_{number}_x": star.x - (camera.width - 1) / 2.0,
            f"star_{number}_y": star.y - (camera.height - 1) / 2.0,
        }

    return star_raw


def rates(device: Device) -> Values:
    """229: body rates."""
    answer = reported(device)
    x, y, z = (math.degrees(rate) for rate in answer.rate_rad_s)
    return {"rate_x": x, "rate_y": y, "rate_z": z}


def quaternion(device: Device) -> Values:
    """230: vector part of the attitude quaternion."""
    x, y, z, _ = reported(device).quaternion_xyzw
    return {"q_x": x, "q_y": y, "q_z": z}


def star_performance_2(device: Device) -> Values:
    """231: flags of the last exposure and confidence in the three reported stars."""
    parameters = device.parameters
    values: Values = {
        "tracking_module_on": bool(parameters["tracking_enable"]),
        "prediction_on": bool(parameters["prediction_enable"]),
        "communication_error": bool(device.counters.flags),
        "sample_period": 1000.0 / float(parameters["update_rate"]),
    }
    last = device.fresh
    if last is None:
        return {**values, "sample_period": round(float(values["sample_period"]))}
    result = last.result
    confidence = round(100.0 * (1.0 - result.probability_false)) if last.valid else 0
    return {
        **values,
        "capture_ok": last.reason not in {"no_frame", "processing_error"},
        "detection_ok": result.detected > 0,
        "identification_ok": result.matched > 0,
        "attitude_ok": last.valid,
        "processing_time_error": last.late or last.reason == "timeout",
        "sample_period": round(last.period_s * 1000.0),
        **{f"confidence_{n}": confidence for n in range(1, min(len(result.stars), REPORTED_STARS) + 1)},
    }


def star_tracker(device: Device) -> Values:
    """211: all star tracker telemetry of one exposure."""
    values: Values = {}
    for name in _STAR_TRACKER:
        values |= TELEMETRY[name](device)
    return values


def star_config(device: Device) -> Values:
    """202: the configuration, with the fields of set_star_config."""
    fields = device.icd.telemetry["star_config"].named_fields.values()
    return {field.name: device.parameters[field.parameter] for field in fields if field.parameter}


def precise_attitude(device: Device) -> Values:
    """160: attitude of one exposure with time, validity and uncertainty."""
    last = device.fresh
    answer: Reported = reported(device)
    mode = device.modes.mode if last is None else last.mode
    values: Values = {"reason": answer.reason, "mode": mode.value, "time_set": device.time.was_set}
    if last is None:
        return values
    q_x, q_y, q_z, q_w = answer.quaternion_xyzw
    rate_x, rate_y, rate_z = (math.degrees(rate) for rate in answer.rate_rad_s)
    result = last.result
    return {
        **values,
        "time_of_exposure": answer.mid_unix_s,
        "frame_counter": last.counter,
        "q_x": q_x,
        "q_y": q_y,
        "q_z": q_z,
        "q_w": q_w,
        "valid": answer.valid,
        "rate_valid": last.rate_valid,
        "tracking": result.tracked,
        "index_pending": result.index_pending,
        "rates_clipped": bool(device.icd.telemetry["rates"].clipped(rates(device))),
        "stars_detected": result.detected,
        "stars_matched": result.matched,
        "uncertainty_cross": result.sigma_cross_arcsec if answer.valid else 0.0,
        "uncertainty_roll": result.sigma_roll_arcsec if answer.valid else 0.0,
        "rate_x": rate_x,
        "rate_y": rate_y,
        "rate_z": rate_z,
        "latency": last.latency_s * 1000.0,
    }


def device_status(device: Device) -> Values:
    """161: state of the device."""
    last = device.fresh
    return {
        "mode": device.modes.mode.value,
        "error": device.modes.error or "none",
        "reset_cause": device.reset_cause,
        "time_set": device.time.was_set,
        "parameters_changed": device.parameters.differ_from_store,
        "attitude_valid": last is not None and last.valid,
        "image_stored": device.images.stored is not None,
        "boot_count": device.boot_count,
        "uptime": (device.clock.now_ns() - device.started_ns) / NANOSECONDS,
        "clock": device.time.unix_ns() / NANOSECONDS,
        "frames_captured": device.cycle.published,
        "frames_valid": device.frames_valid,
        "mode_changes": device.mode_changes,
        "store_fault": device.store.corrupt,
    }


def health(device: Device) -> Values:
    """164: phase, power and temperature now, and flags of the last exposure."""
    now_ns, timing, power = device.clock.now_ns(), device.cycle.timing, device.power
    phase = power.phase(timing, now_ns)
    last = device.fresh
    in_field = () if last is None else last.result.in_field
    return {
        "phase": phase.value,
        **{f"{body}_in_field": body in in_field for body in ("sun", "moon", "earth")},
        "rate_too_high": last is not None and last.reason == "rate_too_high",
        "voltage": device.profile.power.voltage_v,
        "current": 1000.0 * power.current_a(phase),
        "power": power.power_w(phase),
        "mean_power": power.mean_power_w(timing),
        "mounting_temperature": device.thermal.mounting_c(now_ns),
        "detector_temperature": device.thermal.temperature_c(now_ns),
    }


def parameter(device: Device) -> Values:
    """162: the selected parameter with its limits."""
    selected = device.icd.parameters_by_id[device.selected_parameter]
    default = selected.to_number(device.parameters.default(selected.name))
    return {
        "parameter": selected.id,
        "value": device.parameters.number(selected.name),
        "minimum": selected.minimum,
        "maximum": selected.maximum,
        "default": default,
    }


def identified_stars(device: Device) -> Values:
    """163: the brightest identified stars, with full catalogue numbers."""
    last = device.fresh
    if last is None:
        return {}
    stars = _brightest(device, IDENTIFIED_STARS)
    values: Values = {"frame_counter": last.counter, "count": len(stars)}
    for n, star in enumerate(stars, 1):
        values |= {f"hip_{n}": star.hip, f"x_{n}": star.x, f"y_{n}": star.y}
    return values


def image_frame(device: Device) -> Values:
    """192: the loaded image frame."""
    if device.images.busy and device.images.download is None:
        raise Refused(ErrorCode.BUSY)
    return {"data": device.images.frame_bytes()}


def image_frame_info(device: Device) -> Values:
    """193: number and checksum of the loaded image frame."""
    data = device.images.frame_bytes()
    return {"frame": device.images.frame, "checksum": frame_checksum(data)}


def image_status(device: Device) -> Values:
    """233: progress of save_image."""
    return {"percent": device.images.percent, "status": device.images.status}


def file_block(device: Device) -> Values:
    """242: state of the block requested by load_file_block."""
    block = device.files
    return {
        "ready": block.ready,
        "parameter_error": block.parameter_error,
        "checksum": block.checksum,
        "length": len(block.data),
    }


def _hole_map(section: int) -> Callable[[Device], Values]:
    def hole_map(device: Device) -> Values:
        """120 to 127: one eighth of the hole map."""
        return {"map": device.files.arrived.part(section)}

    return hole_map


_STAR_TRACKER: Final = (
    "star_performance_1",
    "star_performance_2",
    "star_magnitudes",
    "star_1_raw",
    "star_2_raw",
    "star_3_raw",
    "star_timing",
    "rates",
    "quaternion",
)

TELEMETRY: Final[dict[str, Callable[[Device], Values]]] = {
    "identification": identification,
    "boot_status": boot_status,
    "unix_time": unix_time,
    "communication_status": communication_status,
    "acknowledge": acknowledge,
    "precise_attitude": precise_attitude,
    "device_status": device_status,
    "parameter": parameter,
    "health": health,
    "identified_stars": identified_stars,
    "star_magnitudes": star_magnitudes,
    "star_performance_1": star_performance_1,
    "star_timing": star_timing,
    "image_frame": image_frame,
    "image_frame_info": image_frame_info,
    "star_config": star_config,
    "star_tracker": star_tracker,
    "star_1_raw": _star_raw(1),
    "star_2_raw": _star_raw(2),
    "star_3_raw": _star_raw(3),
    "rates": rates,
    "quaternion": quaternion,
    "star_performance_2": star_performance_2,
    "image_status": image_status,
    "file_block": file_block,
    **{f"hole_map_{n}": _hole_map(n) for n in range(1, 9)},
}
"""Row name → function that returns its values in physical units; fields left out are sent as zero."""
