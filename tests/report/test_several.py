"""Pages of several runs, from folders that are made up."""

import json

import numpy as np
import pytest

from calstudy.base.errors import InputError
from calstudy.power.spectra import SphericalSpectrum
from calstudy.power.tables import save_spectrum
from calstudy.power.transfer import TransferFunction
from calstudy.products.files import TRANSFER, spectrum_file
from calstudy.report.page import MOST, read_several, write_several

K, EDGES = np.array([0.15, 0.35, 0.7]), np.array([0.1, 0.2, 0.5, 0.9])


def run_folder(folder, power, seed=1, name="demo", transfer=None, eor=5.0):
    """A finished run with power spectra of EoR and residual, and T if it is given."""
    tables = folder / "tables"
    tables.mkdir(parents=True)
    (folder / "manifest.json").write_text(json.dumps({"name": name}))
    (folder / "experiment.yaml").write_text(f"name: {name}\nsky: {{seed: {seed}}}\n")
    one, count = np.ones(3), np.ones(3, int)
    for variant, value in (("eor", eor * one), ("residual", power)):
        spectrum = SphericalSpectrum(K, EDGES, value + 0j, count, count, count, count, 0.1 * one, 0.1 * one, True)
        save_spectrum(tables / spectrum_file(variant, "outside-wedge"), spectrum)
    if transfer is not None:
        pairs = [transfer, 0.01 * one] * 4
        save_spectrum(
            tables / spectrum_file(TRANSFER, "outside-wedge"), TransferFunction(K, EDGES, *pairs, one, count, 1.0)
        )
    return folder


def test_spectra_and_transfer_of_all_runs_are_in_one_chart(tmp_path):
    powers = [np.array([1.0, 2.0, 3.0]) * factor for factor in (1, 10, 100)]
    transfers = [np.array([0.4, 0.9, 0.95]), None, np.array([0.5, 0.8, 0.9])]
    folders = [
        run_folder(tmp_path / name, power, name=name, transfer=transfer)
        for name, power, transfer in zip("abc", powers, transfers, strict=True)
    ]
    spectra, transfer = read_several(folders).charts
    found = {one["label"]: one for one in spectra.data["series"]}
    # The EoR is drawn once.
    assert list(found) == ["residual, P^R, a", "EoR, P^S, a", "residual, P^R, b", "residual, P^R, c"]
    for name, power in zip("abc", powers, strict=True):
        np.testing.assert_allclose(found[f"residual, P^R, {name}"]["y"], power)
    assert len({one["colour"] for one in found.values()}) == 4
    assert [one["label"] for one in transfer.data["series"]] == ["a", "c"]
    # A run has the same colour in both charts.
    assert transfer.data["series"][1]["colour"] == found["residual, P^R, c"]["colour"]


def test_every_eor_is_drawn_that_differs(tmp_path):
    levels = {"a": 5.0, "b": 5.0, "c": 0.1}
    folders = [run_folder(tmp_path / name, K, name=name, eor=eor) for name, eor in levels.items()]
    (spectra,) = read_several(folders).charts
    found = {one["label"]: one["y"] for one in spectra.data["series"] if one["label"].startswith("EoR")}
    assert {name: values[0] for name, values in found.items()} == {"EoR, P^S, a": 5.0, "EoR, P^S, c": 0.1}


def test_fields_that_differ_in_any_run_are_listed_and_runs_of_one_name_have_those_of_their_folders(tmp_path):
    folders = [run_folder(tmp_path / f"run-{seed}", K, seed) for seed in (1, 3)]
    several = read_several(folders)
    assert several.names == ["run-1", "run-3"]
    assert several.differences.rows == [("sky.seed", "1", "3")]


def test_a_page_is_not_overwritten_and_has_a_limit(tmp_path):
    folders = [run_folder(tmp_path / name, K, name=name) for name in "ab"]
    page = write_several(folders, tmp_path / "page.html")
    with pytest.raises(InputError, match="exists"):
        write_several(folders, page)
    write_several(folders, page, overwrite=True)
    with pytest.raises(InputError, match=f"2 to {MOST}"):
        write_several(folders * 3, tmp_path / "other.html")
    with pytest.raises(InputError, match=r"a: the same run twice; a page of several runs compares different ones$"):
        write_several([*folders, tmp_path / "b" / ".." / "a"], tmp_path / "other.html")
