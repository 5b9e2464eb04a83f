"""Numbers only, no mechanics: pivoted QR, and the constrained solve with its derivative."""
