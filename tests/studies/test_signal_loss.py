"""Signal loss in the chain: what the gains must absorb, they do, and sweeps compare it."""

import csv
import io
import json
from pathlib import Path

import numpy as np
import pytest
import yaml
from observations import small_instrument
from rich.console import Console
from small_chain import ANTENNAS, VARIANTS, small
from tiny import load

from calstudy.base.errors import ExperimentError, InputError
from calstudy.base.gains import make_uvcal
from calstudy.experiment.files import dump, override, validate
from calstudy.instrument.telescope import make_template
from calstudy.power.tables import load_spectrum
from calstudy.power.transfer import TransferFunction, TransferMap, pool
from calstudy.products.files import GAINS, read_json
from calstudy.products.graph import Graph, required
from calstudy.products.signal_loss import SCALE, FluxScale, transfer
from calstudy.studies.kinds.experiment import ExperimentStudy
from calstudy.studies.kinds.sweep import Sweep
from calstudy.studies.load import load_study
from calstudy.studies.show import show_run
from calstudy.studies.study import Budget, Run, run_study

pytestmark = pytest.mark.chain

DRAWN = True


SWEEP = [
    {"calibration.basis.buffer": ["50 ns", "400 ns"], "sky.eor.seed": [2, 3]},
    {"corruption.eor_level": ["-50 dB"]},
]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("loss")


@pytest.fixture(scope="module")
def swept(folder) -> Run:
    return run_study(Sweep.of(validate({**small(folder), "sweep": SWEEP}, folder)), Budget(workers=1))


def table(result: Run, point: int, name: str, kind: type = TransferFunction):
    found = list(result.parts.values())[point - 1]
    return load_spectrum(found.folder / "tables" / f"{name}.h5", kind)


def test_far_from_the_wedge_gains_absorb_their_share_of_the_degrees_of_freedom(swept):
    """2 N - 1 real numbers of N (N - 1) per channel: the phase of all gains together has no effect."""
    expected = 1 - (2 * ANTENNAS - 1) / (ANTENNAS * (ANTENNAS - 1))
    found = pool([table(swept, point, "transfer-bands.outside-wedge") for point in (1, 2)])
    assert found.squared_coherence[-1] == pytest.approx(expected, abs=3 * found.squared_coherence_error[-1])
    assert found.squared_coherence_error[-1] < 0.05
    # The flux scale that the calibration chooses is right to ten percent.
    assert found.transfer[-1] / found.cross_transfer[-1] == pytest.approx(1, abs=0.1)


def test_inside_the_modelled_delays_nothing_is_left(swept):
    found = table(swept, 1, "transfer.wedge", TransferMap)
    modelled = found.delay <= np.maximum(found.horizon_delay, 100e-9)[:, None]
    assert np.mean(found.cross_transfer[modelled]) < 0.1
    assert np.mean(found.cross_transfer[found.delay > 900e-9 + 0 * found.cross_transfer]) > 0.4


def test_the_flux_scale_is_of_all_polarizations_and_of_no_flagged_gain(tmp_path):
    """Gains of yy are larger by 21 %; those of an antenna without data are flagged, and may be anything."""
    template = make_template(small_instrument(polarizations=["xx", "yy"]))
    gains = np.ones((template.telescope.Nants, template.Nfreqs, template.Ntimes, 2), complex)
    gains[..., 1], gains[3] = 1.1, 1e3
    flags = np.zeros(gains.shape, bool)
    flags[3] = True
    make_uvcal(template, gains, flags).write_calh5(tmp_path / GAINS)
    scales = []
    for polarizations in (1, 2):
        task = FluxScale("", taper="blackman-harris", polarizations=polarizations, even=tmp_path, odd=tmp_path)
        task.make(tmp_path)
        scales.append(read_json(tmp_path / SCALE)["flux_scale"])
    assert scales == pytest.approx([1, np.mean([1, 1.1**-4]) ** -0.5], rel=1e-9)


def test_two_polarizations_have_another_flux_scale_than_one(tmp_path):
    one, two = (
        required(transfer(Graph(validate(override(small(tmp_path), "instrument.polarizations", chosen), tmp_path))))
        for chosen in (["xx"], ["xx", "yy"])
    )
    assert "polarizations" not in one.scale.settings
    assert two.scale.settings["polarizations"] == 2


