"""From equations to accelerations and corrections: the paper's method, and those it is compared with."""
