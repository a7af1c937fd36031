"""The folder of a run of others is evaluated without running code that it names."""

import json

import pytest
import yaml
from command_line import run_command
from tiny import tiny

EVIL = "from pathlib import Path\nPath(__file__).with_suffix('.ran').touch()\n"


@pytest.mark.parametrize("field", ["calibration", "papers", "effects"])
def test_claims_of_a_folder_run_no_code_that_it_names(field, tmp_path, capsys):
    code = tmp_path / "evil.py"
    code.write_text(EVIL)
    experiment = tiny(tmp_path)
    if field == "effects":
        experiment["corruption"] = {"effects": [{"kind": str(code)}]}
    else:
        experiment[field] = {"calibrator": str(code)} if field == "calibration" else [str(code)]
    folder = tmp_path / "run"
    (folder / "tables").mkdir(parents=True)
    (folder / "experiment.yaml").write_text(yaml.safe_dump(experiment))
    (folder / "manifest.json").write_text(json.dumps({"name": "theirs", "stand_ins": []}))
    status, message = run_command(capsys, "claims", folder)
    assert status == 2
    assert "evil.py' is code, which is not run here; use --run-code if you trust who wrote" in message
    assert not code.with_suffix(".ran").exists()
    if field == "papers":
        # Papers of the folder are not looked at if others are named.
        assert "evil.py" not in run_command(capsys, "claims", folder, "--paper", "calamity2022")[1]
        assert not code.with_suffix(".ran").exists()
    run_command(capsys, "claims", folder, "--run-code")
    assert code.with_suffix(".ran").exists()
