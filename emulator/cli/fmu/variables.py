"""The variables of the FMU: the one definition of its description, of the shell's values and of its process."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal

TEXT_SIZE: Final = 4096
"""Bytes of a text with its end, and of a message for the host's log."""

Fmi = Literal["2", "3"]
"""Version of the Functional Mock-up Interface."""

TYPES: Final[dict[type, dict[Fmi, str]]] = {
    float: {"2": "Real", "3": "Float64"},
    int: {"2": "Integer", "3": "Int32"},
    bool: {"2": "Boolean", "3": "Boolean"},
    str: {"2": "String", "3": "String"},
}
"""Type of a start value → its name."""

Causality = Literal["independent", "input", "output", "parameter"]


@dataclass(frozen=True)
class Variable:
    """A variable: its start value also says whether it is a real, a whole number, a truth value or a text."""

    name: str
    start: float | int | bool | str
    about: str
    causality: Causality
    unit: str = ""
    key: str = ""
    """Key of an output in a row of the truth log; empty if it is the name."""

    def kind(self, fmi: Fmi) -> str:
        return TYPES[type(self.start)][fmi]


def variables(profile: str = "", orbit: str = "", command: str = "") -> list[Variable]:
    """Return all variables, in the order of their value references: numbers and truth values, then texts.

    Parameters
    ----------
    profile, orbit, command
        Start values: the device profile, its orbit, and the program that starts the emulator.
    """
    attitude, rotation = (
        "Attitude quaternion of the body, see convention and order",
        "Measured quaternion ICRS to sensor; it rotates vectors",
    )
    return [
        Variable("time", 0.0, "Time of the simulation", "independent", "s"),
        *_vector("q_1 q_2 q_3", attitude, "input"),
        Variable("q_4", 1.0, attitude, "input"),
        *_vector("rate_x rate_y rate_z", "Body rate in the body frame", "input", "deg/s"),
        *_vector("position_x position_y position_z", "Position in GCRS; all zero: that of the profile", "input", "m"),
        *_vector("velocity_x velocity_y velocity_z", "Velocity in GCRS", "input", "m/s"),
        Variable("unix_s", 0.0, "Date as Unix time; 0: that of the profile", "input", "s"),
        *_vector("measured_qx measured_qy measured_qz measured_qw", rotation, "output"),
        *_vector("measured_wx_deg_s measured_wy_deg_s measured_wz_deg_s", "Measured body rate in the sensor frame", "output", "deg/s"),
        Variable("valid", start=False, about="Whether the last measurement has an attitude", causality="output"),
        Variable("frame", 0, "Number of the measurement", "output"),
        Variable("stars_detected", 0, "Stars in the image", "output"),
        Variable("stars_matched", 0, "Stars identified", "output"),
        Variable("exposure_unix_s", 0.0, "Middle of the exposure, by the device's clock", "output", "s", "time_of_exposure_s"),
        Variable("exposure_s", 0.0, "Middle of the exposure, by the time of the simulation", "output", "s", "run_time_s"),
        Variable("sigma_cross", 0.0, "Standard deviation about x or y, the larger", "output", "arcsec", "sigma_cross_arcsec"),
        Variable("sigma_roll", 0.0, "Standard deviation about the boresight", "output", "arcsec", "sigma_roll_arcsec"),
        Variable("seed", 1, "Random seed", "parameter"),
        Variable("check_rates", start=True, about="Whether the rates are connected; they then check the convention", causality="parameter"),
        Variable("reason", "", "Why the last measurement has no attitude", "output"),
        Variable("mode", "", "Mode in which it was taken", "output"),
        Variable("ready", "", "Ready line of the emulator, with its links", "output"),
        Variable("profile", profile, "Device profile: a name or the path of a TOML file", "parameter"),
        Variable("orbit", orbit, "Orbit in place of the profile's: leo, or the path of a TOML file", "parameter"),
        Variable("serial", "auto", "Serial link: auto, a device path, listen://HOST:PORT or off", "parameter"),
        Variable("symlink", "", "Symbolic link to the pty of serial = auto", "parameter"),
        Variable("can", "off", "CAN link: auto, a channel or off", "parameter"),
        Variable("convention", "rotation", "Of q: rotation (rotates vectors from ICRS to the body) or attitude", "parameter"),
        Variable("order", "xyzw", "Of q: xyzw or wxyz", "parameter"),
        Variable("command", command, "Program that starts the emulator", "parameter"),
        Variable("feed", "", "Live feed HOST:PORT of an emulator that runs already; empty: one is started", "parameter"),
        Variable("control", "", "Its control channel, unix:/PATH or HOST:PORT", "parameter"),
    ]  # fmt: skip


def _vector(names: str, about: str, causality: Causality, unit: str = "") -> list[Variable]:
    return [Variable(name, 0.0, about, causality, unit) for name in names.split()]
