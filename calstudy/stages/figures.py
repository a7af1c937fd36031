"""Stage `figure`: from products to pictures, with the arrays that they show."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from calstudy.figures.baselines import draw_baselines
from calstudy.figures.data import draw_data
from calstudy.figures.domains import in_two_domains
from calstudy.figures.gains import draw_gains
from calstudy.figures.layouts import LayoutPanel, draw_layouts
from calstudy.figures.model import draw_model
from calstudy.figures.reflections import draw_reflections
from calstudy.figures.save import figure_arrays, save_figure
from calstudy.figures.spherical import SphericalColumn, draw_spherical
from calstudy.figures.wedge import WedgePanels, draw_wedge
from calstudy.power.spherical import SphericalSpectrum
from calstudy.power.tables import load_spectrum
from calstudy.power.wedge import WedgeSpectrum
from calstudy.stages.inspection import inspect_baselines, inspect_data, inspect_gains, inspect_model
from calstudy.stages.registry import Job
from calstudy.stages.selection import layout_of, read_gains

SERIES = ("uncorrupted", "uncalibrated", "residual", "residual_without_eor", "eor", "noise")


def _layout(job: Job) -> tuple[Figure, Any]:
    layout = layout_of(job.settings)
    panel = LayoutPanel(title=layout.name, numbers=layout.numbers, enu=layout.enu)
    return draw_layouts([panel], stand_ins=job.settings["notes"]), panel


def _wedge(job: Job) -> tuple[Figure, Any]:
    folder = job.inputs["spectra"]
    names = [name for name in SERIES if name != "residual_without_eor"]
    panels = WedgePanels(**{name: load_spectrum(folder / f"{name}.wedge.h5", WedgeSpectrum) for name in names})
    return draw_wedge(panels, buffer=job.settings["wedge_buffer"], stand_ins=job.settings["notes"]), panels


def spherical_column(folder: Path, title: str, modes: str) -> SphericalColumn:
    """Read the spherical spectra of all series that a product of stage `spectra` has, over one choice of modes."""
    found = {name: folder / f"{name}.{modes}.h5" for name in SERIES}
    spectra = {name: load_spectrum(path, SphericalSpectrum) for name, path in found.items() if path.exists()}
    return SphericalColumn(title=title, **spectra)


def _excised(job: Job) -> SphericalColumn:
    title = f"outside wedge + {1e9 * job.settings['wedge_buffer']:.0f} ns"
    return spherical_column(job.inputs["spectra"], title, "outside-wedge")


def _spherical(job: Job) -> tuple[Figure, Any]:
    columns = {"all_modes": spherical_column(job.inputs["spectra"], "all modes", "all-modes"), "excised": _excised(job)}
    return draw_spherical(list(columns.values()), stand_ins=job.settings["notes"]), columns


def _spherical_excised(job: Job) -> tuple[Figure, Any]:
    column = _excised(job)
    return draw_spherical([column], stand_ins=job.settings["notes"]), {"excised": column}


def _gains(job: Job) -> tuple[Figure, Any]:
    comparison = inspect_gains(job)
    return draw_gains(comparison, stand_ins=job.settings["notes"]), comparison


def _model(job: Job) -> tuple[Figure, Any]:
    comparison = inspect_model(job)
    return draw_model(comparison, stand_ins=job.settings["notes"]), comparison


def _data(job: Job) -> tuple[Figure, Any]:
    comparison = inspect_data(job)
    return draw_data(comparison, stand_ins=job.settings["notes"]), comparison


def _baselines(job: Job) -> tuple[Figure, Any]:
    spectra = inspect_baselines(job)
    return draw_baselines(spectra, stand_ins=job.settings["notes"]), spectra


def _reflections(job: Job) -> tuple[Figure, Any]:
    gains = read_gains(job.inputs["gains"])
    shown = in_two_domains(gains.frequency, gains.values[0])
    return draw_reflections(shown, stand_ins=job.settings["notes"]), shown


FIGURES = {
    "layout": _layout,
    "gains": _gains,
    "model": _model,
    "data": _data,
    "baselines": _baselines,
    "wedge": _wedge,
    "spherical": _spherical,
    "spherical-excised": _spherical_excised,
    "reflections": _reflections,
}


def draw(job: Job) -> Mapping[str, Any]:
    """Write one figure as png and pdf, and its arrays as npz."""
    name = job.settings["figure"]
    figure, shown = FIGURES[name](job)
    save_figure(figure, figure_arrays(shown), job.output, name)
    return {}
