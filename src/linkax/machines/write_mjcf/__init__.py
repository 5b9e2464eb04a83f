"""Mechanisms as MJCF, the format of MuJoCo, and their motions in the coordinates of MuJoCo.

What the elements mean: https://mujoco.readthedocs.io/en/stable/XMLreference.html. The text is written here, since
MuJoCo's own writer keeps six digits.
"""
