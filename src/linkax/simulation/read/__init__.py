"""What can be read from a run: `linkax.Solution`."""
