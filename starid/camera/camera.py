"""The camera: projection of directions in the sensor frame to pixels, and back.

The kernels are imported where they are called: the process that answers the bus knows its camera without numba.
"""

from __future__ import annotations

import dataclasses
import hashlib
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from numbers import Real
from typing import Any, Final, Literal, Self, cast

import numpy as np
from numpy.typing import ArrayLike

from starid.arithmetic.arrays import Array, Mask, elementwise
from starid.arithmetic.elementary import atan2, square, tan
from starid.arithmetic.matrices import lengths
from starid.attitude import Attitude
from starid.camera.parameter_array import EQUIDISTANT, FLAT, K1, LIMIT2, PINHOLE, WIDTH
from starid.errors import StaridError

Model = Literal["pinhole", "equidistant", "flat"]

DEFAULT_FOV_DEG: Final = 42.0
"""Width of the field of the thesis's sensor, degrees."""

_MODEL_CODES: Final[dict[str, int]] = {"pinhole": PINHOLE, "equidistant": EQUIDISTANT, "flat": FLAT}
_WIDEST_FOV_DEG: Final[dict[str, float]] = {"pinhole": 170.0, "equidistant": 360.0, "flat": 360.0}
_MAX_SIDE: Final = 65535
_DISTORTION_TERMS: Final = 5
_BORDER_SAMPLES: Final = 65
_MARGIN: Final = 1.1
_LARGEST_TERM: Final = 1e12
"""Distortion term beyond which no image is one-to-one and the arithmetic overflows."""
_NEVER_TURNS: Final = 1e-300
"""1/r² below which the distortion does not turn back anywhere."""
_FOLD_SHARE: Final = 0.9
_FOV_ITERATIONS: Final = 20
_FOV_CONVERGED: Final = 1e-12


