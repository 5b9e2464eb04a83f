"""From equations to accelerations and corrections: the paper's method."""
