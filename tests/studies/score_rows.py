"""Rows of a file of scores."""

from __future__ import annotations

from calstudy.studies.scores import Row


def row(world, calibrator, bias, error, transfer, digest="d", scoring="y"):
    bands = [
        {"k": k, "transfer": kept, "transfer_error": 0.1, "bias": off, "bias_error": error}
        for k, kept, off in zip(([0.1, 0.2], [0.2, 0.5]), transfer, bias, strict=True)
    ]
    scores = {
        "bands": bands,
        "flux_scale": 1.0,
        "gain_error_aligned": None,
        "gain_error_as_fitted": None,
        "held_out_chi_squared": None,
        "by_status": {"by-file": 1},
        "cpu_seconds_per_integration": None,
        "peak_memory": None,
    }
    return Row(world=world, calibrator=calibrator, digest=digest, scoring=scoring, scores=scores)
