"""Analyse a mechanism at one state: its mobility, inverse dynamics, equilibrium and small vibrations."""
