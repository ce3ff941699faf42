"""The slam bench's figures and tables from its rows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from services.evaluate.bench import BenchReport

Row = Mapping[str, Any]

_AXES = ("x", "y", "z", "rx", "ry", "rz")


def report(real: Sequence[Row], turns: Sequence[Row], faults: Sequence[Row]) -> BenchReport:
    """Return the report on all rows."""
    seeds = [row["turn"] for row in turns]
    return BenchReport(
        figures={**_real_figures(real), **_turn_figures(turns), **_fault_figures(faults), **_times(real, turns)},
        conditions={
            "real": "TUM RGB-D freiburg1, Kinect v1, every second frame; ATE after rigid alignment, median over the starts",
            "turns": f"simulated rise and 360 deg at 30 deg/s, 640x480 rendered at half size, s 0.08 px, seeds {seeds[0]}..{seeds[-1]}",
            "ATE of a turn": "final trajectory, aligned by positions; turn_ate_m the median scene's",
            "rotation": "of the published pose against the truth after the two were laid upon each other by their mean rotation "
            "(positions of a turn on the spot say nothing of the yaw); after the loop: frames from the loop's closing on; final: "
            "any frame of the final trajectory; first: final, laid upon each other at the first frame instead",
            "lean": "map's z against the true vertical at the end, accelerometer with a bias of 0.08 m/s^2 per axis",
            "NEES": "squared error over told variance of the published pose, mean over the frames, axes of the camera; worst and best dimension of the mean over the turns",
            "faults": "3 s of a turn, the fault, 2 s more; good: a pose within 1 s, and all poses after it within 5 cm of the truth (aligned "
            "before the fault); wrong: a pose more than 5 cm off was published during the fault",
            "time": "one thread, tracking and whatever mapping falls into a frame",
        },
        table="\n".join([*_real_table(real), *_turn_table(turns), *_fault_table(faults)]),
    )  # fmt: skip


def _real_figures(real: Sequence[Row]) -> dict[str, float]:
    names = list(dict.fromkeys(row["recording"] for row in real))
    out = {}
    for name in names:
        errors = [row["ate_m"] for row in real if row["recording"] == name]
        out[f"{name}_ate_m"] = round(float(np.median(errors)), 4)
        out[f"{name}_ate_worst_m"] = round(max(errors), 4)
    return out


def _turn_figures(turns: Sequence[Row]) -> dict[str, float]:
    column = {name: [row[name] for row in turns] for name in turns[0]}
    ratios = np.mean(column["nees"], axis=0)
    return {
        "turn_lost": sum(row["frames"] - row["tracked"] for row in turns),
        "turn_rot_deg_max": round(max(column["rot_after_loop_deg"]), 3),
        "turn_rot_final_deg_max": round(max(column["rot_final_deg"]), 3),
        "turn_rot_first_deg_max": round(max(column["rot_first_deg"]), 3),
        "turn_ate_m": round(float(np.median(column["ate_m"])), 4),
        "turn_ate_worst_m": round(max(column["ate_m"]), 4),
        "turn_no_loop": sum(row["loop_frame"] < 0 for row in turns),
        "lean_deg_median": round(float(np.median(column["tilt_deg"])), 3),
        "lean_deg_worst": round(max(column["tilt_deg"]), 3),
        "nees_least": round(float(ratios.min()), 2),
        "nees_most": round(float(ratios.max()), 2),
    }


def _fault_figures(faults: Sequence[Row]) -> dict[str, float]:
    names = list(dict.fromkeys(row["fault"] for row in faults))
    good = {name: sum(row["good"] for row in faults if row["fault"] == name) for name in names}
    return {
        "fault_cases": len(faults),
        "fault_good": sum(good.values()),
        "fault_good_least": min(good.values(), default=0),
    }


def _times(real: Sequence[Row], turns: Sequence[Row]) -> dict[str, float]:
    p50, p95 = np.percentile(np.concatenate([row["track_ms"] for row in (*real, *turns)]), [50, 95])
    return {"track_ms_p50": round(float(p50), 1), "track_ms_p95": round(float(p95), 1)}


def _real_table(real: Sequence[Row]) -> list[str]:
    head = [
        "| recording | from frame | tracked | ATE (cm) | ATE online (cm) | ms a frame |",
        "|---|---|---|---|---|---|",
    ]
    return [*head, *(
        f"| {r['recording']} | {r['offset']} | {r['tracked']}/{r['frames']} | {100 * r['ate_m']:.2f} | {100 * r['online_m']:.2f} "
        f"| {np.median(r['track_ms']):.0f} |"
        for r in real
    ), ""]  # fmt: skip


def _turn_table(turns: Sequence[Row]) -> list[str]:
    head = [
        "| turn, seed | tracked | ATE (cm) | online (cm) | rotation after the loop (deg) | final | from the first | lean (deg) | told "
        "| NEES " + " ".join(_AXES) + " | ms a frame |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    return [*head, *(
        f"| {r['turn']} | {r['tracked']}/{r['frames']} | {100 * r['ate_m']:.2f} | {100 * r['online_m']:.2f} "
        f"| {r['rot_after_loop_deg']:.2f} | {r['rot_final_deg']:.2f} | {r['rot_first_deg']:.2f} | {r['tilt_deg']:.2f} "
        f"| {r['up_sigma_deg']:.2f} | {' '.join(f'{v:.1f}' for v in r['nees'])} | {np.median(r['track_ms']):.0f} |"
        for r in turns
    ), ""]  # fmt: skip


def _fault_table(faults: Sequence[Row]) -> list[str]:
    if not faults:
        return []
    names = list(dict.fromkeys(row["fault"] for row in faults))
    rows = [
        "| fault | good | within 1 s | worst after, median case (cm) | wrong during | frames lost during, median |",
        "|---|---|---|---|---|---|",
    ]
    for name in names:
        group = [row for row in faults if row["fault"] == name]
        back = sum(row["recovered_s"] is not None and row["recovered_s"] <= 1.0 for row in group)
        worst = [row["worst_after_m"] for row in group if row["worst_after_m"] is not None]
        after = f"{100 * float(np.median(worst)):.1f}" if worst else "-"
        wrong = sum(row["worst_during_m"] > 0.05 for row in group)
        lost = float(np.median([row["lost"] for row in group]))
        rows.append(
            f"| {name} | {sum(r['good'] for r in group)}/{len(group)} | {back} | {after} | {wrong} | {lost:.0f} |"
        )
    return rows
