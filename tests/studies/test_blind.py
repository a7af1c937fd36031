"""A blind challenge: seeds that nobody can guess, digests that tell nothing, a recipe that scores what comes back."""

import json
from dataclasses import replace
from hashlib import sha256
from pathlib import Path

import pytest
import yaml
from command_line import run_and_read
from tiny import tiny

from calstudy.base.errors import InputError
from calstudy.calibrate.calibrators.given_gains import MANIFEST, DataSet, Manifest, find_returned, salted
from calstudy.products.corruption import PARITIES, data, truths
from calstudy.products.graph import Graph
from calstudy.studies.export import BITS, CARRIER, write_recipe
from calstudy.studies.kinds.comparison import WorldData, load_worlds

CHALLENGE = Path(__file__).parents[2] / "experiments" / "challenge.yaml"


def seeds_in(value):
    """Return all seeds in nested settings."""
    if isinstance(value, dict):
        own = [value[name] for name in ("seed", "seeds", "seeds_without_eor") if value.get(name) is not None]
        flat = [seed for item in own for seed in (item if isinstance(item, list) else [item])]
        return flat + [seed for item in value.values() for seed in seeds_in(item)]
    return [seed for item in value for seed in seeds_in(item)] if isinstance(value, list) else []


@pytest.fixture(scope="module")
def open_worlds():
    return load_worlds(CHALLENGE, None, (), None)


@pytest.fixture(scope="module")
def recipe(open_worlds, tmp_path_factory):
    path = tmp_path_factory.mktemp("blind") / "secret.yaml"
    digest = write_recipe(open_worlds, path)
    assert digest == sha256(path.read_bytes()).hexdigest()
    assert path.stat().st_mode & 0o777 == 0o600
    return path


@pytest.fixture(scope="module")
def blind_worlds(recipe):
    return load_worlds(recipe, None, (), CARRIER)


