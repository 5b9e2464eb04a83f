"""Machines from MJCF, the format of MuJoCo, by MuJoCo's own parser and compiler.

What the elements mean: https://mujoco.readthedocs.io/en/stable/XMLreference.html. MuJoCo resolves defaults, angles,
includes and inertias from shapes; what it compiles is read here.
"""
