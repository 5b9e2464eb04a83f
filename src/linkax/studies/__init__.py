"""Studies of many runs: sweeps, fits, comparisons, differentiability."""
