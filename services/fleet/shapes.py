"""Places of claims in the frame that all aircraft share. Pure."""

from __future__ import annotations

import math
from dataclasses import dataclass

from schemas.fleet import Vec2


@dataclass(frozen=True, slots=True)
class Stretch:
    """A straight way from one place to another, metres; ``sigma_m`` is the doubt of where it lies."""

    from_m: Vec2
    to_m: Vec2
    sigma_m: float = 0.0

    def gap_m(self, other: Stretch) -> float:
        """Return the least distance of two stretches."""
        if _cross(self, other):
            return 0.0
        return min(
            self.from_point_m(other.from_m), self.from_point_m(other.to_m),
            other.from_point_m(self.from_m), other.from_point_m(self.to_m),
        )  # fmt: skip

    def from_point_m(self, p: Vec2) -> float:
        """Return the distance of a point from the stretch."""
        q = self.nearest(p)
        return math.hypot(p[0] - q[0], p[1] - q[1])

    def nearest(self, p: Vec2) -> Vec2:
        """Return the place on the stretch that is nearest to a point."""
        (ax, ay), (bx, by) = self.from_m, self.to_m
        dx, dy = bx - ax, by - ay
        length2 = dx * dx + dy * dy
        share = 0.0 if length2 == 0.0 else min(1.0, max(0.0, ((p[0] - ax) * dx + (p[1] - ay) * dy) / length2))
        return ax + share * dx, ay + share * dy

    def ahead_of(self, p: Vec2, keep_m: float = 0.0) -> Stretch:
        """Return what lies ahead of the place nearest to ``p``, and the last ``keep_m`` in any case."""
        begin, length_m = self.nearest(p), math.dist(self.from_m, self.to_m)
        if length_m <= keep_m:
            begin = self.from_m
        elif math.dist(begin, self.to_m) < keep_m:
            (ax, ay), (bx, by), share = self.from_m, self.to_m, keep_m / length_m
            begin = bx + share * (ax - bx), by + share * (ay - by)
        return Stretch(begin, self.to_m, self.sigma_m)

    def doubt_m(self, other: Stretch) -> float:
        """Return two standard deviations of the distance between the two."""
        return 2.0 * math.hypot(self.sigma_m, other.sigma_m)


def _cross(a: Stretch, b: Stretch) -> bool:
    def side(s: Stretch, p: Vec2) -> float:
        return (s.to_m[0] - s.from_m[0]) * (p[1] - s.from_m[1]) - (s.to_m[1] - s.from_m[1]) * (p[0] - s.from_m[0])

    return side(a, b.from_m) * side(a, b.to_m) < 0.0 and side(b, a.from_m) * side(b, a.to_m) < 0.0
