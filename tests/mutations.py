"""Small mistakes, made one at a time, that the tests must notice.

    python tests/mutations.py                 makes all of them, each in a copy of the repository
    python tests/mutations.py sign            those whose names contain "sign"

A mutation replaces a text, which the package has once, and runs some of the tests, which pass without it. It *survives*
if they pass with it, too; then a test is missing. The exit status is the number of survivors. `test_mutations.py` holds
that every text is still there.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parents[1]

SELECTED = "not slow and not notebook"
"""Tests of whole studies, too."""


@dataclass(frozen=True)
class Mutation:
    """A mistake: `old` becomes `new`, and one of the `tests` must fail."""

    name: str
    old: str
    new: str
    tests: tuple[str, ...]

    def place(self, root: Path = ROOT) -> Path:
        """Return the file that has the text; raises LookupError unless exactly one has it, once."""
        found = [path for path in sorted((root / "calstudy").rglob("*.py")) if self.old in path.read_text("utf-8")]
        if len(found) != 1 or found[0].read_text("utf-8").count(self.old) != 1:
            raise LookupError(f"{self.name}: its text is in {len(found)} files, or more than once; change the mutation")
        return found[0]


SIMULATION = ("tests/simulate/test_patches.py", "tests/simulate/test_engines.py", "tests/simulate/test_chunks.py")
CORRUPTION = ("tests/corrupt",)
AVERAGES = ("tests/power/test_average.py", "tests/power/test_averages.py")
SPECTRA = (
    "tests/power/test_averages.py",
    "tests/power/test_estimate.py",
    "tests/power/test_sample_variance.py",
    "tests/power/test_transfer.py",
)
SCORES = ("tests/power/test_score.py", "tests/power/test_clusters.py")
FITS = ("tests/calibrate/test_solvers.py", "tests/calibrate/test_calamity.py")
STORE = ("tests/run/test_store.py", "tests/run/test_perform.py", "tests/run/test_leases.py")
KEYS = ("tests/test_golden_keys.py", "tests/test_source_table.py", "tests/products/test_keys.py")

MUTATIONS = (
    Mutation(
        "sign of the fringe", "np.exp(2j * np.pi * (turns - np.r", "np.exp(-2j * np.pi * (turns - np.r", SIMULATION
    ),
    Mutation("a missing conjugate in the gains", "gains[time, second].conj()", "gains[time, second]", CORRUPTION),
    Mutation(
        "gains applied twice",
        "            visibilities[time] *= products\n",
        "            visibilities[time] *= products**2\n",
        CORRUPTION,
    ),
    Mutation(
        "a reflection with the other sign",
        "1 / (1 + amplitude * np.exp(",
        "1 / (1 - amplitude * np.exp(",
        CORRUPTION,
    ),
    Mutation(
        "redundant baselines as independent skies",
        "    samples = np.broadcast_to(skies(spectra)[0][:, None], bins.shape)\n",
        "    samples = np.broadcast_to(np.arange(len(bins))[:, None], bins.shape)\n",
        ("tests/power/test_clusters.py",),
    ),
    Mutation(
        "noise of redundant baselines counted again by antennas",
        "np.bincount(antenna, shares**2)) / left**2",
        "0) / left**2",
        ("tests/power/test_clusters.py",),
    ),
    Mutation(
        "a fit that removes the EoR passes",
        "or self._is_no_solution or self._keeps_nothing:",
        "or self._is_no_solution:",
        ("tests/verdicts/test_standing.py",),
    ),
    Mutation(
        "passes of weights that swing go all of the way",
        "            used = np.where(changes > SLOW * before, _halfway(used, solved.gains), solved.gains)\n",
        "            used = solved.gains\n",
        ("tests/calibrate/test_gain_weights.py",),
    ),
    Mutation(
        "a prior weighed against the noise before the gains",
        "            amplitudes = of_antennas[:, first] * of_antennas[:, second]\n",
        "",
        ("tests/products/test_noise_level.py",),
    ),
    Mutation(
        "a prior weighed against the noise of one of several measurements",
        "None if self.levels is None else read_noise(self.levels)",
        "None if self.levels is None else data.nsample_array.max() ** 0.5 * read_noise(self.levels)",
        ("tests/calibrate/test_calibrate_command.py",),
    ),
    Mutation("noise in each part", "noise *= std / np.sqrt(2)", "noise *= std", CORRUPTION),
    Mutation(
        "noise by the time, not its root",
        "for area in areas], axis=-1) / np.sqrt(samples)",
        "for area in areas], axis=-1) / samples",
        CORRUPTION,
    ),
    Mutation("decibels of power", "10 ** (level / 10)", "10 ** (level / 20)", CORRUPTION),
    Mutation(
        "the noise of even and odd is the same",
        "(own or noise.seeds)[PARITIES.index(parity)]",
        "(own or noise.seeds)[0]",
        ("tests/products", "tests/corrupt/test_corruption.py"),
    ),
    Mutation("flags are not set", "    flag_cube(data)[:] = flags\n", "    flag_cube(data)[:] = False\n", CORRUPTION),
    Mutation(
        "the spectral index has the other sign",
        "/ reference) ** index",
        "/ reference) ** -index",
        ("tests/simulate/test_brightness.py",),
    ),
    Mutation(
        "delays run backwards",
        "np.exp(2j * np.pi * delays(n_channels, width)",
        "np.exp(-2j * np.pi * delays(n_channels, width)",
        ("tests/power/test_delay.py",),
    ),
    Mutation(
        "(1+z) for (1+z)^2",
        "(1.0 + z) ** 2 / HYDROGEN_LINE",
        "(1.0 + z) / HYDROGEN_LINE",
        ("tests/power/test_cosmology.py",),
    ),
    Mutation(
        "bins off by one",
        'modes.k_parallel), side="left") - 1',
        'modes.k_parallel), side="left")',
        SPECTRA,
    ),
    Mutation(
        "the wedge inverted",
        "bins[outside_wedge(modes, buffer) == inside]",
        "bins[outside_wedge(modes, buffer) != inside]",
        SPECTRA,
    ),
    Mutation("the wedge without its buffer", "horizon[:, None] + buffer", "horizon[:, None]", (*SPECTRA, *SCORES)),
    Mutation(
        "T without the flux scale",
        "transfer=transfer * flux_scale**2,\n        transfer_error=transfer_error * flux_scale**2,\n        cross",
        "transfer=transfer,\n        transfer_error=transfer_error,\n        cross",
        SCORES,
    ),
    Mutation("a bias by the scale, not its square", "bias=bias * flux_scale**2,", "bias=bias * flux_scale,", SCORES),
    Mutation(
        "P times T",
        "power = spectrum.power.real / factor",
        "power = spectrum.power.real * factor",
        ("tests/power/test_transfer.py",),
    ),
    Mutation(
        "P of a realization times T of others",
        "np.stack([sample.residual.power.real for sample in samples]) / factor",
        "np.stack([sample.residual.power.real for sample in samples]) * factor",
        ("tests/power/test_pooled_realizations.py",),
    ),
    Mutation(
        "weights by |g_a g_b|, not its square",
        "power = np.where(used, np.abs(products) ** 2, np.nan)",
        "power = np.where(used, np.abs(products), np.nan)",
        ("tests/calibrate/test_gain_weights.py",),
    ),
    Mutation(
        "weights without counts",
        "counts = np.where(used, data.nsamples[:, fitted], 0)",
        "counts = np.where(used, 1.0, 0)",
        ("tests/calibrate/test_weights_and_starts.py",),
    ),
    Mutation(
        "weights from autocorrelations without counts",
        "weights = _counts(data, fitted, used, settings.kind) * _from_autos(data, fitted)",
        "weights = used * _from_autos(data, fitted)",
        ("tests/calibrate/test_weights_and_starts.py",),
    ),
    Mutation(
        "an antenna that is off is fitted",
        "return zero & ~(first & second)",
        "return zero & False",
        ("tests/calibrate/test_unequal_antennas.py",),
    ),
    Mutation(
        "converged where one antenna hides the others",
        "(hidden := _hidden(gains, model, problem)) is not None",
        "(hidden := None) is not None",
        ("tests/calibrate/test_unequal_antennas.py",),
    ),
    Mutation(
        "a changed record is believed",
        "if recorded != digest_json(record) or not all(",
        "if not all(",
        STORE,
    ),
    Mutation(
        "warnings are lost with a damaged record",
        "look, lost = (store.find, []) if quick else (store.verify, without_record(targets, store))",
        "look, lost = (store.find, []) if quick else (store.verify, [])",
        ("tests/run/test_perform.py",),
    ),
    Mutation(
        "a worker makes with other code",
        "if other := _other(order.made_with, made_with(order.task)):",
        'if other := "":',
        ("tests/run/test_perform.py", "tests/run/test_other_code.py"),
    ),
    Mutation(
        "files of others take from other files",
        "            if not isinstance(link, h5py.HardLink):\n                return",
        "            if False:\n                return",
        ("tests/studies/test_forged_scores.py",),
    ),
    Mutation(
        "names of others lead out of their folder",
        "if not found.resolve().is_relative_to(root):",
        "if False:",
        ("tests/studies/test_forged_scores.py",),
    ),
    Mutation(
        "a T that cannot be is ranked",
        " and -error <= transfer <= 1 + error:",
        ":",
        ("tests/studies/test_forged_scores.py",),
    ),
    Mutation(
        "errors without the antennas",
        "return np.sqrt(variance + np.maximum(by_antennas, 0.0))",
        "return np.sqrt(variance)",
        SCORES,
    ),
    Mutation(
        "errors by the wrong antennas",
        "share_sample=np.repeat(baselines, 2)",
        "share_sample=np.tile(baselines, 2)",
        ("tests/power/test_clusters.py",),
    ),
    Mutation(
        "an average without counts",
        "used = nsamples[time] * durations[time] * (~flags[time] | flagged)",
        "used = durations[time] * (~flags[time] | flagged)",
        AVERAGES,
    ),
    Mutation(
        "an average without flags",
        "used = nsamples[time] * durations[time] * (~flags[time] | flagged)",
        "used = nsamples[time] * durations[time]",
        AVERAGES,
    ),
    Mutation(
        "weights without flags",
        "used = ~data.flags[:, fitted] & ~dead_samples(data, fitted)",
        "used = ~dead_samples(data, fitted)",
        ("tests/calibrate/test_weights_and_starts.py", *FITS),
    ),
    Mutation(
        "weights of one antenna",
        "inverse[:, first] * inverse[:, second]",
        "inverse[:, first] * inverse[:, first]",
        ("tests/calibrate/test_weights_and_starts.py",),
    ),
    Mutation(
        "a missing conjugate in the fit",
        "gains[..., first, :] * gains[..., second, :].conj()",
        "gains[..., first, :] * gains[..., second, :]",
        FITS,
    ),
    Mutation(
        "a residual with its model twice",
        "calibrated - self.model[t, :, :, p]",
        "calibrated - 2 * self.model[t, :, :, p]",
        ("tests/calibrate/test_calamity.py",),
    ),
    Mutation(
        "all solves converge",
        "return state.predicted / loss < self.tolerance and falling < self.tolerance",
        "return True",
        FITS,
    ),
    Mutation(
        "flags that correlate no delays",
        "return found if found.size else mode_correlation(self.taper, self.delay.size)",
        "return mode_correlation(self.taper, self.delay.size)",
        AVERAGES,
    ),
    Mutation(
        "a key without the version",
        "own = [*self.stage, self.content, inputs, *code]",
        "own = [self.stage.name, self.content, inputs, *code]",
        KEYS,
    ),
    Mutation(
        "a key without the pieces' stages",
        "return digest_json([*own, stages] if stages else own)",
        "return digest_json(own)",
        KEYS,
    ),
    Mutation(
        "a version raised alone",
        'stage="simulate-chunk", version=',
        'stage="simulate-chunk", version=1',
        KEYS,
    ),
    Mutation(
        "a field that is in no key",
        "elif value != default or (isinstance(value, Path) and value.exists()):\n            content",
        'elif value != default and name != "tolerance":\n            content',
        KEYS,
    ),
    Mutation("a lock that is not taken", "with store.lock(order.task.stage.name, order.key, warn):", "if True:", STORE),
    Mutation(
        "store deletes what a run needs",
        "            if key not in needed:\n                with",
        "            if True:\n                with",
        ("tests/test_start_commands.py",),
    ),
    Mutation("verify reads no file", 'sha256(product.path / name) == entry["sha256"]', "True", STORE),
    Mutation("a kept product is dropped", ' and product.record.get("temporary")', "", STORE),
    Mutation(
        "what other runs need is dropped",
        "if key not in needed:\n                    self",
        "if True:\n                    self",
        STORE,
    ),
    Mutation(
        "a reference holds one bin far off",
        "return largest > rule.largest or",
        "return False or",
        ("tests/regression",),
    ),
    Mutation(
        "a calibrator passes without its error",
        '"passes" if known and self.upper_limit < limit',
        '"passes" if known and abs(self.bias) < limit',
        ("tests/verdicts",),
    ),
    Mutation(
        "a T with any error is measured",
        "error > LARGEST_ERROR",
        "error > 10 * LARGEST_ERROR",
        ("tests/verdicts", "tests/power/test_transfer.py"),
    ),
)


def copied(folder: Path) -> None:
    """Copy the files of the repository that git knows, as they are now."""
    names = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    for name in filter(None, names.split("\0")):
        if (ROOT / name).is_file() or (ROOT / name).is_symlink():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, folder / name, follow_symlinks=False)


@cache
def pass_without(tests: tuple[str, ...]) -> bool:
    """Return whether tests pass in a copy of the repository without any mutation."""
    return _pass(tests, None)


def survives(mutation: Mutation) -> bool:
    """Return whether the tests pass in a copy of the repository with the mutation."""
    return _pass(mutation.tests, mutation)


def _pass(tests: tuple[str, ...], mutation: Mutation | None) -> bool:
    with tempfile.TemporaryDirectory(prefix="mutation-") as name:
        folder = Path(name)
        copied(folder)
        if mutation is not None:
            path = mutation.place(folder)
            path.write_text(path.read_text("utf-8").replace(mutation.old, mutation.new), encoding="utf-8")
        command = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", "-m", SELECTED, *tests]
        environment = {**os.environ, "PYTHONPATH": str(folder)}
        return subprocess.run(command, cwd=folder, env=environment, capture_output=True, check=False).returncode == 0


def main(*words: str) -> int:
    """Make the mutations whose names contain a word, or all; return the number of those that survive."""
    chosen = [one for one in MUTATIONS if not words or any(word in one.name for word in words)]
    survivors = 0
    for mutation in chosen:
        if not pass_without(mutation.tests):
            raise SystemExit(f"{', '.join(mutation.tests)}: fail without any mutation; mend them first")
        alive = survives(mutation)
        survivors += alive
        print(f"{'SURVIVES' if alive else 'noticed '}  {mutation.name}", flush=True)
    print(f"{len(chosen)} mutations, {survivors} survive")
    return survivors


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
