"""The initial file of a user: a small experiment, with comments on possible changes."""

from __future__ import annotations

import re
from pathlib import Path

from calstudy.base.errors import InputError
from calstudy.base.package_files import find_experiment
from calstudy.experiment.model import STUDY_NAME
from calstudy.experiment.yaml_files import read_mapping

MODELINE = "# yaml-language-server: $schema="
"""Start of the line from which editors know the schema of a file."""
TEXT = """\
# A small experiment: about a minute. Fields that are left out have the values of
# Ewall-Wice et al. (2022), but for calibration.weights.
# `calstudy plan {name}.yaml` checks it and says what a run takes; `calstudy run {name}.yaml` runs it.
# All fields: `calstudy fields`.
name: {name}
description: A small array with cable reflections in the gains, calibrated with CALAMITY.

instrument:
  layout: {{kind: mwa-compact-minredundant, count: 16}}   # or hex, hera-19, ..., csv with a path and location
  # location: hera                                        # mwa, hera, paper, ovro-lwa, or latitude and longitude
  beam: mwa-embedded-element                              # airy, gaussian, hera, or beamfits with a path
  channels: {{first: 167.075 MHz, width: 240 kHz, count: 128}}
  times: {{start_lst: 1.8 h, integration: 8 s, count: 8}}
  polarizations: [xx]                                     # [xx], [yy] or [xx, yy]

sky:
  foregrounds: {{kind: g4jy-and-counts, count: 4000}}     # the 4000 brightest; or flux_limit: 50 mJy for all above
  # diffuse: haslam                                       # Galactic emission besides the sources
  eor: {{nside: 32, seed: 2}}                             # 256 at full scale

corruption:
  eor_level: -40 dB                                       # rms of the EoR over that of the foregrounds
  effects: [{{kind: reflection-gains}}]                   # what happens to the data, in this order
  noise: {{factor: 4}}                                    # times the rms of the EoR

calibration:
  calibrator: calamity                                    # calamity-redundant, sky-based, ..., or a file.py
  # assumed: {{sky.foregrounds.flux_limit: 1 Jy}}         # what the calibrator takes for true
  # weights: autos                                        # or flags, the paper's; inverse variances without them
  chunks: 1

simulation:
  chunks: 2
  nodes: {{tolerance: 1e-7}}

# sweep: {{corruption.noise.factor: [1, 4, 16]}}          # vary fields: a run for every combination
# realizations: {{draw: [gains, noise], count: 5}}        # or draw EoR, gains or noise again

outputs:
  figures: [layout, gains, wedge, spherical, signal-loss]
  store: store                                            # products, shared by all experiments
  runs: runs                                              # a folder for each run
"""

OBSERVED = """\
# Measured data: {summary}
# Calibration, power spectra of the data and of what is left, and what the calibration takes from an EoR that is put in.
# `calstudy plan {name}.yaml` checks it and says what a run takes; `calstudy run {name}.yaml` runs it.
# All fields: `calstudy fields observed`; how to read the results: docs/measured-data.md.
name: {name}

observed:
  data: {path}
  # odd: another.uvh5                                     # the same sky on another night; else every second integration
  select:
    frequencies: {first}..{last}                          # leave out edges and interference
    # antennas: 0,1,12                                    # lengths, times and polarizations likewise
  # flag: [149.7 MHz..150.2 MHz]                          # channels of known interference inside the band
  {search}flag_interference: true                               # what stands out in time and frequency
  # positions: antennas.csv                               # number, east_m, north_m, up_m, in place of the file's
  # sky_model: model.uvh5                                 # visibilities in Jy, if there are any
  beam: {beam}
  {scale}

calibration:
  calibrator: calamity                                    # calamity-redundant, ..., or a file.py
  # weights: autos                                        # the radiometer equation, if there are autocorrelations

injection:
  eor: {{nside: 64}}                                        # pixels of 0.9 deg; finer for long baselines
  level: -30 dB                                           # rms of the EoR over that of the fitted foregrounds

power:
  pairs: auto                                             # same-baseline, redundant-group

outputs:
  store: store                                            # products, shared by all experiments
  runs: runs                                              # a folder for each run
"""
SCALE = "flux_scale: {kind: system-temperature, receiver: 100 K}   # or {kind: factor, unit: 1 Jy}"


def observed_text(name: str, schema: Path, beam: str, in_jansky: bool, searchable: bool, **entries: str) -> str:
    """Return the text of a file about measured data; see `starter_text`.

    `beam` is the name of a beam, `in_jansky` is true for data in Jy, and `searchable` for those that are enough for a
    search for interference. The entries are ``path`` as it is written, ``summary``, a sentence, and ``first`` and
    ``last``, the ends of the band.
    """
    _require_name(name)
    optional = {"scale": "# " + SCALE if in_jansky else SCALE, "search": "" if searchable else "# "}
    return f"{MODELINE}{schema}\n{OBSERVED.format(name=name, beam=beam, **optional, **entries)}"


def starter_text(name: str, schema: Path) -> str:
    """Return the text of an experiment file with the path of the JSON schema, for editors.

    Raises InputError if the name is not allowed.
    """
    _require_name(name)
    return f"{MODELINE}{schema}\n{TEXT.format(name=name)}"


def copy_text(example: str, name: str, schema: Path) -> str:
    """Return the text of a published experiment under another name; see `starter_text`."""
    _require_name(name)
    path = find_experiment(Path(example))
    if {"experiments", "calibrators"} & set(read_mapping(path)):
        raise InputError(f"--example {example}: is made of other files; copy one of those")
    lines = path.read_text(encoding="utf-8").splitlines()
    kept = [line for line in lines if not line.startswith(MODELINE)]
    text = re.sub(r"^name: .*$", f"name: {name}", "\n".join(kept), count=1, flags=re.MULTILINE)
    return f"{MODELINE}{schema}\n{text}\n"


def _require_name(name: str) -> None:
    if not STUDY_NAME.fullmatch(name):
        raise InputError(f"{name!r} cannot name an experiment: use at most 64 letters, digits, '_', '.', '-'")
