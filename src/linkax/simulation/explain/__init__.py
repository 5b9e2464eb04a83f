"""What there is to say of a run: why it failed, what to watch, how far off it is."""
