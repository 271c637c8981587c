"""Wahba's problem: the attitude that best rotates reference directions into observed ones.

Wahba (1965) asks for the rotation A that minimises ``½ Σ wᵢ |bᵢ − A rᵢ|²`` over the stars. The five
estimators named in the thesis (section 1.1, its references 28–35) are available through one function:

- ``davenport``: the eigenvector of the 4×4 matrix K to its largest eigenvalue (Davenport's q-method);
- ``quest``: Shuster & Oh 1981, *Three-axis attitude determination from vector observations*;
- ``esoq2``: Mortari 1997, *ESOQ-2 single-point algorithm for fast optimal spacecraft attitude determination*;
- ``foam``: Markley 1993, *Attitude determination using vector observations: a fast optimal matrix algorithm*;
- ``svd``: Markley 1988, *Attitude determination using vector observations and the singular value
  decomposition*.

The notation follows the survey Markley & Mortari 2000, *Quaternion attitude estimation using vector
observations*, J. Astronautical Sciences 48, 359 (M&M). Internally, quaternions follow that literature: the
vector part has the opposite sign to `starid.attitude`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike

from starid.arithmetic.arrays import Array
from starid.arithmetic.elementary import square
from starid.arithmetic.matrices import dot, eigenvectors, inverse, length, lengths, product, sum_of_products
from starid.attitude.attitude import Attitude, quaternion_of
from starid.errors import StaridError

Method = Literal["davenport", "quest", "esoq2", "foam", "svd"]
METHODS: Final[tuple[Method, ...]] = get_args(Method)

_MIN_GAP: Final = 1e-12
"""Smallest gap between the two largest eigenvalues of K (weights of sum 1) that determines roll."""

_CONJUGATE: Final = np.array([-1.0, -1.0, -1.0, 1.0])
_NEWTON_STEPS: Final = 60
_POLISHING_PASSES: Final = 2


def solve_wahba(
    body: ArrayLike, reference: ArrayLike, weights: ArrayLike | None = None, method: Method = "davenport"
) -> Attitude:
    """Find the attitude that minimises Wahba's loss.

    Parameters
    ----------
    body : array (n, 3)
        Observed directions in the sensor frame, of any length; n ≥ 2.
    reference : array (n, 3)
        Directions of the same stars in ICRS.
    weights : array (n,), optional
        Positive weights, ideally 1/σᵢ²; equal by default.
    method : {"davenport", "quest", "esoq2", "foam", "svd"}
        The estimator. All give the same attitude to rounding error, about 1e-16 over the square of the stars'
        RMS angular spread (radians), at any rotation including half turns.

    Returns
    -------
    Attitude
        The rotation ICRS→sensor.

    Raises
    ------
    StaridError
        Fewer than two stars, arrays of different length, bad weights, an unknown method, or directions that
        leave the attitude undetermined (all collinear).
    """
    if method not in _SOLVERS:
        raise StaridError(f"wahba: method must be one of {', '.join(METHODS)}, not {method!r}")
    b, r = _directions("body", body), _directions("reference", reference)
    n = len(b)
    if len(r) != n:
        raise StaridError(f"wahba: {n} body and {len(r)} reference directions; their numbers must be equal")
    if n < 2:
        raise StaridError(f"wahba: {n} star; an attitude needs at least 2")
    w = np.ones(n) if weights is None else np.asarray(weights, dtype=np.float64)
    if w.shape != (n,) or not (np.isfinite(w).all() and (w > 0.0).all()):
        raise StaridError(f"wahba: weights must be {n} positive finite numbers")
    profile = sum_of_products(b * (w / w.sum())[:, None], r)
    *_, second, largest = eigenvectors(_davenport_matrix(profile))[0].tolist()
    if 0.5 * (largest - second) < _MIN_GAP:
        raise StaridError("wahba: the attitude is undetermined; use stars that are further apart")
    return _SOLVERS[method](profile)


def covariance(body: ArrayLike, sigma_rad: ArrayLike) -> Array:
    """Covariance (3, 3), rad², of the attitude error as a rotation vector in the sensor frame.

    For directions with an isotropic error of σᵢ per axis about the line of sight, and weights 1/σᵢ²:
    ``P = [Σ σᵢ⁻² (I − bᵢ bᵢᵀ)]⁻¹`` (Shuster & Oh 1981).

    Parameters
    ----------
    body : array (n, 3)
        Observed directions in the sensor frame.
    sigma_rad : array (n,) or float
        Standard deviation of each direction per axis, radians.

    Raises
    ------
    StaridError
        The arrays differ in length, a sigma is not positive, or the attitude is undetermined.
    """
    b = _directions("body", body)
    sigma = np.asarray(sigma_rad, dtype=np.float64)
    if sigma.shape not in ((), (len(b),)) or not (np.isfinite(sigma).all() and (sigma > 0.0).all()):
        raise StaridError(f"wahba: standard deviations must be {len(b)} positive finite numbers")
    information = np.broadcast_to(1.0 / square(sigma), (len(b),))
    fisher = information.sum() * np.eye(3) - sum_of_products(b * information[:, None], b)
    smallest = eigenvectors(fisher)[0][0] if len(b) else 0.0
    if not smallest > _MIN_GAP * information.sum():
        raise StaridError("wahba: the attitude is undetermined; use stars that are further apart")
    inverted = inverse(fisher)
    symmetric: Array = 0.5 * (inverted + inverted.T)
    return symmetric


def _directions(name: str, values: ArrayLike) -> Array:
    """Normalise directions (n, 3); the error names the array."""
    try:
        table = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError):
        raise StaridError(f"wahba: {name} directions must be an array of numbers, (n, 3)") from None
    if table.ndim != 2 or table.shape[1] != 3:
        raise StaridError(f"wahba: shape of {name} directions must be (n, 3), not {table.shape}")
    norms = lengths(table)
    if not (np.isfinite(norms).all() and (norms > 0.0).all()):
        raise StaridError(f"wahba: {name} directions must be finite and not zero")
    unit: Array = table / norms[:, None]
    return unit


def _davenport_matrix(profile: Array) -> Array:
    """Davenport's matrix K (4, 4) of the attitude profile matrix B = Σ w b rᵀ."""
    (a, b, c), (d, e, f), (g, h, i) = profile.tolist()
    x, y, z = f - h, g - c, b - d
    return np.array(
        [
            [a - e - i, b + d, c + g, x],
            [b + d, e - a - i, f + h, y],
            [c + g, f + h, i - a - e, z],
            [x, y, z, a + e + i],
        ]
    )


