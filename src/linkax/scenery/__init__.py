"""What pictures and views show of a moving mechanism, and from where it is seen."""