@dataclass(frozen=True)
class Camera:
    """A pixel array behind a lens.

    Attributes
    ----------
    width, height : int
        Size of the pixel array, pixels.
    focal_px : (float, float)
        Focal lengths fx, fy in pixels (for every model: pixels per radian at the centre).
    centre_px : (float, float)
        Position (cx, cy) of the boresight, pixels; pixel centres are integers.
    model : {"pinhole", "equidistant", "flat"}
        Mapping from direction to image plane. "flat" is longitude and latitude about the boresight;
        `flat_view` maps the thesis's flat RA–Dec plane to it.
    distortion : tuple of 5 floats
        Brown–Conrady ``(k1, k2, p1, p2, k3)`` in OpenCV's order and signs, in the image plane.

    Raises
    ------
    StaridError
        A value is out of range, or the distortion folds the image (two directions on one pixel).
    """

    width: int
    height: int
    focal_px: tuple[float, float]
    centre_px: tuple[float, float]
    model: Model = "pinhole"
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        for name in ("width", "height"):
            object.__setattr__(self, name, _side(name, getattr(self, name)))
        _check_model(self.model)
        fx, fy = _numbers("focal_px", self.focal_px, 2)
        if not (fx > 0.0 and fy > 0.0):
            raise StaridError(f"camera focal_px: must be two positive numbers of pixels, not ({fx}, {fy})")
        object.__setattr__(self, "focal_px", (fx, fy))
        object.__setattr__(self, "centre_px", _numbers("centre_px", self.centre_px, 2))
        object.__setattr__(self, "distortion", _terms(self.distortion))
        _ = self.params

    @classmethod
    def from_fov(
        cls,
        fov_deg: float = DEFAULT_FOV_DEG,
        width: int = 937,
        height: int = 937,
        model: Model = "pinhole",
        distortion: Sequence[float] = (),
    ) -> Self:
        """Camera with a given horizontal field and the boresight at the centre of the pixel array.

        Parameters
        ----------
        fov_deg : float
            Horizontal field of view through the centre, from the left edge of the first column to the right
            edge of the last, degrees, distortion included.
        width, height : int
            Pixels.
        model, distortion
            See the class.

        Raises
        ------
        StaridError
            See the class.
        """
        width, height = _side("width", width), _side("height", height)
        _check_model(model)
        widest = _WIDEST_FOV_DEG[model]
        if not _is_number(fov_deg) or not 0.0 < fov_deg <= widest:
            raise StaridError(
                f"camera fov_deg: must be degrees in (0, {widest:g}] for {model}, not {fov_deg!r}"
            )
        half = math.radians(fov_deg) / 2.0
        reach = tan(half) if model == "pinhole" else half
        centre = ((width - 1) / 2.0, (height - 1) / 2.0)
        terms = _terms(distortion)
        if not any(terms):
            focal = width / 2.0 / reach
            return cls(width, height, (focal, focal), centre, model, terms)
        k1, k2, _, _, k3 = terms
        s = reach * reach
        stretch = 1.0 + s * (k1 + s * (k2 + s * k3))
        if stretch <= 0.0:
            raise _fold_error(terms)
        focal = width / 2.0 / (reach * stretch)
        camera = cls(width, height, (focal, focal), centre, model, terms)
        for _ in range(_FOV_ITERATIONS):
            ratio = camera.fov_deg / fov_deg
            focal *= ratio
            camera = cls(width, height, (focal, focal), centre, model, terms)
            if abs(ratio - 1.0) < _FOV_CONVERGED:
                break
        return camera

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Self:
        """Camera from the keys of `to_dict`; `fov_deg` may replace focal_px and centre_px."""
        names = {field.name for field in dataclasses.fields(cls)}
        unknown = sorted(set(values) - names - {"fov_deg"})
        if unknown:
            raise StaridError(
                f"camera: unknown key {unknown[0]!r}; known are {', '.join(sorted(names | {'fov_deg'}))}"
            )
        keys = dict(values)
        if "fov_deg" in keys:
            clash = sorted({"focal_px", "centre_px"} & keys.keys())
            if clash:
                raise StaridError(f"camera: fov_deg and {clash[0]} exclude each other; give one")
            return cls.from_fov(**keys)
        missing = sorted({"width", "height", "focal_px", "centre_px"} - keys.keys())
        if missing:
            raise StaridError(f"camera: key {missing[0]!r} missing; set it, or fov_deg with width and height")
        return cls(**keys)

    def to_dict(self) -> dict[str, Any]:
        """Plain values by field name, for TOML and JSON."""
        values = dataclasses.asdict(self)
        return {key: list(value) if isinstance(value, tuple) else value for key, value in values.items()}

    @cached_property
    def params(self) -> Array:
        """The camera as a read-only array, for the kernels of `starid.camera.projection`."""
        params = np.array(
            [
                _MODEL_CODES[self.model],
                *self.focal_px,
                *self.centre_px,
                *self.distortion,
                self.width,
                self.height,
                square(math.pi) if self.model == "equidistant" else math.inf,
            ],
            dtype=np.float64,
        )
        if any(self.distortion):
            params[LIMIT2] = square(_one_to_one_limit(params, self.border(_BORDER_SAMPLES)))
        params.flags.writeable = False
        return params

    @cached_property
    def identity(self) -> str:
        """Short checksum of all values, for the names of cached files."""
        text = repr((self.width, self.height, self.focal_px, self.centre_px, self.model, self.distortion))
        return hashlib.sha256(text.encode()).hexdigest()[:12]

    @property
    def pixel_scale_rad(self) -> float:
        """Angle subtended by a pixel at the centre, radians (geometric mean of the two axes)."""
        return 1.0 / math.sqrt(self.focal_px[0] * self.focal_px[1])

    @cached_property
    def fov_deg(self) -> float:
        """Horizontal field of view on the row of the centre, edge to edge, degrees."""
        row = self.centre_px[1]
        edges = self.back_project(np.array([[-0.5, row], [self.width - 0.5, row]]))
        left, right = elementwise(atan2, edges[:, 0], edges[:, 2]).tolist()
        return math.degrees(right - left)

    @cached_property
    def field_radius_rad(self) -> float:
        """Largest angle from the boresight to the border of the pixel array, radians."""
        vectors = self.back_project(self.border(_BORDER_SAMPLES))
        angles = elementwise(atan2, lengths(vectors[:, :2]), vectors[:, 2])
        return math.pi if bool(np.any(np.isnan(angles))) else float(np.max(angles))

    def border(self, samples: int) -> Array:
        """Positions (4·samples, 2) in pixels along the outer edge of the pixel array."""
        t = np.linspace(0.0, 1.0, samples)
        x, y = -0.5 + t * self.width, -0.5 + t * self.height
        right, bottom = self.width - 0.5, self.height - 0.5
        sides = [(x, np.full(samples, -0.5)), (x, np.full(samples, bottom))]
        sides += [(np.full(samples, -0.5), y), (np.full(samples, right), y)]
        return np.concatenate([np.column_stack(side) for side in sides])

    def project(self, vectors: ArrayLike) -> tuple[Array, Mask]:
        """Pixel positions of directions.

        Parameters
        ----------
        vectors : array (n, 3)
            Directions in the sensor frame, of any length.

        Returns
        -------
        xy : ndarray (n, 2)
            Pixels. Positions just outside the field are valid; NaN if the lens cannot map the direction.
        inside : ndarray (n,) of bool
            The direction falls on the pixel array: [−0.5, width − 0.5) × [−0.5, height − 0.5).
        """
        from starid.camera.projection import project_kernel

        return project_kernel(self.params, _table("directions", vectors, 3))

    def back_project(self, xy: ArrayLike) -> Array:
        """Return the unit vectors (n, 3) of the sensor frame seen by positions (n, 2) in pixels.

        The inverse of `project` to 1e-6 px. A position that sees no direction (a corner beyond the image
        circle of a very wide lens) gets NaN.
        """
        from starid.camera.projection import back_project_kernel

        return back_project_kernel(self.params, _table("positions", xy, 2))

    def jacobian(self, vectors: ArrayLike) -> Array:
        """Return the derivative (n, 2, 3) of pixel positions with respect to direction, pixels per unit.

        It is evaluated at unit vectors (n, 3) and is zero along the direction itself. When the sensor rotates
        by a small vector e (radians, sensor frame), the directions move by ``v × e``, so the positions move
        by ``J (v × e)``.
        """
        from starid.camera.projection import jacobian_kernel

        return jacobian_kernel(self.params, _table("directions", vectors, 3))


