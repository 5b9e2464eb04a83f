"""Constraints by their residuals: drives, couplings, ropes, gears, guides, rolling."""
