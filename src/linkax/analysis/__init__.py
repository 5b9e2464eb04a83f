"""A mechanism at one state: mobility, forces that move it, equilibrium, small vibrations."""
