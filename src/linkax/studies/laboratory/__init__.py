"""What a laboratory has: records, sensors, experiments, and their noise."""
