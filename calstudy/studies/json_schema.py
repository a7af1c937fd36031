"""The JSON schema of experiment files, with which editors complete and check them."""

from __future__ import annotations

import json
from typing import Any

from pydantic import BaseModel
from pydantic.json_schema import models_json_schema

from calstudy.experiment.model import Experiment
from calstudy.studies import collection, comparison, observed, runtime
from calstudy.studies.collection import CollectionFile
from calstudy.studies.comparison import ComparisonFile
from calstudy.studies.observed import ObservedFile
from calstudy.studies.runtime import RuntimeFile

SCHEMA_FILE = "experiment.schema.json"
"""Name of the published schema, next to the experiments."""
DIALECT = "https://json-schema.org/draft/2020-12/schema"


def experiment_schema() -> str:
    """Return the JSON schema of experiments, collections, comparisons, run-time studies and measured data as text.

    It has strings for quantities; only ``calstudy plan`` checks units and conditions on several fields.
    """
    kinds: dict[type[BaseModel], str] = {
        CollectionFile: collection.KEY,
        RuntimeFile: runtime.KEY,
        ComparisonFile: comparison.KEY,
        ObservedFile: observed.KEY,
    }
    models: list[type[BaseModel]] = [Experiment, *kinds]
    references, found = models_json_schema([(model, "validation") for model in models])
    schema: dict[str, Any] = references[Experiment, "validation"]
    for model, key in kinds.items():
        schema = {"if": {"required": [key]}, "then": references[model, "validation"], "else": schema}
    definitions = {name: _plain(block) for name, block in found["$defs"].items()}
    whole = {"$schema": DIALECT, "title": "calstudy experiment", "type": "object", **schema, "$defs": definitions}
    return json.dumps(whole, indent=1, sort_keys=True) + "\n"


def _plain(block: Any) -> Any:
    """Return a schema without the titles that pydantic derives from names, and without defaults of whole blocks."""
    if isinstance(block, list):
        return [_plain(item) for item in block]
    if not isinstance(block, dict):
        return block
    left_out = {"title"} if isinstance(block.get("title"), str) else set()
    if isinstance(block.get("default"), dict | list):
        left_out.add("default")
    return {key: _plain(value) for key, value in block.items() if key not in left_out}
