"""Magnitudes: Johnson V from the Hipparcos magnitude and colour, absolute magnitudes, flux ratios."""

from __future__ import annotations

from functools import partial
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from starid.arithmetic.arrays import Array, elementwise, interpolated
from starid.arithmetic.elementary import exp, log10, power, square

EVEN_PAIR: Final = 0.45
"""Brightness ratio from which a single spot fits two stars at their centre of light."""

_BLUE_TO_RED_B_V: Final = np.array(
    [
        *(-0.219, -0.179, -0.139, -0.095, -0.048, -0.005, 0.040, 0.083, 0.130, 0.179, 0.227, 0.275),
        *(0.325, 0.374, 0.420, 0.465, 0.505, 0.549, 0.590, 0.632, 0.674, 0.715, 0.756, 0.796, 0.837),
        *(0.878, 0.919, 0.958, 0.996, 1.034, 1.072, 1.111, 1.151, 1.190, 1.228, 1.266, 1.305, 1.344),
        *(1.384, 1.423, 1.462, 1.501, 1.541, 1.580, 1.619, 1.658),
    ]
)
_BLUE_TO_RED_V_HP: Final = np.array(
    [
        *(0.066, 0.051, 0.036, 0.021, 0.006, -0.011, -0.025, -0.038, -0.048, -0.058, -0.069, -0.079),
        *(-0.087, -0.094, -0.101, -0.108, -0.114, -0.120, -0.127, -0.131, -0.134, -0.137, -0.142, -0.147),
        *(-0.151, -0.155, -0.158, -0.157, -0.160, -0.162, -0.164, -0.166, -0.166, -0.165, -0.164, -0.161),
        *(-0.157, -0.153, -0.148, -0.143, -0.137, -0.131, -0.125, -0.119, -0.112, -0.106),
    ]
)
_RED_V_I: Final = np.array([1.50, 1.60, 1.75, 2.00, 2.25, 2.50, 2.75, 3.00, 3.50, 3.60, 5.70, 9.00])
_RED_V_HP: Final = np.array(
    [-0.127, -0.116, -0.106, -0.080, -0.052, -0.020, 0.030, 0.100, 0.285, 0.340, 1.475, 3.26]
)
_RED_FROM: Final = 1.5
_RED_WHOLLY_FROM: Final = 1.7
_NO_COLOUR_V_HP: Final = -0.12


def v_from_hp(hp: ArrayLike, b_v: ArrayLike, v_i: ArrayLike) -> Array:
    """Johnson V of stars from their Hipparcos magnitude and colours.

    V − Hp is interpolated linearly, in three ranges:

    - V−I < 1.5: from B−V by table 2 of Bessell (2000, PASP 112, 961), whose B_T−V_T column is converted to
      B−V by its column of differences;
    - V−I > 1.7: from V−I, because B−V of M and carbon stars saturates. The knots were fitted here to about
      thirty red stars with published V (Hipparcos 1997). Between 1.5 and 1.7 the two are mixed linearly;
    - no colour: −0.12, the typical value.

    Compared with published V of well-known constant stars the median error is about 0.01 mag; variable stars
    and close doubles differ by more (the tests print the figures).

    Parameters
    ----------
    hp : array (n,)
        Hipparcos magnitude Hp.
    b_v, v_i : array (n,)
        Johnson B−V and Cousins V−I, NaN where unknown.

    Returns
    -------
    ndarray (n,)
        Johnson V.
    """
    hp_, b_v_, v_i_ = np.broadcast_arrays(
        np.asarray(hp, np.float64), np.asarray(b_v, np.float64), np.asarray(v_i, np.float64)
    )
    by_b_v = interpolated(b_v_, _BLUE_TO_RED_B_V, _BLUE_TO_RED_V_HP)
    by_v_i = interpolated(v_i_, _RED_V_I, _RED_V_HP)
    share = np.clip((v_i_ - _RED_FROM) / (_RED_WHOLLY_FROM - _RED_FROM), 0.0, 1.0)
    no_b_v, no_v_i = np.isnan(b_v_), np.isnan(v_i_)
    share = np.where(no_v_i, 0.0, share)
    blue = np.where(no_b_v, np.where(share > 0.0, by_v_i, _NO_COLOUR_V_HP), by_b_v)
    mixed: Array = hp_ + (1.0 - share) * blue + share * np.where(no_v_i, 0.0, by_v_i)
    return mixed


def absolute_magnitude(magnitude: ArrayLike, parallax_mas: ArrayLike) -> Array:
    """Absolute magnitude, eq. 2.1 of the thesis: M = m + 5·log10(π) − 10 with π in milliarcseconds.

    NaN where the parallax is not positive.
    """
    parallax = np.asarray(parallax_mas, np.float64)
    positive = np.where(parallax > 0.0, parallax, np.nan)
    absolute: Array = np.asarray(magnitude, np.float64) + 5.0 * elementwise(log10, positive) - 10.0
    return absolute


def flux_ratio(magnitude: ArrayLike) -> Array:
    """Flux of a magnitude relative to magnitude zero: 10^(−0.4·m)."""
    return elementwise(partial(power, 10.0), -0.4 * np.asarray(magnitude, np.float64))


def fitted_share(distance: Array, brightness_ratio: Array) -> Array:
    """Shift of a fitted position by an unresolved companion, as a share of the centre of light's shift.

    The fit of a single spot gives less weight to light at its rim: the shift by a faint companion falls as a
    Gaussian of the distance, but a companion with about half the light of the star or more shifts it fully.
    The model was fitted to rendered pairs, to within 0.1.

    Parameters
    ----------
    distance : ndarray
        Distance relative to the smallest one at which two stars are resolved (about 2.4 sigma of the spot).
    brightness_ratio : ndarray
        Ratio of the companion's flux to the star's, at most 1.
    """
    return 1.0 - (1.0 - elementwise(exp, -square(distance))) * np.maximum(
        1.0 - square(brightness_ratio / EVEN_PAIR), 0.0
    )
