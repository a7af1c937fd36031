"""Figures of signal loss show the transfer functions that they are given, and say what is missing."""

import dataclasses

import numpy as np
import pytest

from calstudy.figures.signal_loss import SignalLoss, draw_expected_loss, draw_signal_loss
from calstudy.figures.sweep import SweepPanel, draw_sweep
from calstudy.plotting.style import figure_arrays
from calstudy.power.transfer import ExpectedBins, TransferFunction, TransferMap


def function(transfer: list[float], edges: list[float], error: float = 0.02) -> TransferFunction:
    limits, values = np.array(edges), np.array(transfer)
    errors = np.full(values.size, error)
    return TransferFunction(
        k=(limits[1:] + limits[:-1]) / 2,
        bin_edges=limits,
        transfer=values,
        transfer_error=errors,
        cross_transfer=values - 0.01,
        cross_transfer_error=errors,
        scale_free_transfer=values + 0.03,
        scale_free_transfer_error=errors,
        squared_coherence=values - 0.02,
        squared_coherence_error=errors,
        signal=np.ones(values.size),
        n_samples=np.full(values.size, 9),
        flux_scale=1.02,
    )


@pytest.fixture
def loss() -> SignalLoss:
    edges = [0.0, 0.1, 0.2, 0.3, 0.4]
    lower, delay = 4.0 * np.array([2, 3, 9]), np.arange(40) / 15e6
    length = lower + 2
    transfer = np.where(delay > length[:, None] / 3e8 + 150e-9, 0.9, 0.05)
    return SignalLoss(
        outside=function([np.nan, 0.3, 0.8, 0.9], edges),
        inside=function([0.1, 0.05, np.nan, np.nan], edges, error=np.nan),
        map=TransferMap(
            baseline_length=length,
            bin_edges=np.stack([lower, lower + 4], axis=1),
            k_perp=5.5e-4 * length,
            delay=delay,
            k_parallel=5.4e5 * delay,
            transfer=transfer,
            transfer_error=0.1 * transfer,
            cross_transfer=transfer,
            cross_transfer_error=0.1 * transfer,
            horizon_delay=length / 3e8,
        ),
    )


def bars(axes) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Positions and half-lengths of the error bars, by label."""
    return {
        container.get_label(): (
            container.lines[0].get_ydata(),
            np.array([np.ptp(segment[:, 1]) / 2 for segment in container.lines[2][0].get_segments()]),
        )
        for container in axes.containers
    }


def test_points_and_95_percent_bars_are_those_of_the_transfer_functions(loss):
    left = draw_signal_loss(loss).axes[0]
    values, halves = bars(left)["outside wedge + 100 ns"]
    assert values == pytest.approx([0.3, 0.8, 0.9])
    assert halves == pytest.approx(1.96 * 0.02 * np.ones(3))
    values, halves = bars(left)["inside wedge + 100 ns"]
    assert values == pytest.approx([0.1, 0.05])
    assert halves == pytest.approx([0, 0])


def test_published_arrays_keep_their_names(loss):
    arrays = figure_arrays(loss)
    assert np.array_equal(arrays["outside.coherence"], loss.outside.cross_transfer, equal_nan=True)
    assert np.array_equal(arrays["inside.retained_error"], loss.inside.squared_coherence_error, equal_nan=True)
    assert np.array_equal(arrays["map.coherence_error"], loss.map.cross_transfer_error, equal_nan=True)
    assert not any("squared" in name or "cross" in name for name in arrays)


def test_the_transfer_without_the_flux_scale_is_the_line_and_the_scale_is_in_the_legend(loss):
    figure = draw_signal_loss(loss)
    line = next(item for item in figure.axes[0].lines if "flux scale" in str(item.get_label()))
    assert line.get_ydata() == pytest.approx(loss.outside.scale_free_transfer, nan_ok=True)
    assert "1.020" in str(line.get_label())


def test_the_map_has_a_cell_per_bin_and_none_where_there_are_no_baselines(loss):
    figure = draw_signal_loss(loss)
    mesh = figure.axes[1].collections[0]
    cells = mesh.get_array()
    # Edges at 8, 12, 16, 36, 40 m: the third cell is a gap.
    assert cells.shape == (40, 4)
    assert np.ma.getmaskarray(cells)[:, 2].all()
    assert np.array_equal(cells[:, [0, 1, 3]].filled(np.nan).T, loss.map.transfer)
    assert mesh.norm.vmin == 0
    assert mesh.norm.vmax == 1


def test_axes_have_units(loss):
    figure = draw_signal_loss(loss)
    left, right = figure.axes[:2]
    assert "Mpc" in left.get_xlabel()
    # Of the part of the residual that the EoR makes, not of all of it.
    assert left.get_ylabel() == "$T = P^{D}/P^{S}$"
    assert "Mpc" in right.get_xlabel()


def test_points_per_length_are_free_of_the_flux_scale_as_are_the_expected_lines(loss):
    outside, found = loss.outside, loss.map
    expected = ExpectedBins(
        k=outside.k,
        bin_edges=outside.bin_edges,
        outside=outside.transfer,
        outside_error=outside.transfer_error,
        length_edges=found.bin_edges,
        delay=found.delay,
        by_length=1.02**2 * found.transfer,
    )
    right = draw_expected_loss(expected, outside, found).axes[1]
    assert "free of the flux scale" in right.get_title()
    lines = [line for line in right.lines if str(line.get_label()).startswith("$")]
    for row, (line, container) in enumerate(zip(lines, right.containers, strict=True)):
        points, _, (drawn,) = container.lines
        assert points.get_ydata() == pytest.approx(1.02**2 * found.transfer[row])
        assert line.get_ydata() == pytest.approx(points.get_ydata())
        halves = np.array([np.ptp(segment[:, 1]) / 2 for segment in drawn.get_segments()])
        assert halves == pytest.approx(1.96 * 1.02**2 * found.transfer_error[row], rel=1e-3)


def test_no_transfer_at_all_is_refused(loss):
    empty = dataclasses.replace(loss.outside, transfer=np.full(4, np.nan))
    with pytest.raises(ValueError, match="no bin of"):
        draw_signal_loss(SignalLoss(empty, empty, loss.map))


def panel(values: list[str], transfers: list[list[float]], note: str = "") -> SweepPanel:
    edges = [0.1, 0.2, 0.3]
    return SweepPanel("calibration.basis.buffer", note, values, [function(item, edges) for item in transfers])


def test_a_sweep_has_a_panel_per_field_with_its_values_below():
    first = panel(["0 ns", "50 ns"], [[0.5, 0.9], [0.2, 0.8]])
    figure = draw_sweep([first, panel(["a"], [[np.nan, 0.7]], note="three skies"), first])
    assert len(figure.axes) == 4
    assert not figure.axes[3].axison
    one, two = figure.axes[:2]
    assert [text.get_text() for text in one.get_xticklabels()] == ["0 ns", "50 ns"]
    assert one.get_xlabel() == "calibration.basis.buffer"
    assert two.get_title() == "three skies"
    drawn = [container.lines[0].get_ydata() for container in one.containers[:2]]
    assert drawn[0] == pytest.approx([0.5, 0.2])
    assert drawn[1] == pytest.approx([0.9, 0.8])
    assert two.containers[0].lines[0].get_ydata().size == 0
    labels = [text.get_text() for text in figure.legends[0].get_texts()]
    assert "0.1" in labels[0]
    assert "Mpc" in labels[1]
    assert labels[2] == "free of the flux scale $s$"
    assert [text.get_text() for text in one.texts] == ["$s$ = 1.020"] * 2
