"""Force elements: springs, actuators, contact, stops, and their internal states."""