def _attitude(quaternion: Array) -> Attitude:
    """Attitude from a quaternion in the convention of the literature."""
    return Attitude(quaternion * _CONJUGATE)


def _largest_eigenvalue(profile: Array) -> float:
    """λ_max of K by Newton's method from its upper bound 1 on the quartic of FOAM (M&M eq. 40).

    ψ(λ) = (λ² − ‖B‖²)² − 8λ det B − 4‖adj B‖². All roots are real, so the steps from above shrink
    monotonically; the iteration ends when they no longer do.
    """
    norm2 = float(np.sum(square(profile)))
    determinant = _determinant(profile)
    adjoint = _adjoint(profile)
    adjoint2 = float(np.sum(square(adjoint)))
    value, last = 1.0, np.inf
    for _ in range(_NEWTON_STEPS):
        excess = value * value - norm2
        slope = 4.0 * value * excess - 8.0 * determinant
        if slope <= 0.0:
            break
        step = (excess * excess - 8.0 * value * determinant - 4.0 * adjoint2) / slope
        if abs(step) >= last or step == 0.0:
            break
        value, last = value - step, abs(step)
    return value


def _adjoint(m: Array) -> Array:
    """Adjoint (transposed cofactors) of a 3×3 matrix."""
    (a, b, c), (d, e, f), (g, h, i) = m.tolist()
    return np.array(
        [
            [e * i - f * h, c * h - b * i, b * f - c * e],
            [f * g - d * i, a * i - c * g, c * d - a * f],
            [d * h - e * g, b * g - a * h, a * e - b * d],
        ]
    )


def _determinant(m: Array) -> float:
    """Determinant of a 3×3 matrix."""
    (a, b, c), (d, e, f), (g, h, i) = m.tolist()
    return float(a * (e * i - f * h) + b * (f * g - d * i) + c * (d * h - e * g))


def _polished(profile: Array, quaternion_at: Callable[[float], Array]) -> Array:
    """Quaternion at λ_max, with λ improved by the Rayleigh quotient.

    The quartic loses digits of λ if two eigenvalues are close (stars close together, two stars). The Rayleigh
    quotient qᵀKq of the first answer is accurate to second order and restores them.
    """
    k = _davenport_matrix(profile)
    quaternion = quaternion_at(_largest_eigenvalue(profile))
    for _ in range(_POLISHING_PASSES):
        quaternion = quaternion_at(dot(product(k, quaternion), quaternion))
    return quaternion


def _with_reference_turned(profile: Array, axis: int) -> Array:
    """Profile matrix after rotating the reference frame by half a turn about an axis (3: none)."""
    if axis == 3:
        return profile
    signs = np.full(3, -1.0)
    signs[axis] = 1.0
    turned: Array = profile * signs
    return turned


