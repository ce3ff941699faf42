"""Refinement of mapped trees in the depth image, at frame rate."""
