"""The motion of a pendulum, swinging or turning, in closed form, which several scenes share."""

import numpy as np
from jaxtyping import Float

from linkax.model.numbers import Number, Vector

SLOW = 1e-8  # |k² − 1|, below which elliptic functions lose their digits, next to coming to rest upright


def turned_link(times: Vector, stiffness: Number, angle: Number, speed: Number) -> Float[np.ndarray, "times 3"] | None:
    """Compute unit vectors (n, 3) along a link that moves like a pendulum: α̈ = −ω² cos α, α from +x towards +y.

    None where the link nearly comes to rest upright.

    **Arguments:**

    - `times`: [s], from the start.
    - `stiffness`: ω² [1/s²].
    - `angle`, `speed`: α and α̇ at the start [rad, rad/s].
    """
    hanging = -np.pi / 2 if stiffness >= 0.0 else np.pi / 2
    found = pendulum_angle(times, abs(stiffness), angle - hanging, speed)
    if found is None:
        return None
    turn = found + hanging
    return np.stack([np.cos(turn), np.sin(turn), np.zeros_like(turn)], axis=-1)


def pendulum_angle(
    times: Vector, stiffness: Number, angle: Number, speed: Number
) -> Float[np.ndarray, " times"] | None:
    """Solve θ̈ = −ω² sin θ for θ(t) [rad] by Jacobi's elliptic functions; None where it nearly comes to rest upright.

    Whittaker, Analytical Dynamics of Particles and Rigid Bodies (4th ed.), section 44. Arguments: see `turned_link`.
    """
    from scipy.special import ellipj, ellipkinc  # SciPy takes its time

    times = np.asarray(times, dtype=float)
    if stiffness == 0.0:
        return np.asarray(angle + speed * times)
    frequency, turns = np.sqrt(stiffness), np.round(angle / (2.0 * np.pi))
    half = angle / 2.0 - np.pi * turns
    # k² = E / (2 ω²), with the energy counted from the lowest position.
    square = np.sin(half) ** 2 + (speed / (2.0 * frequency)) ** 2
    if abs(square - 1.0) < SLOW:
        return None
    if square == 0.0:
        return np.full_like(times, angle)
    if square < 1.0:  # it swings: sin(θ/2) = k sn(ωt + u), cos(θ/2) = dn(ωt + u)
        modulus = np.sqrt(square)
        amplitude = np.arctan2(np.sin(half) / modulus, speed / (2.0 * frequency * modulus))
        sine, _, delta, _ = ellipj(frequency * times + ellipkinc(amplitude, square), square)
        return 2.0 * (np.arctan2(modulus * sine, delta) + np.pi * turns)
    # It turns: θ/2 = am(kωt + u).
    rate = np.copysign(frequency * np.sqrt(square), speed)
    return 2.0 * (ellipj(rate * times + ellipkinc(half, 1.0 / square), 1.0 / square)[3] + np.pi * turns)
