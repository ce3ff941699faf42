"""Candidates that passed the checks, and which of them are arms of one forked tree."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from services.detector.checks import axis_at
from services.detector.cylinders import Cylinder
from services.detector.forks import Arm, Fork, Stem, find_forks, find_stem
from services.detector.model import Floats, Ground, Rejection
from services.detector.upright import Upright


@dataclass(frozen=True, slots=True)
class Candidate:
    """A cylinder that passed the checks; heights above the ground at its base."""

    cylinder: Cylinder
    base: Floats
    low_m: float
    high_m: float
    top_m: float
    fork_m: float | None = None
    """Height of the fork, where it is one tree of two arms."""


def rejection(at: Floats, radius: float, layers: int, reason: str, frame: Upright) -> Rejection:
    """Return a dropped candidate in the input's frame; ``at`` in the upright frame."""
    x, y, z = (float(v) for v in frame.to_input(at))
    return Rejection(x, y, z, radius, layers, reason)


def join_forks(
    kept: list[Candidate], unsure: list[Arm], dropped: list[Stem], frame: Upright, ground: Ground
) -> tuple[list[Candidate], list[Rejection]]:
    """Make one tree of each pair of arms, and of each arm on a stem; arms above a stem that is a tree itself are dropped.

    ``unsure``: slices that no cylinder fits, but an arm may; ``dropped``: lines of all candidates that were no trunk.
    """
    gone: set[int] = set()
    joined: list[Rejection] = []
    merged: list[Candidate] = []
    arms = [Arm.of_cylinder(c.cylinder) for c in kept] + unsure
    for fork in find_forks(arms, len(kept), ground):
        if fork.first in gone or fork.second in gone:
            continue
        pair = [k for k in (fork.first, fork.second) if k < len(kept)]
        gone.update((fork.first, fork.second))
        stem = next((k for k, c in enumerate(kept) if k not in pair and _stands_below(c, fork)), None)
        for k in pair if stem is not None else pair[1:]:
            c = kept[k].cylinder
            reason = f"an arm of a tree that forks {fork.height_m:.1f} m above ground"
            joined.append(rejection(kept[k].base, c.radius_m, round((c.z_high_m - c.z_low_m) / 0.1), reason, frame))
        if stem is None:
            axis = arms[fork.first].axis + arms[fork.second].axis
            merged.append(_forked([kept[k] for k in pair], axis / np.linalg.norm(axis), fork, ground))
    alone, lonely = _on_stems([c for k, c in enumerate(kept) if k not in gone], dropped, frame, ground)
    return alone + merged, joined + lonely


def _on_stems(
    kept: list[Candidate], dropped: list[Stem], frame: Upright, ground: Ground
) -> tuple[list[Candidate], list[Rejection]]:
    """Make a forked tree of each arm whose stem, too short for a trunk, was dropped; its second arm there goes."""
    out: list[Candidate] = []
    gone: list[Rejection] = []
    taken: set[int] = set()
    for c in kept:
        found = find_stem(Arm.of_cylinder(c.cylinder), dropped)
        if found is None:
            out.append(c)
            continue
        index, z = found
        stem = dropped[index].line
        foot = stem.point(float(c.base[2]))
        base = np.array([foot[0], foot[1], ground.height_m(float(foot[0]), float(foot[1]))])
        height = max(z - float(base[2]), 0.0)
        if index in taken:
            layers = round((c.cylinder.z_high_m - c.cylinder.z_low_m) / 0.1)
            reason = f"an arm of a tree that forks {height:.1f} m above ground"
            gone.append(rejection(c.base, c.cylinder.radius_m, layers, reason, frame))
            continue
        taken.add(index)
        upright = replace(c.cylinder, axis=stem.axis)
        out.append(replace(c, cylinder=upright, base=base, fork_m=height, low_m=stem.z_low_m - float(base[2])))
    return out, gone


def _stands_below(candidate: Candidate, fork: Fork) -> bool:
    at = axis_at(candidate.cylinder, float(fork.at_m[2]))
    below = candidate.cylinder.z_high_m < fork.at_m[2] + 0.4
    return below and float(np.linalg.norm(at[:2] - fork.at_m[:2])) < candidate.cylinder.radius_m + 0.05


def _forked(arms: list[Candidate], axis: Floats, fork: Fork, ground: Ground) -> Candidate:
    """Return one tree of its arms: it stands below the fork, as thick as the thickest arm."""
    thick = max(arms, key=lambda c: c.cylinder.radius_m)
    base = np.array([fork.at_m[0], fork.at_m[1], ground.height_m(float(fork.at_m[0]), float(fork.at_m[1]))])
    return replace(
        thick, cylinder=replace(thick.cylinder, axis=axis), base=base, fork_m=max(fork.height_m, 0.0),
        low_m=min(c.low_m for c in arms), high_m=max(c.high_m for c in arms), top_m=max(c.top_m for c in arms),
    )  # fmt: skip
