"""Parameters of lens, pixels and converter, and the signal from a star of a given magnitude."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Any, Final, Literal, Self, TypeAlias, get_args

import numpy as np

from starhil.emulator.errors import EmulatorError
from starhil.emulator.simulation.limited import limited
from starid.arithmetic.arrays import Array
from starid.arithmetic.elementary import hypot, log10, power, square
from starid.attitude import ARCSEC_PER_RAD

if TYPE_CHECKING:
    from starhil.emulator.sensor.noise import Digitizer
    from starid.camera import Camera
    from starid.imaging.detection import DetectionSettings

ARCSEC2_PER_SR: Final = square(180.0 * 3600.0 / math.pi)
SOLAR_COLOUR_B_V: Final = 0.65
"""B−V of a star for which the colour term is zero."""

Bits: TypeAlias = Literal[8, 12, 16]
"""Bits per pixel."""


@dataclass(frozen=True)
class SensorModel:
    """Optics and detector of a star sensor; the defaults have the field and the pixels of CubeStar, and a far larger lens.

    A lens of 14.6 mm focal length and 12 mm aperture (f/1.2) images 42° onto 937 pixels of 12 µm. A star of V = 0 and solar
    colour yields 4.6e10 photons/s/m² between 400 and 900 nm: 3.63e-11 W/m²/nm at 550 nm are 1.0e8
    photons/s/m²/nm (Bessell 1979), of which the photon spectrum of a G2 star averages 0.92 over the 500 nm.
    With a transmission of 0.75 and a quantum efficiency of 0.45 this gives 1.8e6 electrons/s, or 1 400 in 0.2
    s for V = 6.
    """

    exposure_s: float = limited(1e-6, 60.0, 0.2, unit="seconds")
    """Exposure, seconds."""
    aperture_m: float = limited(1e-4, 1.0, 0.012, unit="metres")
    """Diameter of the entrance pupil, metres."""
    transmission: float = limited(1e-3, 1.0, 0.75, unit="fraction")
    quantum_efficiency: float = limited(1e-3, 1.0, 0.45, unit="fraction")
    """Fractions of photons that pass the lens and that free an electron, averaged over the band."""
    zero_point_photons_s_m2: float = limited(1e6, 1e13, 4.6e10, unit="photons/s/m²")
    """Photons/s/m² in the band from a star of V = 0 and solar colour."""
    colour_term: float = limited(-2.0, 2.0, 0.0, unit="mag per mag of B−V")
    """The sensor's magnitude is V − colour_term·(B−V − 0.65); about 0.4 for silicon, which favours red stars."""
    psf_sigma_px: float = limited(0.3, 12.0, 0.8, unit="pixels")
    """Standard deviation of the Gaussian spot at the image centre, pixels. 0.8 is about the smallest spot that can be
    fitted without pixel-phase error."""
    psf_growth: float = limited(0.0, 5.0, 0.0, unit="fraction")
    """Relative increase of the spot width from the image centre to the middle of an edge, with the square of the distance from
    the centre: twice as large in the corners."""
    vignetting: int = limited(0, 8, 0, unit="exponent")
    """Light at an angle θ from the optical axis is cosⁿθ of that on it; this is n. 1: the pupil, seen from there, is
    narrower, and nothing else cuts off the light of a star. An extended source on a flat detector has cos⁴θ, because a pixel
    there also sees less of it (cos³θ); a diaphragm or a rim of the lens cuts off more."""
    gain: float = limited(0.01, 1000.0, 1.0, unit="times")
    """Analog gain before the converter."""
    bits: Bits = 8
    """8, 12 or 16."""
    adc_range_e: float = limited(1.0, 1e7, 6400.0, unit="electrons")
    """Full range of the converter at gain 1, electrons."""
    offset_share: float = limited(0.0, 0.5, 0.03, unit="of the converter's range")
    """Black level as a fraction of the range."""
    full_well_e: float = limited(10.0, 1e7, 15000.0, unit="electrons")
    """Full-well capacity, electrons."""
    blooming: float = limited(0.0, 1.0, 0.0, unit="fraction")
    """Fraction of the charge beyond the full well that spills along the column. 0: all is drained, as in most CMOS pixels; 1: a
    CCD without drains."""
    persistence_share: float = limited(0.0, 1.0, 0.0, unit="of the full well")
    """Charge that traps keep in a pixel that has reached its full well, and release into later images. 0.004, that is 240 electrons,
    in one front-illuminated CCD (KAF-3200)."""
    persistence_s: float = limited(1e-3, 1e5, 1.0, unit="seconds")
    """Time constant with which they release it, seconds: from less than one near room temperature, an assumption, to minutes in
    cooled detectors."""
    read_noise_e: float = limited(0.0, 1e4, 12.0, unit="electrons")
    """Electrons, standard deviation."""
    dark_e_s: float = limited(0.0, 1e6, 30.0, unit="electrons/s")
    """Mean dark current at `reference_c`, electrons/s."""
    temperature_c: float = limited(-100.0, 150.0, 20.0, unit="°C")
    """Temperature of detector and lens, °C, unless another is given for a frame."""
    reference_c: float = limited(-100.0, 150.0, 20.0, unit="°C")
    """Temperature at which dark currents, lens and mounting have their stated values, °C."""
    dark_doubling_c: float = limited(1.0, 100.0, 6.5, unit="°C")
    """Temperature rise that doubles the dark current, °C; 5 to 8 for silicon."""
    row_time_s: float = limited(0.0, 0.01, 0.0, unit="seconds")
    """Time from the exposure of one row to the next, seconds: 0 for a global shutter, which exposes all rows at once.
    The middle row of a rolling shutter is exposed at the time of the frame."""
    boresight_drift_x: float = limited(-1000.0, 1000.0, 0.0, unit="arcseconds/°C")
    boresight_drift_y: float = limited(-1000.0, 1000.0, 0.0, unit="arcseconds/°C")
    boresight_drift_z: float = limited(-1000.0, 1000.0, 0.0, unit="arcseconds/°C")
    """Rotation of the optics relative to the mounting about the axes of the sensor frame, arcseconds/°C."""
    focal_drift: float = limited(-1e-3, 1e-3, 0.0, unit="1/°C")
    """Relative change of the focal length, 1/°C."""
    k1_drift: float = limited(-1e-2, 1e-2, 0.0, unit="1/°C")
    """Change of the distortion k1, 1/°C."""
    pixel_um: float = limited(0.5, 100.0, 12.0, unit="micrometres")
    """Width of a pixel, micrometres; it decides only what particles do."""
    epi_um: float = limited(0.1, 1000.0, 10.0, unit="micrometres")
    """Thickness of the epitaxial layer, in which particles leave charge, micrometres."""
    damage_tev_g: float = limited(0.0, 1e4, 0.0, unit="TeV/g")
    """Displacement damage dose of the detector since it was on the ground, TeV/g; 1e10 protons/cm² of 50 MeV give 39. It
    makes hot pixels, and pixels whose dark current switches between two values."""
    sky_mag_arcsec2: float = limited(-10.0, 40.0, 22.1, unit="magnitudes/arcsec²")
    """Brightness of the sky background (zodiacal light and unresolved stars), V magnitudes/arcsec²."""
    dsnu: float = limited(0.0, 2.0, 0.2, unit="of the dark current")
    prnu: float = limited(0.0, 0.3, 0.01, unit="fraction")
    """Standard deviation between pixels of the dark current and of the sensitivity, relative to their means."""
    hot_pixels: int = limited(0, 10_000_000, 30, unit="pixels")
    """Number of pixels with excessive dark current."""
    hot_e_s: float = limited(0.0, 1e7, 10000.0, unit="electrons/s")
    """Median dark current of hot pixels at `reference_c`, electrons/s; log-normal with a factor of 2.7 per sigma."""
    dead_pixels: int = limited(0, 10_000_000, 10, unit="pixels")
    """Number of pixels without signal."""
    pattern_seed: int = limited(0, 2**63 - 1, 0, unit="a whole number")
    """Seed of the fixed pattern."""
    limiting_magnitude: float = limited(-2.0, 20.0, 6.0, unit="magnitudes")
    """V of the faintest rendered stars; fainter companions within two pixels of one are rendered too."""

    def __post_init__(self) -> None:
        """Check the limits, which also hold for what changes during a run: exposure, gain and temperature."""
        if self.bits not in get_args(Bits):
            raise EmulatorError(f"sensor.bits: must be one of 8, 12, 16 (given: {self.bits!r})")
        for name, (low, high, _) in _LIMITS.items():
            value = getattr(self, name)
            if not low <= value <= high:
                limit = f"at most {high:g}" if value > high else f"at least {low:g}"
                raise EmulatorError(f"sensor.{name}: must be {limit} (given: {value!r})")

    def with_(self, **changes: Any) -> Self:
        """Return a copy with some fields changed."""
        return replace(self, **changes)

    @property
    def zero_magnitude_e_s(self) -> float:
        """Return electrons/s from a star of V = 0 and solar colour."""
        area = math.pi / 4.0 * square(self.aperture_m)
        return self.zero_point_photons_s_m2 * area * self.transmission * self.quantum_efficiency

    def electrons(self, magnitude: float, exposure_s: float | None = None) -> float:
        """Return the mean number of electrons from a star of a sensor magnitude in one exposure."""
        exposure = self.exposure_s if exposure_s is None else exposure_s
        return self.zero_magnitude_e_s * exposure * power(10.0, -0.4 * magnitude)

    def faintest_magnitude(self, pixel_scale_rad: float, threshold: float) -> float:
        """Return the magnitude of a star whose signal in the matched filter is `threshold` standard deviations of the noise.

        That is the magnitude at which about half of the stars are found: electrons = threshold·σ·√(4π s²), with the noise σ of
        a pixel and the mean width s of a spot, that of the pixel included.
        """
        dark_e_s = self.dark_e_s * self.dark_factor(self.temperature_c)
        light = (self.sky_e_s(pixel_scale_rad) + dark_e_s) * self.exposure_s
        noise_e = math.sqrt(light + square(self.read_noise_e) + square(self.gain_e_per_dn) / 12.0)
        spot_px = hypot(self.psf_sigma_px * (1.0 + self.psf_growth / 3.0), 1.0 / math.sqrt(12.0))
        electrons = threshold * noise_e * math.sqrt(4.0 * math.pi) * spot_px
        return -2.5 * log10(electrons / (self.zero_magnitude_e_s * self.exposure_s))

    def sky_e_s(self, pixel_scale_rad: float) -> float:
        """Return electrons/s per pixel from the sky background, for pixels of width `pixel_scale_rad`."""
        arcsec2 = square(pixel_scale_rad) * ARCSEC2_PER_SR
        return self.zero_magnitude_e_s * arcsec2 * power(10.0, -0.4 * self.sky_mag_arcsec2)

    def dark_factor(self, temperature_c: float) -> float:
        """Return the dark current at a temperature relative to that at `reference_c`."""
        return power(2.0, (temperature_c - self.reference_c) / self.dark_doubling_c)

    def camera_at(self, camera: Camera, temperature_c: float) -> Camera:
        """Return the camera at a temperature; unchanged at `reference_c` or without drift."""
        above = temperature_c - self.reference_c
        if above == 0.0 or (self.focal_drift == 0.0 and self.k1_drift == 0.0):
            return camera
        scale = 1.0 + self.focal_drift * above
        k1, k2, p1, p2, k3 = camera.distortion
        return replace(
            camera,
            focal_px=(camera.focal_px[0] * scale, camera.focal_px[1] * scale),
            distortion=(k1 + self.k1_drift * above, k2, p1, p2, k3),
        )

    def boresight_drift_rad(self, temperature_c: float) -> Array:
        """Return the rotation vector (3,) of the optics relative to the mounting, radians, sensor frame."""
        drift = np.array([self.boresight_drift_x, self.boresight_drift_y, self.boresight_drift_z])
        return np.asarray(drift * ((temperature_c - self.reference_c) / ARCSEC_PER_RAD))

    @property
    def mean_psf_sigma_px(self) -> float:
        """Standard deviation of the spot, averaged over a square field: the mean square of the distance is 2/3 there."""
        return self.psf_sigma_px * (1.0 + self.psf_growth * 2.0 / 3.0)

    @property
    def max_dn(self) -> int:
        """Largest count of the converter."""
        return int(2**self.bits - 1)

    @property
    def offset_dn(self) -> float:
        """Black level, counts."""
        return float(round(self.offset_share * self.max_dn))

    @property
    def gain_e_per_dn(self) -> float:
        """Electrons per count."""
        return self.adc_range_e / self.gain / self.max_dn

    @property
    def saturation_dn(self) -> int:
        """Count from which a pixel is saturated, by the converter or by its full well."""
        well = self.offset_dn + self.full_well_e / self.gain_e_per_dn
        noise = self.read_noise_e / self.gain_e_per_dn
        return self.max_dn if well > self.max_dn else max(int(well - 3.0 * noise), 1)

    @property
    def digitizer(self) -> Digitizer:
        """Parameters of the noise kernel."""
        from starhil.emulator.sensor.noise import Digitizer  # with kernels: a profile is read without numba

        return Digitizer(self.read_noise_e, self.full_well_e, self.gain_e_per_dn, self.offset_dn, self.max_dn)

    def detection_settings(self, **changes: Any) -> DetectionSettings:
        """Return detection settings with gain, saturation, growth of the spot and, if uniform over the image, its width."""
        from starid.imaging.detection import DetectionSettings

        settings = DetectionSettings(
            psf_sigma_px=self.psf_sigma_px if self.psf_growth == 0.0 else None,
            psf_growth=self.psf_growth,
            gain_e_per_dn=self.gain_e_per_dn,
            saturation_dn=self.saturation_dn,
        )
        return replace(settings, **changes)


_LIMITS: Final = {each.name: each.metadata["limits"] for each in fields(SensorModel) if each.metadata}
"""Lowest and highest value of each field, and their unit."""
