"""What simulates a recording: a mechanism with its step, weights in front of a basis, a linear system."""