def flat_view(camera: Camera, ra_deg: float, dec_deg: float) -> tuple[Camera, Attitude]:
    """Express the flat RA–Dec plane of the thesis as a camera and an attitude.

    The thesis draws a star at ``x = α − α_c``, ``y = δ − δ_c`` (degrees, no cos δ), whatever the declination
    of the centre. This is not a rotation of the sphere, but it is the "flat" model seen from the celestial
    equator with the centre of the image moved by δ_c: the returned attitude points at (α_c, 0°) with roll 0,
    and the returned camera has ``cy + fy·δ_c``. With this pair the point (α_c, δ_c) falls on the centre of
    the given camera, east is left and north is up, and it projects and back-projects like any other.

    Parameters
    ----------
    camera : Camera
        A camera with model "flat".
    ra_deg, dec_deg : float
        Centre of the field, degrees.
    """
    if camera.model != "flat":
        raise StaridError(f"camera model: must be 'flat' for a flat view, not {camera.model!r}")
    cx, cy = camera.centre_px
    moved = dataclasses.replace(camera, centre_px=(cx, cy + camera.focal_px[1] * math.radians(dec_deg)))
    return moved, Attitude.from_radec_roll(ra_deg, 0.0, 0.0)


def _is_number(value: object) -> bool:
    """Whether a value is a number (a bool is not)."""
    return isinstance(value, Real) and not isinstance(value, bool)


def _side(name: str, side: Any) -> int:
    """Check a side of the pixel array; the error names the field."""
    if isinstance(side, bool) or not isinstance(side, int | np.integer) or not 1 <= side <= _MAX_SIDE:
        raise StaridError(f"camera {name}: must be a whole number 1…{_MAX_SIDE}, not {side!r}")
    return int(side)


