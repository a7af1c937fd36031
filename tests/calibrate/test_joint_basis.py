"""Foreground models of several baselines at once: limits where they are others, recovery, files, and refusals."""

from __future__ import annotations

import numpy as np
import pytest
import tensorflow as tf
from pydantic import ValidationError
from test_calamity import SETTINGS, make_uvdata
from test_calibration_loss import redundant_structure
from toy import complex_normal

from calstudy.base.errors import InputError
from calstudy.base.identity import identity
from calstudy.base.observation import Observation
from calstudy.base.visibilities import antenna_pairs, to_cube
from calstudy.calibrate import pairs
from calstudy.calibrate.basis import Bucket, ForegroundBasis
from calstudy.calibrate.calibrators.calamity import Calamity
from calstudy.calibrate.calibrators.calamity_redundant import CalamityRedundant
from calstudy.calibrate.calibrators.sky_based import SkyBased
from calstudy.calibrate.execution import run_calibrator
from calstudy.calibrate.joint import JointGroup, orthonormal, place_groups, read_joint_groups
from calstudy.calibrate.problem import FitStructure, gain_products
from calstudy.calibrate.settings import JointBasisSettings
from calstudy.calibrate.solvers.first_order import FirstOrder, Optimizer
from calstudy.calibrate.solvers.gauss_newton import GaussNewton
from calstudy.calibrate.solvers.interface import solve
from calstudy.calibrate.solvers.lbfgs import Lbfgs
from calstudy.calibrate.solvers.reduced import compiled
from calstudy.calibrate.structure import make_structure, repeat_structure


def with_groups(path):
    """The settings of the other tests with joint groups from a file."""
    return SETTINGS.model_copy(update={"joint_basis": JointBasisSettings(path=path)})


def tied(structure, parts):
    """The structure with joint buckets; `parts` are pairs of baselines and vectors."""
    groups = np.empty(structure.n_baselines, int)
    buckets, first = [], 0
    for baselines, vectors in parts:
        members = first + np.arange(len(baselines))
        groups[baselines] = members
        buckets.append(Bucket(None, members, orthonormal(vectors)))
        first += len(baselines)
    basis = ForegroundBasis(tuple(buckets), first, structure.n_frequencies)
    return FitStructure(structure.antennas, structure.n_antennas, basis, groups, structure.conjugated)


def stacked_redundant(structure):
    """The same vectors on all baselines of a redundant group, with common coefficients."""
    parts = []
    for bucket in structure.basis.buckets:
        for model in bucket.members:
            baselines = np.flatnonzero(structure.groups == model)
            parts.append((baselines, np.repeat(bucket.vectors[None], baselines.size, axis=0)))
    return tied(structure, parts)


def own_vectors(structure):
    return [
        bucket.vectors
        for model in range(structure.basis.n_models)
        for bucket in structure.basis.buckets
        if model in bucket.members
    ]


def block_diagonal(structure):
    """Two joint groups whose vectors are each on one baseline only."""
    own, parts = own_vectors(structure), []
    for baselines in np.array_split(np.random.default_rng(5).permutation(structure.n_baselines), 2):
        count = sum(own[p].shape[1] for p in baselines)
        vectors, first = np.zeros((baselines.size, structure.n_frequencies, count)), 0
        for row, p in enumerate(baselines):
            last = first + own[p].shape[1]
            vectors[row, :, first:last] = own[p]
            first = last
        parts.append((baselines, vectors))
    return tied(structure, parts)


def mixtures(structure, baselines, count, seed=4):
    """Vectors that mix the sequences of each baseline at random, (Nmembers, Nfreqs, count)."""
    rng, own = np.random.default_rng(seed), own_vectors(structure)
    return np.stack([own[p] @ rng.standard_normal((own[p].shape[1], count)) for p in baselines])


def joined(structure):
    """Per-baseline modelling, but for a third of the baselines that share a few coefficients."""
    baselines = np.arange(structure.n_baselines)[1::3][::-1]
    vectors = orthonormal(mixtures(structure, baselines, 4 * baselines.size))
    others = np.setdiff1d(np.arange(structure.n_baselines), baselines)
    groups, buckets = np.empty(structure.n_baselines, int), []
    groups[others], groups[baselines] = np.arange(others.size), others.size + np.arange(baselines.size)
    for bucket in structure.basis.buckets:
        members = groups[np.intersect1d(bucket.members, others)]
        if members.size:
            buckets.append(Bucket(bucket.half_width, members, bucket.vectors))
    buckets.insert(1, Bucket(None, groups[baselines], vectors))
    basis = ForegroundBasis(tuple(buckets), structure.n_baselines, structure.n_frequencies)
    return FitStructure(structure.antennas, structure.n_antennas, basis, groups, structure.conjugated)


