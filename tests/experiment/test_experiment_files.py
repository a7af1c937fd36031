"""Experiment files: what is read is what was written, and every fault is told in the file's own terms."""

from pathlib import Path

import pytest
import yaml
from tiny import load

from calstudy.base.errors import ExperimentError, InputError
from calstudy.experiment.files import (
    apply_scale,
    dump,
    dump_yaml,
    override,
    parse_override,
    parse_yaml,
    read_mapping,
    validate,
)
from calstudy.experiment.model import Experiment
from calstudy.studies.kinds.collection import Collection
from calstudy.studies.load import load_study
from calstudy.studies.preflight import require_calibration
from calstudy.studies.study import Study

EXPERIMENTS = Path(__file__).parents[2] / "experiments"
HERE = Path(__file__).parent
# Steps of the validation ladder are no experiments; tests/validation loads them.
FILES = sorted(path for path in EXPERIMENTS.rglob("*.yaml") if path.parent.name != "validation")
SINGLE = [path for path in FILES if not {"experiments", "calibrators", "runtime", "observed"} & set(read_mapping(path))]


def faults_of(text: str) -> list[str]:
    with pytest.raises(InputError) as caught:
        validate(yaml.safe_load(text), HERE)
    return str(caught.value).splitlines()


def scales_of(study: Study) -> set[str]:
    """Return the names of the scales of a file, or of all members of a collection."""
    if isinstance(study, Collection):
        return set.intersection(*(set(experiment.scales) for experiment in study.members.values()))
    return set(study.file.scales)


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_shipped_files_are_valid_at_every_scale(path):
    study = load_study(path)
    for scale in scales_of(study):
        assert load_study(path, scale).name == study.name


def test_the_defaults_are_the_papers_numbers():
    experiment = Experiment(name="defaults")
    channels, times = experiment.instrument.channels, experiment.instrument.times
    assert (channels.count, channels.width, channels.first) == (384, 80e3, 167.075e6)
    assert (times.count, times.integration, times.start_lst) == (56, 2.0, 1.8)
    assert experiment.sky.eor.amplitude == 12482.356
    assert experiment.corruption.eor_level == -40
    assert experiment.corruption.noise.factor == 10
    assert [effect.sigma for effect in experiment.corruption.effects] == [0.1]
    assert experiment.power.wedge_buffer == 1e-7


@pytest.mark.parametrize("path", SINGLE, ids=lambda path: path.stem)
def test_the_resolved_file_reads_back_to_the_same_experiment(path, tmp_path):
    resolved = tmp_path / "resolved.yaml"
    experiment = load(path)
    resolved.write_text(dump(experiment))
    assert load(resolved) == experiment


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("{name: a, calibratoin: {}}", "calibratoin: unknown key, did you mean 'calibration'?"),
        (
            "{name: a, calibration: {basis: {bufer: 1 ns}}}",
            "calibration.basis.bufer: unknown key, did you mean 'buffer'?",
        ),
        ("{name: a, instrument: {channels: {first: 167}}}", "instrument.channels.first: 167 has no unit"),
        (
            "{name: a, instrument: {channels: {width: -80 kHz}}}",
            "instrument.channels.width = '-80 kHz': must be at least 100 Hz",
        ),
        ("{name: a, instrument: {layout: hexa}}", "instrument.layout: 'hexa' is not a layout, did you mean 'hex'?"),
        (
            "{name: a, instrument: {layout: {kind: hex, side: '3'}}}",
            "instrument.layout.side = '3': must be a whole number",
        ),
        ("{name: a, instrument: {times: {count: 2.5}}}", "instrument.times.count = 2.5: must be a whole number"),
        ("{name: a, instrument: {polarizations: []}}", "instrument.polarizations: must have at least 1 item(s), has 0"),
        ("{name: a, sky: {eor: {nside: 100}}}", "sky.eor.nside = 100: not a choice (allowed: 16, 32, 64, 128, 256)"),
        ("{name: a, sky: 3}", "sky = 3: must be a block of keys"),
        ("{name: a, variants: {v: {components: [fog]}}}", "variants.v.components.0 = 'fog': not a choice"),
        ("{name: a, variants: {a/b: {components: [eor]}}}", "variants.a/b: is not a usable name"),
        ("{name: a, corruption: {noise: {seeds: [3, 3]}}}", "corruption.noise.seeds: of even and odd are both 3"),
        ("{name: a, corruption: {noise: {seeds: [-1, 3]}}}", "corruption.noise.seeds.0 = -1: must be at least 0"),
        ("{name: a, corruption: {eor_level: 4000 dB}}", "corruption.eor_level: '4000 dB' is beyond 200 dB either way"),
        ("{name: a, instrument: {polarizations: [xx, xx]}}", "polarizations: names a polarization twice"),
        ("{name: a, instrument: {channels: {first: 1.5 GHz}}}", "instrument.channels: end at 1530.64 MHz, above the"),
        (
            "{name: a, outputs: {store: ~nobody-here/x}}",
            "outputs.store = '~nobody-here/x': there is no such",
        ),
        (
            "{name: a, sky: {diffuse: {kind: synthetic, seed: 2}, eor: {spectrum: power-law, seed: 2}}}",
            "sky.diffuse.seed: is 2, as that of sky.eor: give one of them another",
        ),
        ("{name: a, corruption: {noise: none}}", "asks for noise, but corruption.noise is 'none'"),
        (
            "{name: a, corruption: {effects: [{kind: per-channel-gains, sigma: .nan}]}}",
            "corruption.effects.0.sigma = nan: must be a finite number",
        ),
        (
            "{name: a, sky: {foregrounds: {kind: file, path: no.skyh5}}}",
            "sky.foregrounds.path = 'no.skyh5': no such file",
        ),
        ("{name: a, sky: {foregrounds: file}}", "sky.foregrounds.path: missing, and it has no default"),
        (
            "{name: a, outputs: {inspect: {antennas: [0, 40]}}}",
            "outputs.inspect: names antenna 40, but the layout has 36",
        ),
        ("{name: a, outputs: {inspect: {antennas: [1, 1]}}}", "outputs.inspect: names an antenna twice in a pair"),
        ("{name: a, outputs: {inspect: {baselines: [[0, -1]]}}}", "must be at least 0"),
        ("{name: a, outputs: {inspect: {integration: 56}}}", "outputs.inspect.integration: 56 is not among the 56"),
        ("{name: a, outputs: {figures: [gain]}}", "outputs.figures.0: 'gain' is not a figure, did you mean 'gains'?"),
        (
            "{name: a, outputs: {figures: [gains]}, variants: {eor: {components: [eor]}, residual: {components: "
            "[foregrounds]}}}",
            "outputs.figures: asks for 'gains', which needs variants.residual to have foregrounds, effects: true and",
        ),
        ("{}", "name: missing, and it has no default"),
        ("{name: a, corruption: {noise: {factor: 1.0e+300}}}", "corruption.noise.factor = 1e+300: must be at most"),
        ("{name: a b}", "name: 'a b' cannot name a folder"),
        (
            "{name: a, calibration: {solver: {max_steps: 0}, basis: {bufer: 3}}}",
            "calibration.solver.max_steps = 0: must be at least 1",
        ),
        (
            "{name: a, calibration: {calibrator: sky-based, basis: {buffer: 10 ns}}}",
            "calibration.basis: 'sky-based' has no such key, but calamity, calamity-redundant, delay-weighted, ",
        ),
        (
            "{name: a, instrument: {layout: {kind: hex, side: 3, spacing: 14 m, count: 16}}}",
            "instrument.layout.count: 'hex' has no such key, but golomb,",
        ),
    ],
)
def test_a_fault_names_path_value_and_what_is_allowed(text, told):
    assert any(sentence.startswith(told) or told in sentence for sentence in faults_of(text)), faults_of(text)


