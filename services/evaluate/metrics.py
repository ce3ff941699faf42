"""metrics.json: what a run cost. Its numbers may differ between runs; nothing else may."""

from __future__ import annotations

import json
import platform
import resource
import sys
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from services.evaluate.offline import OfflineResult


def summary_ms(durations_ms: Sequence[float]) -> dict[str, float]:
    """Return median, 99th percentile, maximum and number of durations in milliseconds."""
    if not durations_ms:
        return {"median": 0.0, "p99": 0.0, "max": 0.0, "count": 0}
    median, p99 = np.percentile(durations_ms, [50, 99])
    return {
        "median": round(float(median), 3),
        "p99": round(float(p99), 3),
        "max": round(max(durations_ms), 3),
        "count": len(durations_ms),
    }


def peak_memory_mb() -> float:
    """Return this process's largest resident size so far, megabytes (10^6 bytes)."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return round(peak * (1 if sys.platform == "darwin" else 1024) / 1e6, 1)


def metrics(result: OfflineResult) -> dict[str, Any]:
    """Return counts, durations per stage and memory as plain values."""
    counts = result.counts
    return {
        "frames": counts.frames,
        "tracked_online": counts.tracked,
        "tracked_final": len(result.trajectory),
        "bad_frames": len(counts.skipped),
        "bad_frame_reasons": counts.skipped[:100],
        "trees": len(result.trees),
        "trees_suitable": sum(tree.suitable for tree in result.trees),
        "cloud_points": len(result.points_m),
        "targets_measured": sum(target.measured for target in result.targets),
        "setup_s": round(result.setup_s, 3),
        "duration_s": round(result.duration_s, 3),
        "ms": {name: summary_ms(durations) for name, durations in result.stage_ms.items()},
        "counters": result.counters,
        "peak_memory_mb": peak_memory_mb(),
        "machine": {"python": platform.python_version(), "system": platform.platform()},
    }


def metrics_bytes(values: Mapping[str, Any]) -> bytes:
    """Return metrics as the bytes of metrics.json."""
    return (json.dumps(values, indent=1, allow_nan=False) + "\n").encode()
