"""Calibrators in worlds side by side: the scores of all cases, and the table of them."""

from __future__ import annotations

import itertools
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from calstudy.base.files import json_number
from calstudy.base.resources import COMPLEX128, LIBRARIES_MEMORY, Cost
from calstudy.base.table import Table, number
from calstudy.power.score import BANDS, HEADLINE_BAND, SPECTRA, CalibratedSpectra, Score, difference
from calstudy.power.tables import load_spectrum
from calstudy.products.calibration import in_words
from calstudy.products.files import COMPARISON, SCORE, SCORE_BANDS, SCORE_BINS, read_json
from calstudy.products.graph import size_of
from calstudy.products.signal_loss import read_calibrated
from calstudy.products.tolerances import COUNTS, faults, tolerance
from calstudy.run.task import Inputs, Task
from calstudy.verdicts.standing import (
    LIMIT,
    advice,
    is_measured,
    marked,
    settled,
    standing_table,
    standings,
    upper_limit,
)

CSV, MARKDOWN = "comparison.csv", "comparison.md"
QUANTITIES = {"transfer": "T", "bias": "bias", "recovered": "P^R / P^S"}
"""What is compared in bands of k, and how it is headed."""
NOTE = (
    "T is the part of the EoR's power that is left, the bias the power of the residual without EoR over that of the "
    "EoR, both free of the flux scale s, outside the wedge, k in h/Mpc, one standard deviation. All numbers are in "
    "comparison.md and comparison.csv."
)


@dataclass(frozen=True)
class Case:
    """One calibrator in one world: scores in the experiment's bins of k and in wide bands, and all of score.json."""

    bins: Score
    bands: Score
    summary: Mapping[str, Any]

    @property
    def converged(self) -> float:
        """Fraction of its solves that ended at a solution."""
        solves = self.summary["by_status"]
        return settled(solves) / max(1, sum(solves.values()))


def case_name(world: int, calibrator: int) -> str:
    """Return the name of a case among the inputs of a task, from the places of world and calibrator."""
    return f"{world:03d}:{calibrator:03d}"


def comparison(title: str, labels: Mapping[str, Any], scores: Mapping[str, Any], notes: Sequence[str]) -> Task:
    """Return the task of the table, of scores by `case_name`; the notes name what stands in for papers' ingredients.

    Labels are ``calibrators`` and ``worlds`` in order, ``fields`` that each world changes with their values, and
    ``refusals``: world, calibrator and why it cannot work there.
    """
    powers = {f"{case}:{name}": task.inputs[name] for case, task in scores.items() for name in SPECTRA}
    # All cases are measured alike.
    buffer = max((task.power.wedge_buffer for task in scores.values()), default=0.0)
    inputs = {**scores, **powers}
    return Comparison("comparison", title=title, **labels, notes=list(notes), wedge_buffer=buffer, cases=inputs)


def read_cases(
    calibrators: Sequence[str], worlds: Sequence[str], folders: Mapping[str, Path]
) -> dict[str, dict[str, Case]]:
    """Return the cases by the labels of world and calibrator, in the order of the file; none if refused."""
    return {
        world: {
            calibrator: _read(folders[case_name(row, column)])
            for column, calibrator in enumerate(calibrators)
            if case_name(row, column) in folders
        }
        for row, world in enumerate(worlds)
    }


def _read(folder: Path) -> Case:
    bins, bands = (load_spectrum(folder / name, Score) for name in (SCORE_BINS, SCORE_BANDS))
    return Case(bins, bands, read_json(folder / SCORE))


def best(found: Mapping[str, Case], band: int) -> str | None:
    """Return the best calibrator of a world in a band of k, or None if nothing is known there.

    It has the largest T of those whose bias is below the EoR with two standard deviations; if all are above, the
    smallest upper limit of the bias. Those whose T is not measured are left out.
    """
    limits = {
        name: upper_limit(float(case.bands.bias[band]), float(case.bands.bias_error[band]))
        for name, case in found.items()
        if is_measured(float(case.bands.transfer[band]), float(case.bands.transfer_error[band]))
    }
    known = {name: limit for name, limit in limits.items() if np.isfinite(limit)}
    below = [name for name, limit in known.items() if limit < COUNTS]
    if below:
        return max(below, key=lambda name: float(found[name].bands.transfer[band]))
    return min(known, key=lambda name: known[name], default=None)