def _check_model(model: Any) -> None:
    """Raise if the model is unknown."""
    if not isinstance(model, str) or model not in _MODEL_CODES:
        raise StaridError(f"camera model: must be one of {', '.join(_MODEL_CODES)}, not {model!r}")


def _floats(values: Any) -> tuple[float, ...] | None:
    """Convert values to floats; None unless they are a sequence of finite numbers."""
    if not isinstance(values, Iterable):
        return None
    items = tuple(values)
    if not all(_is_number(item) for item in items):
        return None
    try:
        floats = tuple(float(item) for item in items)
    except OverflowError:  # an integer of hundreds of digits
        return None
    return floats if all(math.isfinite(number) for number in floats) else None


def _numbers(name: str, values: Any, count: int) -> tuple[float, ...]:
    """Check that there are `count` finite numbers; the error names the field."""
    numbers = _floats(values)
    if numbers is None or len(numbers) != count:
        raise StaridError(f"camera {name}: must be {count} finite numbers, not {values!r}")
    return numbers


def _terms(values: Any) -> tuple[float, float, float, float, float]:
    """Distortion terms, padded with zeros."""
    terms = _floats(values)
    if terms is None or len(terms) > _DISTORTION_TERMS:
        raise StaridError(
            f"camera distortion: must be at most {_DISTORTION_TERMS} finite numbers k1, k2, p1, p2, k3, not {values!r}"
        )
    padded = (*terms, *(0.0,) * (_DISTORTION_TERMS - len(terms)))
    return cast("tuple[float, float, float, float, float]", padded)


def _fold_error(terms: Sequence[float]) -> StaridError:
    """Make the error for a distortion that folds the image."""
    return StaridError(
        f"camera distortion {[float(term) for term in terms]}: folds the image inside its border; "
        "use smaller terms, a longer focal length or the equidistant model"
    )


def _table(name: str, values: ArrayLike, columns: int) -> Array:
    """Convert to a contiguous float array (n, columns); the error names it."""
    table = np.ascontiguousarray(values, dtype=np.float64)
    if table.ndim != 2 or table.shape[1] != columns:
        raise StaridError(f"camera: shape of {name} must be (n, {columns}), not {table.shape}")
    return table


def _one_to_one_limit(params: Array, border: Array) -> float:
    """Radius, in the plane, of a disc that holds the whole image and on which the distortion is one-to-one.

    The radial part turns back at the smallest positive root of 1 + 3k₁r² + 5k₂r⁴ + 7k₃r⁶, of which 1/r² is
    found: its polynomial has the leading coefficient 1, however small the terms are. The disc ends before
    this root, so that no star from outside is folded into the image. On the disc the determinant of the whole
    distortion, tangential part included, must stay positive.
    """
    from starid.camera.projection import is_one_to_one, undistorted_reach

    k1, k2, _, _, k3 = params[K1:WIDTH]
    if np.max(np.abs(params[K1:WIDTH])) > _LARGEST_TERM:
        raise _fold_error(params[K1:WIDTH].tolist())
    inverse = np.roots([1.0, 3.0 * k1, 5.0 * k2, 7.0 * k3])
    turns = [1.0 / float(r.real) for r in inverse if abs(r.imag) < 1e-9 * abs(r) and r.real > _NEVER_TURNS]
    fold = math.sqrt(min([*turns, params[LIMIT2]]))
    probe = params.copy()
    probe[LIMIT2] = square(fold)
    reach = undistorted_reach(probe, border)
    limit = min(_MARGIN * reach, reach + _FOLD_SHARE * (fold - reach))
    if not (math.isfinite(reach) and is_one_to_one(params, limit, 40, 48)):
        raise _fold_error(params[K1:WIDTH].tolist())
    return limit


DEFAULT_CAMERA: Final = Camera.from_fov()
"""The camera of the thesis and of the emulator: pinhole, 937 × 937 pixels, 42° wide."""
