"""Robots, grippers and parts: what they are, read from their model files."""