class Comparison(Task, stage="comparison", version=12):
    """The scores of all cases, of which some are refused: world, calibrator and why it cannot work there."""

    title: str
    calibrators: Sequence[str]
    worlds: Sequence[str]
    fields: Mapping[str, Mapping[str, Any]]
    refusals: Sequence[Sequence[str]]
    notes: Sequence[str]
    wedge_buffer: float
    cases: Inputs

    def make(self, output: Path) -> Mapping[str, Any]:
        """Write comparison.csv, comparison.json and comparison.md."""
        cases = read_cases(self.calibrators, self.worlds, self.cases)
        less = {world: self.differences(world, found) for world, found in cases.items()}
        Table.of_records(list(_csv_rows(cases, self.fields))).write_csv(output / CSV)
        summaries = {
            world: {name: {**case.summary, "differences": less[world][name]} for name, case in found.items()}
            for world, found in cases.items()
        }
        text = json.dumps(summaries, indent=1, ensure_ascii=False, allow_nan=False)
        (output / COMPARISON).write_text(text + "\n", encoding="utf-8")
        (output / MARKDOWN).write_text(_markdown(self, cases, less, summaries), encoding="utf-8")
        return {}

    def shown(self, folder: Path) -> Sequence[Table]:
        """Return the scores of all calibrators, a table for each world."""
        found = {world: cases for world, cases in read_json(folder / COMPARISON).items() if cases}
        return [replace(score_table(cases), title=f"Scores: {world}", note=NOTE) for world, cases in found.items()]

    def differences(self, world: str, found: Mapping[str, Case]) -> dict[str, list[dict[str, Any]]]:
        """Return T and bias of every calibrator less those of the best in each band, with paired errors.

        Both are of the same sky, gains and noise, and the error is that of leaving out the same antennas in both. By
        calibrator of the cases `found` in a world, there is for each band what ``best`` is called, and ``transfer``
        and ``bias`` with errors; None if not known.
        """
        row = self.worlds.index(world)
        names = {name: case_name(row, place) for place, name in enumerate(self.calibrators) if name in found}
        scales = {name: float(case.bands.flux_scale) for name, case in found.items()}
        leaders = [best(found, band) for band in range(len(BANDS) - 1)]
        result: dict[str, list[dict[str, Any]]] = {
            name: [{"k": list(BANDS[band : band + 2]), "best": leader} for band, leader in enumerate(leaders)]
            for name in found
        }
        for leader in dict.fromkeys(name for name in leaders if name is not None):
            reference = self._spectra(names[leader])
            for name, bands in result.items():
                pair = (reference if name == leader else self._spectra(names[name]), reference)
                less = difference(pair, BANDS, self.wedge_buffer, (scales[name], scales[leader]))
                for band, entry in enumerate(bands):
                    if entry["best"] == leader:
                        entry |= {key: json_number(values[band]) for key, values in less.items()}
        return result

    def _spectra(self, case: str) -> CalibratedSpectra:
        return read_calibrated({name: self.cases[f"{case}:{name}"] for name in SPECTRA})

    def _cost(self) -> Cost:
        cases = len(self.worlds) * len(self.calibrators)
        size = size_of(self)
        # Spectra of two cases, and what their units owe to two antennas each.
        held = 2 * len(SPECTRA) * 3 * size.baselines * size.channels.count * COMPLEX128
        return Cost(2 + cases * (0.1 + held * 2e-9), LIBRARIES_MEMORY + held, 1e6)


def _csv_rows(
    cases: Mapping[str, Mapping[str, Case]], fields: Mapping[str, Mapping[str, Any]]
) -> Iterator[dict[str, Any]]:
    changed = dict.fromkeys(field for values in fields.values() for field in values)
    for world, found in cases.items():
        for name, case in found.items():
            summary = case.summary
            for band in summary["bands"]:
                yield {
                    "world": world,
                    "calibrator": name,
                    **changed,
                    **fields[world],
                    "k from [h/Mpc]": band["k"][0],
                    "k to [h/Mpc]": band["k"][1],
                    **{key.replace("_", " "): value for key, value in band.items() if key != "k"},
                    "flux scale": summary["flux_scale"],
                    "sky model error": summary["sky_model_error"],
                    "gain error aligned": summary["gain_error_aligned"],
                    "gain error as fitted": summary["gain_error_as_fitted"],
                    "chi squared of held-out data": summary["held_out_chi_squared"],
                    "solves": in_words(summary["by_status"]),
                    "CPU seconds per integration": summary["cpu_seconds_per_integration"],
                    "peak memory [bytes]": summary["peak_memory"],
                }