def test_all_that_is_drawn_has_secret_seeds_of_its_own_in_every_world(blind_worlds, recipe):
    changed = [yaml.safe_load(recipe.read_text())["worlds"][name] for name in ("1", "2", "3", "4", "5")]
    drawn = [
        seed
        for world in changed
        for name, value in world.items()
        if name.rpartition(".")[2] in ("seed", "seeds", "seeds_without_eor")
        for seed in (value if isinstance(value, list) else [value])
    ]
    assert len(set(drawn)) == len(drawn)
    # A number of 128 bits is below 2^64 once in 10^19.
    assert min(drawn) > 2 ** (BITS // 2)
    for case in blind_worlds.cases:
        content = case.experiment.model_dump(mode="json")
        used = [content["sky"]["foregrounds"]["seed"], content["sky"]["eor"]["seed"]]
        used += seeds_in(content["corruption"])
        built = content["instrument"]["as_built"]
        used += [block["seed"] for block in built.values() if case.world != "1" and block and block.get("scatter")]
        assert set(used) <= set(drawn)


def test_nothing_but_seeds_differs_from_the_open_challenge(open_worlds, blind_worlds):
    def without_seeds(value):
        if isinstance(value, dict):
            return {key: without_seeds(item) for key, item in value.items() if not key.startswith("seed")}
        return [without_seeds(item) for item in value] if isinstance(value, list) else value

    known = {case.world: case.experiment for case in open_worlds.cases}
    for case in blind_worlds.cases:
        mine, its = (
            without_seeds(item.model_dump(mode="json", include={"instrument", "sky", "corruption", "power"}))
            for item in (case.experiment, known[case.world])
        )
        assert mine == its


def test_data_with_the_eor_and_without_have_noise_of_their_own(blind_worlds, open_worlds):
    def noise(worlds):
        experiment = worlds.cases[0].experiment
        graph = Graph(experiment)
        variants = [experiment.variants[name] for name in ("residual", "residual_without_eor")]
        return [data(graph, variant, parity).noise_seed for variant in variants for parity in PARITIES]

    assert len(set(noise(blind_worlds))) == 4
    assert noise(open_worlds) == [103, 104, 103, 104]


def test_digests_of_a_blind_challenge_do_not_tell_what_was_digested(blind_worlds):
    salt = blind_worlds.file.salt
    assert len(salt) == BITS // 4
    for case in blind_worlds.cases:
        plain, hidden = WorldData.of(case.experiment), WorldData.of(case.experiment, salt)
        assert hidden.digest == salted(plain.digest, salt) != plain.digest
        assert {task.key for task in plain.data} == {task.key for task in hidden.data}
        order = [salted(task.key, salt) for task in hidden.data]
        assert order == sorted(order)


def test_gains_come_back_by_the_salted_digests(blind_worlds, recipe, tmp_path):
    [case, *_] = blind_worlds.cases
    contents = WorldData.of(case.experiment, blind_worlds.file.salt)
    keys = [task.key for task in contents.data]
    hidden = [salted(key, contents.salt) for key in keys]
    sets = tuple(
        DataSet(name=f"data-{place}", file=f"data-{place}.uvh5", digest=digest) for place, digest in enumerate(hidden)
    )
    sky = contents.sky_model.key
    manifest = Manifest(calstudy="0", digest=contents.digest, data=sets, sky_model_digest=salted(sky, contents.salt))
    (tmp_path / MANIFEST).write_text(manifest.model_dump_json())
    text = json.dumps(json.loads(manifest.model_dump_json()))
    assert not any(key in text for key in (*keys, sky))
    for place in range(4):
        (tmp_path / f"data-{place}.calh5").touch()
    worlds = load_worlds(recipe, None, (), {"mine": {"calibrator": "by-file", "folder": str(tmp_path)}})
    calibrator = worlds.cases[0].experiment.calibration
    assert [calibrator.for_data(key, sky).gains.name for key in keys] == [f"data-{place}.calh5" for place in range(4)]
    with pytest.raises(InputError, match="has other digests"):
        find_returned(tmp_path, keys[0], sky)


def test_a_recipe_is_not_replaced(open_worlds, recipe):
    with pytest.raises(InputError, match="is there already"):
        write_recipe(open_worlds, recipe)


def test_no_effect_of_a_recipe_is_that_of_the_public_file_also_if_it_is_the_default(tmp_path):
    """Default effects, and the defaults in which an array as built does not differ, have public seeds."""
    file = tmp_path / "plain.yaml"
    built = {"positions": {"scatter": "2 cm"}}
    file.write_text(yaml.safe_dump({"name": "plain", "instrument": {"layout": "hera-19", "as_built": built}}))
    write_recipe(load_worlds(file, None, (), CARRIER), tmp_path / "recipe.yaml")

    def drawn(path):
        [case] = load_worlds(path, None, (), CARRIER).cases
        keys = {task.key for task in truths(Graph(case.experiment))}
        content = case.experiment.model_dump(mode="json")
        return keys, set(seeds_in(content["corruption"])) | set(seeds_in(content["instrument"]["as_built"]))

    open_keys, open_seeds = drawn(file)
    secret_keys, secret_seeds = drawn(tmp_path / "recipe.yaml")
    assert len(open_keys) == len(secret_keys) > 0
    assert not open_keys & secret_keys
    assert not open_seeds & secret_seeds


def test_a_seed_that_a_world_sets_before_it_sets_the_effects_does_not_come_back(tmp_path):
    file = tmp_path / "plain.yaml"
    changes = {"corruption.effects.0.seed": 76, "corruption.effects": [{"kind": "per-channel-gains", "seed": 77}]}
    base = {"name": "base", "instrument": {"layout": "hera-19"}}
    content = {"name": "plain", "experiment": base, "calibrators": {"none": "none"}, "worlds": {"one": changes}}
    file.write_text(yaml.safe_dump(content, sort_keys=False))
    write_recipe(load_worlds(file, None, (), None), tmp_path / "recipe.yaml")
    [case] = load_worlds(tmp_path / "recipe.yaml", None, (), CARRIER).cases
    assert case.experiment.corruption.effects[0].seed > 2 ** (BITS // 2)


@pytest.mark.parametrize(
    ("options", "told"),
    [
        (["--output", "data", "--format", "foo"], "--format foo: not a format"),
        (["--output", "taken"], "--output taken: cannot be written"),
    ],
)
def test_no_recipe_is_announced_of_data_that_cannot_be_written(tmp_path, monkeypatch, capsys, options, told):
    monkeypatch.chdir(tmp_path)
    Path("plain.yaml").write_text(yaml.safe_dump(tiny(tmp_path)))
    Path("taken").touch()
    status, written = run_and_read(capsys, "export", "plain.yaml", "--blind", "recipe.yaml", *options)
    assert status == 2
    assert told in written.err
    assert written.err.count("\n") == 1
    assert (written.out, Path("recipe.yaml").exists()) == ("", False)


def test_a_recipe_that_would_not_be_read_again_is_not_left(open_worlds, tmp_path):
    spoiled = replace(open_worlds, resolved={**open_worlds.resolved, "figures": ["wedge"]})
    with pytest.raises(InputError, match=r"--blind .*cannot be read back \(figures.0: "):
        write_recipe(spoiled, tmp_path / "recipe.yaml")
    assert not (tmp_path / "recipe.yaml").exists()


@pytest.mark.parametrize(
    ("options", "told"),
    [
        (["--output", "taken/x.json"], "--output taken/x.json: cannot be written"),
        (["--output", "folder", "--overwrite"], "--output folder: is a folder; give the name of a file"),
        (["--set", "outputs.runs=taken"], "outputs.runs = 'taken': cannot be written"),
    ],
)
def test_scores_that_cannot_be_written_are_not_computed(tmp_path, monkeypatch, capsys, options, told):
    monkeypatch.chdir(tmp_path)
    Path("plain.yaml").write_text(yaml.safe_dump(tiny(tmp_path)))
    Path("taken").touch()
    Path("folder").mkdir()
    status, written = run_and_read(capsys, "score", "plain.yaml", *options)
    assert (status, written.err.count("\n")) == (2, 1)
    assert told in written.err
    assert not (tmp_path / "store").exists()


def test_data_are_not_made_where_the_log_cannot_be_written(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("plain.yaml").write_text(yaml.safe_dump(tiny(tmp_path)))
    Path("taken").touch()
    status, written = run_and_read(capsys, "export", "plain.yaml", "--output", "x", "--set", "outputs.runs=taken")
    assert (status, written.err.count("\n")) == (2, 1)
    assert "outputs.runs = 'taken': cannot be written" in written.err


def test_nothing_is_promised_of_data_that_a_run_would_refuse(tmp_path, capsys):
    """Coarse maps of a steep EoR have replicas at long baselines; gains of such data could not be scored."""
    changes = ["--set", "sky.eor.spectrum=power-law", "--set", "sky.eor.nside=16"]
    secret = ["--output", tmp_path / "data", "--blind", tmp_path / "secret.yaml"]
    status, written = run_and_read(capsys, "export", "quickstart", *changes, *secret)
    assert status == 2
    assert "sky.eor.nside = 16: maps of a power-law spectrum" in written.err
    assert "SHA-256" not in written.out
    assert not any(tmp_path.iterdir())
