"""A robot, a scene, and the one MuJoCo world they make."""