def _markdown(
    task: Comparison,
    cases: Mapping[str, Mapping[str, Case]],
    less: Mapping[str, Mapping[str, Sequence[Mapping[str, Any]]]],
    summaries: Mapping[str, Mapping[str, Mapping[str, Any]]],
) -> str:
    standing = standings(summaries, [(world, name, why) for world, name, why in task.refusals])
    answer = standing_table(standing)
    lines = [
        f"# Calibrators compared: {task.title}",
        "",
        f"## {answer.title}",
        "",
        *(f"- {sentence}" for sentence in advice(standing)),
        "",
        answer.markdown(numbers=False),
        answer.note,
        "",
        "## Scores",
        "",
        "T is the part of the EoR's power that is left, and the bias the power of the residual without EoR over that "
        "of the EoR, both free of the flux scale s, outside the wedge, in bands of k in h/Mpc, with one standard "
        "deviation. Where T differs from them by more than its error, it has beside it C, the coefficient of the "
        "regression of the response on the EoR, which equals T at the minimum of a fit of free foregrounds and is "
        "larger with a finite prior, and *linear*, T of the linear response of the fit of the first polarization. "
        "The gain error is the median over antennas and integrations of the rms over channels, free of what no fit "
        "can know, and as fitted. χ² is per sample of data that were not fitted, in units of the noise. The "
        "processor time of an integration, all polarizations and threads together, is the median over solves, so "
        "that compilation in the first does not decide. The memory is the largest resident memory of the process "
        "that solved, libraries and what earlier work left included: an upper bound, but for programs that a "
        "calibrator starts (DP3), which are not in it.",
        "",
        "Calibrators see the same sky, gains and noise, so that a difference of two is known better than either: the "
        "errors of differences are found by leaving out the same antennas in both. The best in a band has the largest "
        "T of those with |bias| + 2σ below the EoR; if none is, the smallest |bias| + 2σ.",
        "",
        *(f"Stand-in: {note}." for note in task.notes),
        *([""] if task.notes else []),
    ]
    lines += _tolerances(cases, task.calibrators)
    for world, found in cases.items():
        lines += [f"### {world}", ""]
        if found:
            summaries = {name: case.summary for name, case in found.items()}
            lines += [_sky_models(found), "", score_table(summaries).markdown()]
        if len(found) > 1:
            lines += ["Less the best of each band:", "", _difference_table(less[world]).markdown()]
        refused = [(name, why) for place, name, why in task.refusals if place == world]
        lines += [f"- {name} cannot work here: {why}" for name, why in refused] + ([""] if refused else [])
    return "\n".join(lines).rstrip() + "\n"


def _tolerances(cases: Mapping[str, Mapping[str, Case]], calibrators: Sequence[str]) -> list[str]:
    """Return the severity of every fault at which the bias of each calibrator reaches the limit, as Markdown."""
    rows = []
    for fault in faults(list(cases)):
        cells = []
        for calibrator in calibrators:
            there = [place for place, world in enumerate(fault.worlds) if calibrator in cases[world]]
            bands = [cases[fault.worlds[place]][calibrator].bands for place in there]
            if not bands:
                cells.append("-")
                continue
            band = int(np.argmin(np.abs(bands[0].bin_edges[:-1] - HEADLINE_BAND[0])))
            bias, error = (np.array([getattr(item, name)[band] for item in bands]) for name in ("bias", "bias_error"))
            found = tolerance([fault.severities[place] for place in there], bias, error)
            known = "" if found.relation == "=" else f"{found.relation} "
            # Two digits, and powers of ten for what is not between 0.0001 and a million alone.
            severity = f"{float(f'{found.severity:.2g}'):g}"
            cells.append("noise" if found.relation == "?" else f"{known}{severity} {fault.unit}".strip())
        rows.append((fault.name, *cells))
    if not rows:
        return []
    low, high = HEADLINE_BAND
    sentence = (
        f"Severity of each fault at which the bias reaches {LIMIT:g} of the EoR at k from {low:g} to {high:g} h/Mpc. "
        "Between two severities it is taken for a power law, from the upper limit where the bias of the lower one is "
        "not seen, so that it may be smaller than it is; `noise`: it cannot be told from the noise."
    )
    return ["## Tolerances", "", sentence, "", Table(("fault", *calibrators), rows).markdown()]