@pytest.mark.parametrize(
    ("calibration", "told"),
    [
        ({"basis": {"buffer": "10 us"}}, "calibration.basis: a delay half-width of 1[0-9]+ ns fills all 384 channels"),
        ({"autos": True}, "calibration.autos: is true, but the data hold no autocorrelations"),
    ],
)
def test_what_the_calibrator_refuses_is_told_before_anything_is_made(calibration, told):
    experiment = validate({"name": "a", "calibration": calibration}, HERE)
    with pytest.raises(InputError, match=told):
        require_calibration(experiment)


def test_all_faults_are_told_at_once():
    told = faults_of("{name: a, bogus: 1, sky: {eor: {nside: 3}}, power: {taper: square}}")
    assert [sentence.split()[0].rstrip(":") for sentence in told] == ["sky.eor.nside", "power.taper", "bogus"]


def test_overrides_reach_into_blocks_written_as_a_word():
    data = override({"instrument": {"beam": "airy"}}, "instrument.beam.diameter", "5 m")
    assert data == {"instrument": {"beam": {"kind": "airy", "diameter": "5 m"}}}
    assert override({}, "a.b", 1) == {"a": {"b": 1}}


def test_overrides_leave_the_original_alone():
    data = {"a": {"b": 1}}
    override(data, "a.b", 2)
    assert data == {"a": {"b": 1}}


def test_override_values_are_yaml():
    assert parse_override("a.b=[1, 2]") == ("a.b", [1, 2])
    assert parse_override("a=1e-9") == ("a", 1e-9)
    assert parse_override("a=80 kHz") == ("a", "80 kHz")
    with pytest.raises(InputError, match="write a dotted path and a value"):
        parse_override("a.b")


@pytest.mark.parametrize("in_line", [False, True])
def test_texts_that_look_like_numbers_stay_texts(in_line):
    content = {"1e5": ["1e-3", "+2E5", "1.5e3", "010", "6:24", "1e-3 m", 1e-3, 1e300]}
    assert parse_yaml(dump_yaml(content, in_line), "text") == content
    experiment = Experiment(name="1e5", description="1e-3")
    assert validate(parse_yaml(dump(experiment), "text"), HERE) == experiment


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("a: 1\na: 2", "line 2: key 'a' appears twice"),
        ("a: [1", "line 1"),
        ("a: !!python/object:os.system {}", "python/object:os.system is refused"),
        ("1: 2", "key 1 is not a text; put it in quotes"),
    ],
)
def test_broken_yaml_is_one_sentence_with_the_line(text, told):
    with pytest.raises(InputError, match=r"file\.yaml") as caught:
        parse_yaml(text, "file.yaml")
    assert told in str(caught.value)
    assert "\n" not in str(caught.value)


def test_an_eor_above_the_foregrounds_is_refused():
    with pytest.raises(ExperimentError, match=r"corruption\.eor_level = '40 dB': must be at most 0"):
        validate({"name": "own", "corruption": {"eor_level": "40 dB"}}, Path())


def test_an_unknown_scale_lists_those_there_are():
    with pytest.raises(InputError, match="the file has: small"):
        apply_scale({"scales": {"small": {"a": 1}}}, "smal")


def test_unreadable_files_are_told(tmp_path):
    with pytest.raises(InputError, match="cannot be read"):
        load(tmp_path / "none.yaml")
    (tmp_path / "binary.yaml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(InputError, match="not a text file"):
        load(tmp_path / "binary.yaml")
    (tmp_path / "list.yaml").write_text("[1, 2]")
    with pytest.raises(InputError, match="must hold a block of keys"):
        load(tmp_path / "list.yaml")