def drawn(structure, seed=2):
    """Foregrounds with the structure's basis, with smooth spectra falling off towards its last vectors."""
    rng = np.random.default_rng(seed)
    model = np.empty((structure.n_baselines, structure.n_frequencies), complex)
    for bucket in structure.basis.buckets:
        rows = [np.flatnonzero(structure.groups == index) for index in bucket.members]
        count = 1 if bucket.joint else len(rows)
        u = complex_normal(rng, (count, bucket.vectors.shape[-1]))
        for row, found in enumerate(rows):
            spectrum = bucket.vectors[row] @ u[0] if bucket.joint else bucket.vectors @ u[row]
            model[found] = np.where(structure.conjugated[found, None], spectrum.conj(), spectrum)
    return model


@pytest.fixture(scope="module", params=["redundant", "per-baseline"])
def limit(request, toy, hexagon):
    """A problem in the usual structure, and in one of joint groups that means the same."""
    if request.param == "redundant":
        usual = redundant_structure(hexagon)
        data = gain_products(hexagon.gains, usual.antennas) * drawn(usual)
        noise = 1e-3 * complex_normal(np.random.default_rng(6), data.shape)
        return hexagon.problem(usual, visibilities=data + noise), hexagon.problem(
            stacked_redundant(usual), visibilities=data + noise
        )
    return toy.problem(), toy.problem(block_diagonal(toy.structure))


def test_reduced_problem_is_that_of_the_limit(limit):
    rng = np.random.default_rng(3)
    gains = 1 + 0.1 * complex_normal(rng, limit[0].initial_gains.shape)
    eta = pairs.to_pair(complex_normal(rng, gains.shape), tf.float32)
    found = []
    for problem in limit:
        kernels = compiled(problem.structure)
        reduced = kernels.reduce(problem, gains)
        projection = kernels.project(reduced.gains, *reduced.data)
        product = kernels.projector.hessian_product(eta, projection).numpy()
        model = kernels.tensors.unload(projection.model, 1.0)
        found.append((float(projection.loss), model, projection.descent.numpy(), product))
    for usual, joint, tolerance in zip(*found, (1e-9, 1e-9, 1e-9, 1e-4), strict=True):
        assert np.abs(joint - usual).max() < tolerance * np.abs(usual).max()


def test_solution_is_that_of_the_limit(limit):
    usual, joint = (solve(problem, GaussNewton(max_steps=300)) for problem in limit)
    assert usual.record.status == joint.record.status == "converged", (usual.record.message, joint.record.message)
    # Both creep on along nearly degenerate directions of so small an array, where 4 % of the loss are left to go after
    # hundreds of steps; how far they are differs with the preconditioner, and with the rounding of the processor.
    assert joint.record.loss_history[-1] == pytest.approx(usual.record.loss_history[-1], rel=0.04)


@pytest.mark.parametrize(
    ("solver", "count"), [(GaussNewton(), 2), (Lbfgs(), 1), (FirstOrder(Optimizer(max_steps=1)), 1)], ids=repr
)
def test_noiseless_foregrounds_are_recovered(quiet, solver, count):
    structure = repeat_structure(joined(quiet.structure), count)
    assert structure.basis.n_coefficients < 0.9 * count * quiet.basis.n_coefficients
    data = gain_products(quiet.gains, structure.antennas) * drawn(structure)
    # The first-order solver begins with a projection; it would take long from elsewhere.
    start = quiet.gains if isinstance(solver, FirstOrder) else np.ones(quiet.gains.shape, complex)
    weights = np.full(data.shape, 1 / data.size)
    solution = solve(quiet.problem(structure, visibilities=data, weights=weights, initial_gains=start), solver)
    error = gain_products(solution.gains, structure.antennas) * solution.model - data
    assert np.abs(error).max() < 1e-5 * np.sqrt(np.mean(np.abs(data) ** 2))


def groups_of(toy, data):
    """A joint group of some of the data's baselines, two of them the other way round."""
    baselines = np.array([7, 2, 11, 20])
    antennas = antenna_pairs(data)[baselines]
    antennas[:2] = antennas[:2, ::-1]
    return baselines, JointGroup(antennas, mixtures(toy.structure, baselines, 9), "core")


@pytest.fixture
def saved(tmp_path, quiet):
    """Data whose foregrounds are drawn from a joint group and DPSS, the group, and its file."""
    data = make_uvdata(quiet, 1)
    baselines, group = groups_of(quiet, data)
    path = tmp_path / "joint.npz"
    np.savez(path, antennas_core=group.antennas, vectors_core=group.vectors)
    return data, baselines, group, path


def test_a_file_gives_joint_models_and_turned_baselines_are_conjugated(saved):
    data, baselines, _, path = saved
    structure = make_structure(Observation(data), with_groups(path))
    assert np.array_equal(np.flatnonzero(structure.conjugated), np.sort(baselines[:2]))
    joint = [bucket for bucket in structure.basis.buckets if bucket.joint]
    assert [bucket.members.size for bucket in joint] == [4]
    assert structure.basis.n_models == len(structure.antennas)
    redundant = CalamityRedundant(basis=SETTINGS.basis, joint_basis=JointBasisSettings(path=path))
    assert sum(bucket.joint for bucket in make_structure(Observation(data), redundant).basis.buckets) == 1


