"""Whether residuals are white: without correlation from one sample to the next."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

MOST_LAGS = 40
CERTAIN = 0.95


class Whiteness(NamedTuple):
    """Autocorrelation of a residual.

    - `correlations`: at 1, 2, … samples apart, (m,). `bounds`: that 95 % of these keep within, where it is
      white, (m,).
    - `probability`: that a white residual has autocorrelations as large, by the test of Ljung and Box (Biometrika 65,
      1978).
    """

    correlations: Float[np.ndarray, " m"]
    bounds: Float[np.ndarray, " m"]
    probability: float

    @staticmethod
    def of(residual: Float[np.ndarray, " n"]) -> "Whiteness | None":
        """Of a residual with NaN where a sample is missing; None of fewer than ten samples, and where all are equal."""
        from scipy.special import gammaincc, ndtri  # SciPy takes its time

        there = np.isfinite(residual)
        count = int(np.sum(there))
        apart = np.where(there, residual - np.mean(residual[there]) if count else 0.0, 0.0)
        square = float(apart @ apart)
        if count < 10 or square == 0.0:
            return None
        lags = np.arange(1, min(MOST_LAGS, count // 4) + 1)
        pairs = np.array([np.sum(there[lag:] & there[:-lag]) for lag in lags])
        sums = np.array([apart[lag:] @ apart[:-lag] for lag in lags])
        correlations, tested = sums / square, len(lags) // 2 or 1
        # Where samples are missing, pairs are fewer, and sums vary less.
        variances = np.maximum(pairs, 1) / (count * (count + 2.0))
        statistic = np.sum((correlations**2 / variances)[:tested])
        bounds = float(ndtri(0.5 + CERTAIN / 2.0)) * np.sqrt(variances)
        return Whiteness(correlations, bounds, float(gammaincc(tested / 2.0, statistic / 2.0)))
