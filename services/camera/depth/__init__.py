"""Depth pre-processing: from what the sensor gives to what slam, mapper and refiner want. Pure functions of arrays."""