def test_a_larger_buffer_loses_more(swept):
    narrow, wide = (
        pool([table(swept, point, "transfer-bands.outside-wedge") for point in points]) for points in ((1, 2), (3, 4))
    )
    assert wide.transfer[2] < narrow.transfer[2] - 3 * narrow.transfer_error[2]


def test_the_loss_is_linear_in_the_signal(swept):
    usual, fainter = (table(swept, point, "transfer-bands.outside-wedge") for point in (1, 5))
    # Near the wedge, weakly constrained gains make the loss of so small an array depend on where the solver stopped.
    assert fainter.squared_coherence[-1] == pytest.approx(usual.squared_coherence[-1], abs=0.03)
    difference = np.abs(fainter.squared_coherence - usual.squared_coherence)[2:]
    assert (difference < 2 * usual.squared_coherence_error[2:]).all()


def test_the_corrected_residual_is_a_table(swept):
    path = next(iter(swept.parts.values())).folder / "tables" / "residual-corrected.outside-wedge.csv"
    with path.open() as file:
        rows = list(csv.DictReader(file))
    unit = "[mK2 h-3 Mpc3]"
    corrected = [row for row in rows if row[f"corrected {unit}"] != "nan"]
    assert corrected
    for row in corrected:
        ratio = float(row[f"residual {unit}"]) / float(row["transfer"])
        assert float(row[f"corrected {unit}"]) == pytest.approx(ratio)


def test_a_sweep_shares_what_its_points_have_in_common(swept):
    made = swept.made.tasks
    # Two EoR skies, one of foregrounds; the level and the buffer change neither.
    assert sum(task.stage.name == "simulate" for task in made) == 3
    assert len(swept.parts) == 5
    keys = [task.key for task in made]
    assert len(keys) == len(set(keys))


