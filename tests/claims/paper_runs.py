"""The paper, its settings, and run folders made of tables."""

from __future__ import annotations

import json
from pathlib import Path

from calstudy.experiment.files import dump
from calstudy.experiment.model import PAPERS

EXPERIMENTS = Path(__file__).parents[2] / "experiments"
PAPER = PAPERS.make("calamity2022")
LOW_SNR_FACTS = {"corruption": {"effects": [{"kind": "reflection-gains"}], "noise": {"kind": "times-foregrounds"}}}
AUTHORS = {"name": "adamax", "learning_rate": 0.01, "tolerance": 0.0, "max_steps": 10_000, "keep": "last"}
ADAMAX = {"calibration": {"solver": AUTHORS}}


def verdicts(claims) -> dict[str, str]:
    return {claim.name: claim.verdict for claim in claims}


def run_folder(study, folder: Path) -> Path:
    """Make the folder of a study's tables that of a finished run."""
    (folder / "manifest.json").write_text(json.dumps({"name": study.name, "stand_ins": ["a small sky"]}))
    (folder / "experiment.yaml").write_text(dump(study.experiment))
    return folder