def test_calibration_with_joint_groups_recovers_foregrounds(quiet, saved):
    data, baselines, group, path = saved
    structure = make_structure(Observation(data), with_groups(path))
    foregrounds = drawn(structure)
    data.data_array[:] = (gain_products(quiet.gains, quiet.antennas) * foregrounds)[:, :, None]
    result = run_calibrator(with_groups(path), data)
    assert result.solutions[0].status == "converged"
    rms = np.sqrt(np.mean(np.abs(foregrounds) ** 2))
    assert np.abs(to_cube(result.residual)).max() < 1e-5 * rms
    # In the terms of the file: what (a, b) of the group sees is spanned by its vectors, with one set of coefficients.
    seen = to_cube(result.model)[0, baselines, :, 0]
    seen[:2] = seen[:2].conj()
    vectors = orthonormal(group.vectors).reshape(seen.size, -1)
    assert np.abs(seen.ravel() - vectors @ (vectors.T @ seen.ravel())).max() < 1e-9 * rms


def test_all_baselines_may_be_joint(toy, tmp_path):
    data = make_uvdata(toy, 1)
    everything = np.arange(len(toy.antennas))
    path = tmp_path / "all.npz"
    np.savez(path, antennas_all=antenna_pairs(data), vectors_all=mixtures(toy.structure, everything, 30))
    structure = make_structure(Observation(data), with_groups(path))
    assert structure.basis.n_coefficients == 30


def test_the_default_is_no_part_of_the_settings(saved):
    assert "joint_basis" not in identity(Calamity())
    assert identity(with_groups(saved[3]))["joint_basis"]["path"].startswith("sha256:")
    with pytest.raises(ValidationError, match="joint_basis"):
        SkyBased(joint_basis={"path": str(saved[3])})


@pytest.mark.parametrize(
    ("antennas", "vectors", "match"),
    [
        ([[10, 12]], np.ones((1, 63, 2)), "vectors have 63 channels, and the data have 64"),
        ([[10, 99]], np.ones((1, 64, 2)), r"baseline \(10, 99\) is not among"),
        ([[10, 12], [12, 10]], np.ones((2, 64, 2)), r"baseline \(12, 10\) is there twice"),
        ([[10, 12]], np.ones((2, 64, 2)), "for 1 baselines"),
        ([[10, 12]], np.ones((1, 64)), r"expected \(1, channels, vectors\)"),
        ([10, 12], np.ones((1, 64, 2)), "expected integers of shape"),
        ([[10.0, 12.0]], np.ones((1, 64, 2)), "expected integers of shape"),
        ([[10, 12]], np.full((1, 64, 2), np.nan), "not finite"),
        ([[10, 12]], np.ones((1, 64, 2), complex), "expected real numbers; the coefficients are complex"),
        ([[10, 12]], np.zeros((1, 64, 2)), "zero everywhere"),
        ([[10, 12]], np.eye(64)[None], "64 independent vectors fill all 64 samples"),
    ],
)
def test_groups_that_do_not_fit_are_one_sentence(toy, antennas, vectors, match):
    pairs_of_data = 10 + 2 * toy.antennas
    with pytest.raises(InputError, match=match) as error:
        place_groups([JointGroup(np.array(antennas), vectors, "core")], pairs_of_data, 64)
    assert "group 'core'" in str(error.value)


def test_a_baseline_in_two_groups_is_refused(toy):
    group = JointGroup(np.array([[10, 12]]), np.ones((1, 64, 2)), "core")
    with pytest.raises(InputError, match="twice, in this group or in another"):
        place_groups([group, group], 10 + 2 * toy.antennas, 64)


@pytest.mark.parametrize(
    ("arrays", "match"),
    [
        ({"antennas_core": np.ones((1, 2), int)}, "both for every group"),
        ({"core": np.ones(3)}, "both for every group"),
        ({}, "holds nothing"),
        ({"antennas_a": np.array([{}]), "vectors_a": np.ones((1, 64, 2))}, "cannot be read"),
    ],
)
def test_other_files_are_one_sentence(tmp_path, arrays, match):
    path = tmp_path / "joint.npz"
    np.savez(path, **arrays)
    with pytest.raises(InputError, match=match):
        read_joint_groups(path)


@pytest.mark.parametrize("content", [b"", b"text", b"PK\x03\x04broken"])
def test_what_is_no_archive_is_one_sentence(tmp_path, content):
    path = tmp_path / "joint.npz"
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"cannot be read as an \.npz file"):
        read_joint_groups(path)
