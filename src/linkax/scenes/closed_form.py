"""Motion in closed form that several scenes share: that of a pendulum, swinging or turning."""

import numpy as np
from scipy.special import ellipj, ellipkinc


def direction(angle) -> np.ndarray:
    """Unit vectors at angles from +x towards +y [rad], (n, 3)."""
    return np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=-1)


def pendulum_angle(times, stiffness, angle, speed) -> np.ndarray:
    """θ(t) of θ̈ = −ω² sin θ, by Jacobi's elliptic functions [rad].

    Whittaker, Analytical Dynamics of Particles and Rigid Bodies (4th ed.), section 44.

    **Arguments:**

    - `times` [s], from the start; `stiffness`: ω² [1/s²], zero or more.
    - `angle`, `speed`: θ and θ̇ at the start [rad, rad/s].
    """
    times = np.asarray(times, dtype=float)
    if stiffness == 0.0:
        return angle + speed * times
    frequency, turns = np.sqrt(stiffness), np.round(angle / (2.0 * np.pi))
    half = angle / 2.0 - np.pi * turns
    # k² = E / (2 ω²), with the energy counted from the lowest position.
    square = np.sin(half) ** 2 + (speed / (2.0 * frequency)) ** 2
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