def _turned_back(quaternion: Array, axis: int) -> Array:
    """Undo `_with_reference_turned`: the quaternion of A = A'·R(axis, 180°) (M&M eq. 60)."""
    x, y, z, w = quaternion.tolist()
    return np.array([(w, -z, y, -x), (z, w, -x, -y), (-y, x, w, -z), (x, y, z, w)][axis])


def _davenport(profile: Array) -> Attitude:
    """Davenport's q-method: K q = λ_max q (M&M eq. 13)."""
    _, vectors = eigenvectors(_davenport_matrix(profile))
    return _attitude(vectors[:, -1])


def _svd(profile: Array) -> Attitude:
    """B = U Σ Vᵀ, A = U diag(1, 1, det U det V) Vᵀ."""
    u, _, vt = np.linalg.svd(profile)
    u[:, 2] *= np.sign(_determinant(u) * _determinant(vt))
    return Attitude.from_matrix(product(u, vt))


def _foam(profile: Array) -> Attitude:
    """A = [(κ + ‖B‖²) B + λ adj Bᵀ − B Bᵀ B] / ζ, ζ = κλ − det B, κ = ½(λ² − ‖B‖²)."""
    norm2 = float(np.sum(profile * profile))
    determinant = _determinant(profile)
    cofactors = _adjoint(profile).T
    cubic = product(product(profile, profile.T), profile)

    def quaternion_at(value: float) -> Array:
        kappa = 0.5 * (value * value - norm2)
        zeta = kappa * value - determinant
        matrix = ((kappa + norm2) * profile + value * cofactors - cubic) / zeta
        conjugated: Array = quaternion_of(matrix) * _CONJUGATE
        return conjugated

    return _attitude(_polished(profile, quaternion_at))


def _quest(profile: Array) -> Attitude:
    """QUEST with sequential rotations.

    The Gibbs vector of the answer is singular at half a turn, so the reference frame is first rotated by half
    a turn about x, y or z if that is better. The length of the vector ((αI + βS + S²) z, γ) is the scalar
    part of the answer times a factor common to all four cases, so the longest is the safest.
    """
    value = _largest_eigenvalue(profile)
    cases = [_quest_vector(_with_reference_turned(profile, axis)) for axis in range(4)]
    axis = int(np.argmax([length(vector_at(value)) for vector_at in cases]))
    turned = _with_reference_turned(profile, axis)
    quaternion = _polished(turned, lambda value: _unit(cases[axis](value)))
    return _attitude(_turned_back(quaternion, axis))


def _quest_vector(profile: Array) -> Callable[[float], Array]:
    """Return q ∝ ((αI + βS + S²) z, γ) as a function of λ."""
    k = _davenport_matrix(profile)
    sigma, z = float(k[3, 3]), k[:3, 3]
    s = k[:3, :3] + sigma * np.eye(3)
    kappa, delta = float(np.trace(_adjoint(s))), _determinant(s)
    sz = product(s, z)
    ssz = product(s, sz)

    def vector_at(value: float) -> Array:
        alpha = value * value - sigma * sigma + kappa
        gamma = (value + sigma) * alpha - delta
        return np.append(alpha * z + (value - sigma) * sz + ssz, gamma)

    return vector_at


def _esoq2(profile: Array) -> Attitude:
    """ESOQ2: the axis e is the null vector of M = (λ − σ)[(λ + σ)I − S] − z zᵀ.

    It is the largest cross product of two rows. M vanishes at zero rotation, so the reference frame is first
    rotated so that σ = tr B is smallest; then λ − σ ≥ λ.
    """
    axis = int(np.argmin(np.diag(_davenport_matrix(profile))))
    turned = _with_reference_turned(profile, axis)
    k = _davenport_matrix(turned)
    sigma, z = float(k[3, 3]), k[:3, 3]
    s = k[:3, :3] + sigma * np.eye(3)

    def quaternion_at(value: float) -> Array:
        m = (value - sigma) * ((value + sigma) * np.eye(3) - s) - np.outer(z, z)
        adjoint = _adjoint(m)
        y = adjoint[:, int(np.argmax(np.abs(np.diag(adjoint))))]
        return _unit(np.append((value - sigma) * y, dot(z, y)))

    return _attitude(_turned_back(_polished(turned, quaternion_at), axis))


def _unit(vector: Array) -> Array:
    """Scale a vector to length 1."""
    scaled: Array = vector / length(vector)
    return scaled


_SOLVERS: Final[dict[str, Callable[[Array], Attitude]]] = {
    "davenport": _davenport,
    "quest": _quest,
    "esoq2": _esoq2,
    "foam": _foam,
    "svd": _svd,
}
