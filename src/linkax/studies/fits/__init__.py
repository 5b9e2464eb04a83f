"""Fits to measurements, profiles of their likelihood, and the design of experiments."""
