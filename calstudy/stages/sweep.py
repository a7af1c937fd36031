"""Stage `sweep`: the signal loss of all points of a sweep, as a table and a figure."""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from calstudy.experiment.sweep import short_names
from calstudy.power.tables import load_spectrum
from calstudy.power.transfer import TransferFunction, pool
from calstudy.stages.registry import Job
from calstudy.stages.signal_loss import BAND, REGIONS

SKIES = "sky.eor.seed"
"""The field whose values are further samples of the same thing, to be pooled."""
SUMMARY = (
    "point",
    "changes",
    "region",
    "k from [h/Mpc]",
    "k to [h/Mpc]",
    "transfer",
    "transfer error",
    "coherence",
    "coherence error",
    "retained",
    "retained error",
    "baselines or groups",
)


def summarize(job: Job) -> Mapping[str, Any]:
    """Write summary.csv, one row per point, region and band of k, and the figure of T against what was varied."""
    from calstudy.figures.save import figure_arrays, save_figure
    from calstudy.figures.sweep import draw_sweep

    blocks = job.settings["blocks"]
    _write_summary(job.output / "summary.csv", [point for block in blocks for point in block], job.inputs)
    panels = [_panel(block, job.inputs) for block in blocks]
    figure = draw_sweep(panels, stand_ins=job.settings["notes"])
    save_figure(figure, figure_arrays({"panels": panels}), job.output, "sweep")
    return {}


def _bands(folder: Path, region: str) -> TransferFunction:
    return load_spectrum(folder / f"{BAND}.{region}.h5", TransferFunction)


def _write_summary(path: Path, points: Sequence[Mapping[str, Any]], folders: Mapping[str, Path]) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(SUMMARY)
        for point in points:
            changes = "; ".join(f"{field} = {text}" for field, text in point["changes"].items())
            for region in REGIONS:
                found = _bands(folders[point["label"]], region)
                columns = (
                    found.bin_edges[:-1],
                    found.bin_edges[1:],
                    found.transfer,
                    found.transfer_error,
                    found.coherence,
                    found.coherence_error,
                    found.retained,
                    found.retained_error,
                    found.n_samples,
                )
                for row in zip(*(column.tolist() for column in columns), strict=True):
                    writer.writerow([point["label"], changes, region, *row])


def _panel(block: Sequence[Mapping[str, Any]], folders: Mapping[str, Path]) -> Any:
    """Return one block as a panel: a category per combination of what varies, EoR skies of one combination pooled."""
    from calstudy.figures.sweep import SweepPanel

    fields = list(block[0]["changes"])
    varied = [field for field in fields if len({point["changes"][field] for point in block}) > 1] or fields[:1]
    shown = [field for field in varied if field != SKIES] or varied
    groups: dict[tuple[str, ...], list[TransferFunction]] = {}
    for point in block:
        category = tuple(point["changes"][field] for field in shown)
        groups.setdefault(category, []).append(_bands(folders[point["label"]], "outside-wedge"))
    names = short_names(fields)
    fixed = [f"{names[field]} {block[0]['changes'][field]}" for field in fields if field not in varied]
    skies = max(len(found) for found in groups.values())
    return SweepPanel(
        field=", ".join(shown),
        note=", ".join(fixed + ([f"{skies} EoR skies"] if skies > 1 else [])),
        values=[", ".join(category) for category in groups],
        transfers=[pool(found) for found in groups.values()],
    )
