"""From a state to a motion: `start`, `integrate`, `explain`, `read`, and `linkax.simulate` above them."""
