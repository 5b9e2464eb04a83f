"""Geometry: rotations and vector products. No mechanics."""
