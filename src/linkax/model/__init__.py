"""What a scene is: bodies, joints, forces, and the mechanism they form."""