def test_a_sweep_leaves_a_summary_a_figure_and_a_folder_per_point(swept):
    folder = swept.folder
    names = [path.name for path in sorted((folder / "points").iterdir())]
    assert names == [
        "01-buffer=50ns-seed=2",
        "02-buffer=50ns-seed=3",
        "03-buffer=400ns-seed=2",
        "04-buffer=400ns-seed=3",
        "05-eor_level=-50dB",
    ]
    with (folder / "tables" / "summary.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert {row["point"] for row in rows} == set(names)
    assert len(rows) == 5 * 2 * 4
    first = table(swept, 1, "transfer-bands.outside-wedge")
    assert float(rows[3]["transfer"]) == pytest.approx(first.transfer[3])
    # A column for each field, also of points of other blocks, in SI units.
    fields = [(row["calibration.basis.buffer"], row["sky.eor.seed"], row["corruption.eor_level"]) for row in rows[::8]]
    assert [float(buffer) for buffer, *_ in fields[:4]] == pytest.approx([50e-9, 50e-9, 400e-9, 400e-9])
    assert [seed for _, seed, _ in fields[:4]] == ["2", "3", "2", "3"]
    assert fields[4][2] not in {level for *_, level in fields[:4]}
    outside = [row for row in rows if row["region"] == "outside-wedge"]
    assert all(float(row["bias error"]) > 0 for row in outside if float(row["k from [h/Mpc]"]) >= 0.2)
    assert {row["bias"] for row in rows if row["region"] == "inside-wedge"} == {""}
    # Above k = 0.5 h/Mpc the bands are those of the score.
    bands = json.loads((folder / "points" / names[0] / "tables" / "score.json").read_text())["bands"]
    assert [float(rows[3][name]) for name in ("bias", "bias error")] == pytest.approx(
        [bands[-1]["bias"], bands[-1]["bias_error"]]
    )
    assert all(sum(int(count.split()[0]) for count in row["solves"].split(", ")) == 8 for row in rows)
    manifest = json.loads((folder / "manifest.json").read_text())
    assert manifest["points"][2]["changes"] == {"calibration.basis.buffer": "400 ns", "sky.eor.seed": "2"}
    assert (folder / "points" / names[0] / "manifest.json").exists()
    again = load(folder / "points" / names[2] / "experiment.yaml")
    assert again.calibration.basis.buffer == pytest.approx(400e-9)
    assert again.sweep == ()


def test_the_figure_pools_skies_and_keeps_the_rest_apart(swept):
    with np.load(swept.folder / "figures" / "sweep.npz") as arrays:
        assert arrays["panels.0.values"].tolist() == ["50 ns", "400 ns"]
        assert arrays["panels.0.field"] == "calibration.basis.buffer"
        pooled = arrays["panels.0.transfers.0.transfer"]
        error = arrays["panels.0.transfers.0.transfer_error"]
    single = [table(swept, point, "transfer-bands.outside-wedge") for point in (1, 2)]
    between = sorted(item.transfer[3] for item in single)
    assert between[0] <= pooled[3] <= between[1]
    assert error[3] < min(item.transfer_error[3] for item in single)


def test_the_end_of_a_sweep_has_t_of_every_point(swept):
    text = io.StringIO()
    show_run(swept, Console(file=text, width=200))
    (line,) = [line for line in text.getvalue().splitlines() if "│ 03-buffer=400ns-seed=2" in line]
    found = table(swept, 3, "transfer-bands.outside-wedge")
    assert f" {found.scale_free_transfer[3]:.3f} ± {found.scale_free_transfer_error[3]:.3f} " in line


def test_a_second_sweep_makes_nothing(swept, folder):
    again = run_study(Sweep.of(validate({**small(folder), "sweep": SWEEP}, folder)), Budget(workers=1))
    assert again.made.tasks == ()
    assert again.folder == swept.folder


def test_the_same_sweep_reads_back_from_its_run_folder(swept):
    experiment = load(swept.folder / "experiment.yaml")
    assert {task.key for task in Sweep.of(experiment).targets} <= set(swept.made.products)
    resolved = swept.folder / "experiment.yaml"
    assert resolved.read_text() == dump(experiment)


@pytest.mark.parametrize("scale", [None, "small"])
def test_the_shipped_sweep_varies_what_the_paper_says_loss_depends_on(scale):
    family = Sweep.of(load(Path(__file__).parents[2] / "experiments" / "signalloss.yaml", scale))
    varied = {field for changes in family.points.values() for field in changes}
    assert varied >= {
        "calibration.basis.buffer",
        "instrument.channels.count",
        "instrument.channels",
        "instrument.layout.count",
        "calibration.calibrator",
        "sky.eor.seed",
        "corruption.eor_level",
    }


def faults_of(data: dict, folder) -> list[str]:
    with pytest.raises(ExperimentError) as caught:
        Sweep.of(validate(data, folder))
    return caught.value.faults


@pytest.mark.parametrize(
    ("sweep", "told"),
    [
        (
            {"calibration.basis.bufer": ["50 ns"]},
            "sweep (calibration.basis.bufer = 50 ns): calibration.basis.bufer: unknown key, did you mean 'buffer'?",
        ),
        (
            {"calibration.basis.buffer": ["50 ns", 3]},
            "sweep (calibration.basis.buffer = 3): calibration.basis.buffer: 3 has no unit",
        ),
        (
            {"instrument.channels.first": ["150 MHz", "1.5 GHz"], "sky.eor.seed": [2]},
            "sweep (instrument.channels.first = 1.5 GHz, sky.eor.seed = 2): instrument.channels: end at 1512.4 MHz",
        ),
        ({"calibration.basis.buffer": "50 ns"}, "sweep.0.calibration.basis.buffer: must be a list"),
        ({"calibration.basis.buffer": []}, "sweep.0.calibration.basis.buffer: must have at least 1 item(s), has 0"),
        ({"sky.eor.seed": [2, 2]}, "sweep.sky.eor.seed: names the value 2 twice"),
        (
            {"corruption.noise.factor": [1, 2], "corruption.noise": [{"kind": "times-eor", "factor": 5}]},
            "sweep (corruption.noise.factor = 2, corruption.noise = kind times-eor, factor 5): is the same experiment "
            "as (corruption.noise.factor = 1, corruption.noise = kind times-eor, factor 5); leave out one of them",
        ),
        ({"corruption.noise.factor": [1, 1.0]}, "sweep (corruption.noise.factor = 1.0): is the same experiment as"),
        ({"outputs.store": ["a"]}, "sweep.outputs.store: cannot be varied"),
        ({"claibration.chunks": [1]}, "sweep.claibration.chunks: cannot be varied, did you mean 'calibration'?"),
        ({"calibration.chunks.x": [1]}, "'chunks' is 1 and not a block of keys"),
        (3, "sweep = 3: must be a list"),
        ([3], "sweep.0 = 3: must be a block of keys"),
    ],
)
def test_a_fault_of_a_sweep_is_told_with_the_point_that_has_it(folder, sweep, told):
    assert any(told in fault for fault in faults_of({**small(folder), "sweep": sweep}, folder))


def test_all_faults_of_a_sweep_are_told_at_once(folder):
    sweep = {"instrument.channels.first": ["1.5 GHz", "1.6 GHz"]}
    assert len(faults_of({**small(folder), "sweep": sweep}, folder)) == 2


def test_what_the_calibrator_refuses_is_told_with_the_point_before_anything_is_made(folder):
    sweep = Sweep.of(validate({**small(folder), "sweep": {"calibration.basis.buffer": ["50 ns", "9 us"]}}, folder))
    with pytest.raises(InputError, match=r"^02-buffer=9us: calibration\.basis: a delay half-width of \d+ ns fills"):
        run_study(sweep, Budget(workers=1))
    assert not sweep.folder.exists()


def test_a_sweep_without_the_variants_to_measure_loss_is_refused(folder):
    data = {**small(folder), "sweep": SWEEP, "variants": {"eor": VARIANTS["eor"]}}
    data["outputs"]["figures"] = ["spherical"]
    assert "needs the variants residual, residual_without_eor, eor" in faults_of(data, folder)[0]


def test_variants_that_differ_in_more_than_the_eor_are_refused(folder):
    variants = {**VARIANTS, "residual_without_eor": {**VARIANTS["residual_without_eor"], "effects": False}}
    with pytest.raises(ExperimentError, match="which differ in the EoR alone"):
        validate({**small(folder), "variants": variants}, folder)


def test_no_loss_is_measured_without_the_variants_for_it(folder):
    data = small(folder, outputs__figures=["layout"])
    data["variants"] = {"eor": VARIANTS["eor"]}
    study = ExperimentStudy(validate(data, folder))
    assert transfer(study.graph) is None
    assert not any(task.stage.name == "transfer" for task in study.tasks)


def test_a_file_with_a_sweep_is_a_sweep_and_one_without_is_none(folder):
    for name, data, kind in (
        ("alone.yaml", small(folder), ExperimentStudy),
        ("sweep.yaml", {**small(folder), "sweep": SWEEP}, Sweep),
    ):
        (folder / name).write_text(yaml.safe_dump(data))
        assert isinstance(load_study(folder / name), kind)
    with pytest.raises(InputError, match="has no sweep"):
        Sweep.of(validate(small(folder), folder))


def test_blocks_as_values_vary_fields_together(folder):
    sweep = {"instrument.channels": [{"first": "170 MHz", "width": "200 kHz", "count": 64}]}
    family = Sweep.of(validate({**small(folder), "sweep": sweep}, folder))
    ((label, changes),) = family.points.items()
    assert family.members[label].instrument.channels.count == 64
    assert changes == {"instrument.channels": "first 170 MHz, width 200 kHz, count 64"}
    assert label == "01-channels=first170MHzwidth200kHzcount64"


def test_blocks_may_have_a_point_in_common(folder):
    sweep = [{"sky.eor.seed": [2, 12]}, {"corruption.noise.factor": [2, 3]}]
    family = Sweep.of(validate({**small(folder), "sweep": sweep}, folder))
    first, third = (family.members[list(family.points)[place]] for place in (0, 2))
    assert (first.sky.eor.seed, first.corruption) == (third.sky.eor.seed, third.corruption)


def test_files_of_points_are_found_beside_the_file_and_by_the_file_in_the_run_folder(tmp_path, monkeypatch):
    (tmp_path / "beside").mkdir()
    for name, step in (("one", 14), ("two", 20)):
        rows = "".join(f"{number},{step * number},{number**2},0\n" for number in range(5))
        (tmp_path / "beside" / f"{name}.csv").write_text(f"number,east_m,north_m,up_m\n{rows}")
    data = small(tmp_path, instrument__layout={"kind": "csv", "path": "beside/one.csv"}, instrument__location="mwa")
    sweep = {"instrument.layout.path": ["beside/one.csv", "beside/two.csv"]}
    (tmp_path / "sweep.yaml").write_text(yaml.safe_dump({**data, "sweep": sweep}))
    monkeypatch.chdir("/")
    study = load_study(tmp_path / "sweep.yaml")
    assert [experiment.instrument.layout.path.name for experiment in study.members.values()] == ["one.csv", "two.csv"]
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "experiment.yaml").write_text(study.texts["experiment.yaml"])
    again = load_study(tmp_path / "run" / "experiment.yaml")
    assert (again.folder.name, list(again.members)) == (study.folder.name, list(study.members))
    assert [task.key for task in again.targets] == [task.key for task in study.targets]
