"""What happens when something fails in flight: real processes, faults done to them, and what must hold, measured."""
