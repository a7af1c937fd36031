"""Which parts of an experiment claims read, and which parts experiments play in the paper."""

from __future__ import annotations

from typing import Literal

ExperimentRole = Literal["minimally_redundant", "redundant", "redundant_modelling", "low_snr", "paper_solver"]
Role = ExperimentRole | Literal["run_time"]

FACTS = ("calibration", "corruption", "power")
"""Sections of the experiment that decide which claims a run can be held to, and where."""
