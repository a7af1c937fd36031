"""A manifest, a claim and a picture of a run that was not made."""

from __future__ import annotations

import base64

# One red pixel.
PNG = base64.b64decode(
    "iVBORw0KGgoAAAANSUhEUgAAAAEAAAABCAYAAAAfFcSJAAAADUlEQVR4nGP4z8DwHwAFAAH/iZk9HQAAAABJRU5ErkJggg=="
)


def product(stage: str, label: str, **notes) -> dict:
    return {
        "stage": stage,
        "label": label,
        "key": "0",
        "notes": notes,
        "seconds": 30.0,
        "cpu_seconds": 61.0,
        "peak_memory_bytes": 2_500_000_000,
        "made_by_this_run": True,
        "inputs": {},
    }


MANIFEST = {
    "name": "demo",
    "finished": "2026-01-02T03:04:05+00:00",
    "stand_ins": ["beam: <gaussian> & so on"],
    "seeds": {"sky.eor.seed": 2},
    "git_commit": "abc",
    "versions": {"numpy": "2.4", "matvis": None},
    "machine": {"cores": 2, "memory_gb": 8.0, "system": "Linux", "python": "3.11"},
    "products": [
        product("calibrate", "V even", by_status={"converged": 7, "max-steps": 1}, median_steps=4.0,
                median_seconds_per_solve=0.25, warnings=["1 of 8 solves did not converge"]),
        product("simulate", "foregrounds", interpolation={"max_error": 1.5e-11},
                delay_floor={"hann": {"worst_db": -55.5}}),
        product("simulate", "eor", interpolation=None),
        product("figure", "wedge", caption="The <wedge>."),
        product("figure", "spherical"),
    ],
}  # fmt: skip

CLAIM = {
    "name": "a", "section": "Results", "sentence": "R agrees with S.", "quantity": "pull", "measured": 1.234,
    "uncertainty": 0.1, "threshold": "<= 2", "why": "", "verdict": "supported", "runs": ["demo"], "reason": "",
}  # fmt: skip
