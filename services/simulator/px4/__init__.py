"""A quadrotor behind a MAVLink endpoint that behaves as PX4 v1.16 was measured to (design.md section 7)."""
