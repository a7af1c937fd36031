"""The report in a real browser: nothing wider than the window, tables that sort and filter, charts that tell values."""

import base64
import json
import re
import shutil
import subprocess
from pathlib import Path
from urllib.parse import unquote

import numpy as np
import pytest
from report_content import CLAIM, MANIFEST, PNG

from calstudy.report.page import write_report, write_several

BROWSER = shutil.which("chromium") or shutil.which("google-chrome")
pytestmark = pytest.mark.skipif(BROWSER is None, reason="there is no Chromium on this machine")

TRIAL = Path(__file__).with_name("trial.js")
CATCH = """<head><script>window.problems = []; window.onerror = (text) => { window.problems.push(text); };</script>"""


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "manifest.json").write_text(json.dumps(MANIFEST))
    (tmp_path / "experiment.yaml").write_text("name: demo\nsky: {seed: 1}\n")
    (tmp_path / "figures").mkdir()
    for name in ("wedge", "spherical"):
        (tmp_path / "figures" / f"{name}.png").write_bytes(PNG)
    errors = {"noise_error": np.full(3, 3.0), "sample_error": np.full(3, 4.0)}
    curve = {"k": np.array([0.1, 0.2, 0.3]), "power": np.array([1e4, -2e3, 1234.0]), **errors}
    np.savez(tmp_path / "figures" / "spherical.npz", **{f"excised.residual.{key}": item for key, item in curve.items()})
    axes = {"k_perp": np.array([0.01, 0.02]), "baseline_length": np.array([14.0, 28.0]), "k_parallel": np.arange(3.0)}
    axes |= {"delay": 1e-7 * np.arange(3), "horizon_delay": np.array([5e-8, 1e-7])}
    cube = {**axes, "power": np.array([[1.0, 2, 3], [4, 5, 4.2e6]])}
    np.savez(tmp_path / "figures" / "wedge.npz", **{f"residual.{key}": item for key, item in cube.items()})
    claims = [
        {**CLAIM, "measured": 12.0, "verdict": "contradicted"},
        {**CLAIM, "measured": 1.5, "quantity": "the second pull"},
        {**CLAIM, "measured": -3.0},
    ]
    (tmp_path / "claims.json").write_text(json.dumps(claims))
    return tmp_path


def run_in_browser(page, width, tmp_path):
    """Return what the trial script found in a page."""
    text = (
        page.read_text()
        .replace("<head>", CATCH, 1)
        .replace("</body>", f"<script>\n{TRIAL.read_text()}</script></body>")
    )
    trial = tmp_path / "trial.html"
    trial.write_text(text)
    flags = ["--headless", "--no-sandbox", "--disable-gpu", "--no-first-run", "--disable-background-networking"]
    flags += ["--disable-component-update", "--disable-sync", f"--user-data-dir={tmp_path / 'profile'}"]
    command = [BROWSER, *flags, f"--window-size={width},900", "--dump-dom", trial.as_uri()]
    shown = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True).stdout
    encoded = re.search(r'<pre id="found">(.*?)</pre>', shown, re.DOTALL)[1]
    return json.loads(unquote(base64.b64decode(encoded).decode()))


@pytest.mark.parametrize("width", [400, 1200])
def test_the_report_works_at_any_width(folder, width):
    found = run_in_browser(write_report(folder), width, folder)
    assert found["errors"] == []
    # A headless window may not be made as narrow as it is asked to be; the page has to fit whatever it is.
    assert found["wide"] <= 0
    assert found["rising"] == ["-3.00 ± 0.10", "1.50 ± 0.10", "12.00 ± 0.10"]
    assert found["falling"] == found["rising"][::-1]
    assert found["failed"] == ["contradicted"]
    assert found["count"] == "1 of 3"
    assert found["words"] == ["1.50 ± 0.10"]
    # Once on top, and once below the figure.
    assert found["points"] == 6
    assert "k = 0.3" in found["curve"]
    assert "residual, P^R: 1230 ± 7" in found["curve"]
    assert "P = 4.20e+6" in found["map"]
    assert "baseline of 28 m" in found["map"]
    assert found["dialog"]


def test_two_runs_work_side_by_side(folder, tmp_path_factory):
    other = tmp_path_factory.mktemp("other")
    shutil.copytree(folder, other, dirs_exist_ok=True)
    (other / "experiment.yaml").write_text("name: demo\nsky: {seed: 2}\n")
    page = write_several([folder, other], other / "both.html")
    found = run_in_browser(page, 1200, other)
    assert found["errors"] == []
    assert found["wide"] <= 0
    assert "sky.seed" in page.read_text()
