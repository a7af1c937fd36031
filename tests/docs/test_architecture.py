"""The picture of the house shows the layers of the import contract."""

import re
import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[2]


def test_the_picture_has_the_packages_of_the_contract_in_its_order():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    layers = project["tool"]["importlinter"]["contracts"][0]["layers"]
    names = [{name.strip().rpartition(".")[2] for name in layer.split("|")} for layer in layers]
    picture = (ROOT / "docs" / "figures" / "architecture.svg").read_text(encoding="utf-8")
    shown: dict[float, set[str]] = {}
    for height, name in re.findall(r'<text x="[\d.]+" y="([\d.]+)" class="package"[^>]*>(\w+)<', picture):
        shown.setdefault(float(height), set()).add(name)
    assert [shown[height] for height in sorted(shown)] == [layer for layer in names if layer != {"__main__"}]


def test_the_table_of_stages_has_every_product_beside_its_module():
    text = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| (`[^|]+) \| ([^|]+) \|", text.partition("## Stages")[2].partition("\n## ")[0], re.MULTILINE)
    shown = {stage: modules for stages, modules in rows for stage in re.findall(r"`([\w-]+)`", stages)}
    made = {
        stage: module.stem
        for module in sorted((ROOT / "calstudy" / "products").glob("*.py"))
        for stage in re.findall(r'stage="([\w-]+)"', module.read_text(encoding="utf-8"))
    }
    assert shown.keys() == made.keys()
    for stage, module in made.items():
        assert f"`{module}`" in shown[stage], stage
