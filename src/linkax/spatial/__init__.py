"""Geometry without mechanics: vectors, rotations, quaternions, screws."""
