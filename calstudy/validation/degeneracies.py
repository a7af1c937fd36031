r"""Step 2.1: directions of gains and foregrounds that the data cannot see.

Any of these exchanges leaves g_a g_b* F_ab, and so the likelihood, as it is:

- *phase*: g_a -> g_a exp(i phi(nu)), any phase in every channel, the same for all antennas;
- *scale*: g_a -> g_a sqrt(s), F -> F / s;
- *tilt*: g_a -> g_a exp(i k.x_a), F_ab -> F_ab exp(i k.(x_b - x_a)): a shift of the sky;
- *smooth*: g_a -> g_a s_a(nu), F_ab -> F_ab / (s_a s_b*), with s_a so smooth that the model stays within its basis.

Two statements are measured, on noisy data:

- at the true gains: the misfit V - g_a g_b* F with the best F of the basis is the same after the exchange (*exact*).
  For the smooth exchange the true foregrounds are those of a narrower basis, without the buffer;
- the fit: started from gains moved along the direction, it ends at the same residual (*fitted*). Phase and scale are
  fixed on purpose, so that R = V / (g_a g_b*) - F itself must be the same. Tilt and smooth exchanges are not, and R
  carries their factor; there V - g_a g_b* F, R times the gains it was divided by, must be the same.

Differences are rms over the rms of the data.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from calstudy.calibrate.basis import dpss_vectors, make_basis
from calstudy.calibrate.records import CalibrationResult
from calstudy.claims.statement import Finding
from calstudy.validation.evidence import Evidence, Measurement
from calstudy.validation.scene import Scene, rms
from calstudy.visibilities import baseline_vectors, to_cube

PATIENCE = 1e-13
"""Tolerance of the solver: residuals are to agree to 1e-6 of the data, far below the noise."""
SMOOTH_DELAY = 10e-9
"""Largest delay of a smooth exchange, s: inside the buffer of the basis."""


def measure(evidence: Evidence) -> Measurement:
    """Return the largest difference of any exchange, before and after a fit, of `parameters["draws"]` draws each."""
    name = evidence.only
    scene = Scene.of(evidence, name)
    rng = np.random.default_rng(20220422)
    gains = scene.true_gains(evidence, name)
    noise = scene.noise_std * (rng.standard_normal((2, *scene.modelled.shape)) / np.sqrt(2))
    visibilities = scene.products(gains) * narrow_model(scene) + noise[0] + 1j * noise[1]
    exact = dict.fromkeys(EXCHANGES, 0.0)
    fitted, remarks = dict(exact), []
    settings = scene.settings.model_copy(
        update={"solver": scene.settings.solver.model_copy(update={"tolerance": PATIENCE})}
    )
    reference = scene.calibrate(visibilities, settings)
    before = best_misfit(scene, visibilities, gains)
    for kind, draw in EXCHANGES.items():
        for _ in range(evidence.parameters["draws"]):
            factors = draw(scene, rng)
            after = best_misfit(scene, visibilities, gains * factors)
            exact[kind] = max(exact[kind], rms(after - before) / rms(visibilities))
        moved = scene.calibrate(visibilities, settings, start=draw(scene, rng))
        change = residual(scene, kind, moved, visibilities) - residual(scene, kind, reference, visibilities)
        fitted[kind] = rms(change) / rms(visibilities)
        record = moved.solutions[0]
        remarks.append(
            f"{kind}: exact {exact[kind]:.1e}, fitted {fitted[kind]:.1e} ({record.status}, {record.n_steps} steps)"
        )
    remarks.append(f"noise {scene.noise_std / rms(visibilities):.1e} of the data")
    return Measurement(
        {
            "exact": Finding(max(exact.values()), 0.0),
            "fitted": Finding(max(fitted.values()), 0.0),
            **{f"fitted_{kind}": Finding(value, 0.0) for kind, value in fitted.items()},
        },
        tuple(remarks),
    )


def residual(scene: Scene, kind: str, result: CalibrationResult, visibilities: np.ndarray) -> np.ndarray:
    """Return what an exchange must not change of a fit: R if its gauge is fixed, else V - g_a g_b* F."""
    if kind in ("phase", "scale"):
        return to_cube(result.residual)[0, :, :, 0]
    return scene.misfit(result, visibilities)


def narrow_model(scene: Scene) -> np.ndarray:
    """Return the foregrounds in the basis without its buffer, (Nbls, Nfreqs)."""
    settings = scene.settings.basis.model_copy(update={"buffer": 0.0})
    lengths = np.linalg.norm(baseline_vectors(scene.foregrounds), axis=1)
    cube = to_cube(scene.foregrounds)[0, :, :, 0]
    projected = np.empty_like(cube)
    for bucket in make_basis(lengths, scene.foregrounds.freq_array, settings).buckets:
        projected[bucket.members] = cube[bucket.members] @ bucket.vectors @ bucket.vectors.T
    return projected


def best_misfit(scene: Scene, visibilities: np.ndarray, gains: np.ndarray) -> np.ndarray:
    """Return V - g_a g_b* F with the F of the basis that fits best, (Nbls, Nfreqs).

    By plain least squares baseline by baseline, which shares nothing with the solvers.
    """
    products = scene.products(gains)
    misfit = np.empty_like(visibilities)
    for bucket in scene.structure.basis.buckets:
        for baseline in bucket.members:
            design = products[baseline][:, None] * bucket.vectors
            orthonormal, _ = np.linalg.qr(design)
            values = visibilities[baseline]
            misfit[baseline] = values - orthonormal @ (orthonormal.conj().T @ values)
    return misfit


def _phase(scene: Scene, rng: np.random.Generator) -> np.ndarray:
    phases = rng.uniform(0, 2 * np.pi, scene.structure.n_frequencies)
    return np.exp(1j * np.tile(phases, (scene.structure.n_antennas, 1)))


def _scale(scene: Scene, rng: np.random.Generator) -> np.ndarray:
    shape = (scene.structure.n_antennas, scene.structure.n_frequencies)
    return np.full(shape, np.exp(rng.uniform(-0.5, 0.5)), complex)


def _tilt(scene: Scene, rng: np.random.Generator) -> np.ndarray:
    telescope = scene.foregrounds.telescope
    rows = np.searchsorted(telescope.antenna_numbers, scene.numbers)
    east_north = telescope.get_enu_antpos()[rows, :2]
    # Up to a turn across 100 m.
    slope = rng.uniform(-1, 1, 2) * 2 * np.pi / 100
    return np.exp(1j * np.tile((east_north @ slope)[:, None], (1, scene.structure.n_frequencies)))


def _smooth(scene: Scene, rng: np.random.Generator) -> np.ndarray:
    count, n_frequencies = scene.structure.n_antennas, scene.structure.n_frequencies
    width = float(np.diff(scene.foregrounds.freq_array).mean())
    vectors = dpss_vectors(n_frequencies, n_frequencies * width * SMOOTH_DELAY, 0.5)
    coefficients = rng.standard_normal((2, count, vectors.shape[1])) * 0.1 * np.sqrt(n_frequencies)
    return np.exp((coefficients[0] + 1j * coefficients[1]) @ vectors.T / np.sqrt(vectors.shape[1]))


EXCHANGES: dict[str, Callable[[Scene, np.random.Generator], np.ndarray]] = {
    "phase": _phase,
    "scale": _scale,
    "tilt": _tilt,
    "smooth": _smooth,
}
"""Factors on the gains, (Nants, Nfreqs), drawn at random."""
