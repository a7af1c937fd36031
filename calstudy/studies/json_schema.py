"""The JSON schema of experiment files, with which editors complete and check them."""

from __future__ import annotations

import json
from typing import Any

from pydantic import BaseModel
from pydantic.json_schema import models_json_schema

from calstudy.experiment.model import Experiment
from calstudy.studies.study import built_in_kinds

SCHEMA_FILE = "experiment.schema.json"
"""Name of the published schema, next to the experiments."""
DIALECT = "https://json-schema.org/draft/2020-12/schema"


def experiment_schema() -> str:
    """Return the JSON schema of the files of all built-in kinds of study as text.

    It has strings for quantities; only ``calstudy plan`` checks units and conditions on several fields.
    """
    kinds = {kind.model: kind.key for kind in built_in_kinds() if kind.model is not Experiment}
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
