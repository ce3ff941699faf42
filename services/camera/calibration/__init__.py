"""Calibration of a camera from pictures of a board: find it, judge the pictures, solve, judge the result."""
