"""What holds at one instant: poses, twists, mass matrix, forces, loop constraints, reactions."""