def _sky_models(found: Mapping[str, Case]) -> str:
    """Say in a sentence how wrong the sky models of a world are, which are the same for all calibrators as a rule."""
    errors = {case.summary["sky_model_error"] for case in found.values()}
    if errors == {0.0}:
        return "The sky model is the truth."
    known = [f"{100 * error:.2g} %" for error in sorted(error for error in errors if error is not None)]
    return f"Error of the sky model, rms over that of the foregrounds: {', '.join(known) or 'not known'}."


def score_table(found: Mapping[str, Mapping[str, Any]]) -> Table:
    """Return the scores of one world, contents of score.json by calibrator, as a table with a row for each."""
    rows = []
    for name, summary in found.items():
        seconds, memory = _cost_cells(summary)
        rows.append(
            {
                "calibrator": name,
                **{_heading("transfer", band): _transfer_cell(band) for band in summary["bands"]},
                **{_heading("bias", band): _cell(band["bias"], band["bias_error"]) for band in summary["bands"]},
                "s": _cell(summary["flux_scale"], decimals=4),
                "gain error": _percent(summary["gain_error_aligned"]),
                "as fitted": _percent(summary["gain_error_as_fitted"]),
                "χ²": _cell(summary["held_out_chi_squared"], decimals=3),
                "solves": in_words(summary["by_status"]),
                "CPU s per integration": seconds,
                "memory": memory,
            }
        )
    return Table.of_records(rows)


def _heading(name: str, band: Mapping[str, Any]) -> str:
    return f"{QUANTITIES[name]}, {band['k'][0]:g} to {band['k'][1]:g}"


def _transfer_cell(band: Mapping[str, Any]) -> str:
    """Write T, and of C and the linear response those that differ from it by more than its error."""
    transfer, error = band["transfer"], band["transfer_error"]
    cell = _cell(transfer, error)
    if transfer is None or error is None or not is_measured(transfer, error):
        return cell if transfer is None else marked(cell, transfer, error)
    others = {"C": band.get("cross_transfer"), "linear": band.get("linear_transfer")}
    differ = [
        f"{name} {value:.2f}" for name, value in others.items() if value is not None and abs(transfer - value) > error
    ]
    return f"{cell} ({', '.join(differ)})" if differ else cell


def _difference_table(less: Mapping[str, Sequence[Mapping[str, Any]]]) -> Table:
    """Return differences from the best calibrator as a table, a row for each calibrator."""
    rows = []
    for name, found in less.items():
        row = {"calibrator": name}
        for key, band in itertools.product(("transfer", "bias"), found):
            cell = "best" if band["best"] == name else _cell(band.get(key), band.get(f"{key}_error"))
            row[f"Δ{_heading(key, band)}"] = cell
        rows.append(row)
    return Table.of_records(rows)


def _cost_cells(summary: Mapping[str, Any]) -> tuple[str, str]:
    """Return processor seconds and memory; of gains from files nobody knows what they took."""
    # Scores of earlier versions have wall time under another name, which is not comparable.
    seconds, memory = summary.get("cpu_seconds_per_integration"), summary["peak_memory"]
    return "-" if seconds is None else f"{seconds:.2g}", "-" if memory is None else f"{memory / 1e9:.1f} GB"


def _cell(value: float | None, error: float | None = None, decimals: int | None = None) -> str:
    if value is None:
        return "-"
    return number(value, error) if decimals is None else f"{value:.{decimals}f}" if abs(value) < 1e4 else f"{value:.2e}"


def _percent(value: float | None) -> str:
    return "-" if value is None else f"{100 * value:.2g} %"
