"""One Adamax step in the form of the paper's own code.

All baselines share one basis tensor padded with zeros to the widest (Nvec, Nbls, 1, Nfreqs); the model is a broadcast
product summed over the first axis; real and imaginary parts are separate; the optimizer is Keras' Adamax; single
precision. The step is one TensorFlow graph, written from the paper's equations and description. It takes as long as the
loss function of the authors' code with the same optimizer (benchmarks/README.md).
"""

from __future__ import annotations

import numpy as np

from calstudy.base.tensorflow import tf
from calstudy.calibrate.problem import CalibrationProblem

LEARNING_RATE = 0.01


class PaperStep:
    """The unknowns of one problem with a foreground model for every baseline, and the graph of a step.

    The start is at unity gains and at the foregrounds of an unweighted least-squares fit.
    """

    def __init__(self, problem: CalibrationProblem) -> None:
        structure = problem.structure
        buckets = structure.basis.buckets
        widest = max(bucket.vectors.shape[1] for bucket in buckets)
        basis = np.zeros((widest, structure.n_baselines, structure.n_frequencies))
        for bucket in buckets:
            basis[: bucket.vectors.shape[1], bucket.members] = bucket.vectors.T[:, None]
        scale = np.sqrt(np.mean(np.abs(problem.visibilities) ** 2))
        data = problem.visibilities / scale
        coefficients = np.einsum("kbf,bf->kb", basis, data)[:, :, None, None]
        self._basis = tf.constant(basis[:, :, None], tf.float32)
        self._first = tf.constant(structure.antennas[:, :1], tf.int32)
        self._second = tf.constant(structure.antennas[:, 1:], tf.int32)
        self._data = [tf.constant(part[:, None], tf.float32) for part in (data.real, data.imag)]
        self._weights = tf.constant(problem.weights[:, None], tf.float32)
        self._target = [tf.reduce_sum(part * self._weights) for part in self._data]
        shape = (structure.n_antennas, structure.n_frequencies)
        start = (np.ones(shape), np.zeros(shape), coefficients.real, coefficients.imag)
        self.variables = [tf.Variable(values, dtype=tf.float32) for values in start]
        self._optimizer = tf.keras.optimizers.Adamax(LEARNING_RATE)
        self._optimizer.build(self.variables)
        self.step = tf.function(self._step)
        self.model_sum = tf.function(self._model_sum)

    @property
    def basis_bytes(self) -> int:
        """Size of the padded basis, the paper's A."""
        return 4 * int(tf.size(self._basis))

    def _model_sum(self) -> tuple[tf.Tensor, ...]:
        """Compute the sum over the basis alone, sum u A, and its gradient: the dominant part of a step in the paper."""
        with tf.GradientTape() as tape:
            parts = [tf.reduce_sum(u * self._basis, axis=0) for u in self.variables[2:]]
        return tuple(tape.gradient(parts, self.variables[2:], output_gradients=self._data))

    def _step(self) -> tf.Tensor:
        """Take one step, and return the loss before it."""
        with tf.GradientTape() as tape:
            loss = self._loss()
        gradients = tape.gradient(loss, self.variables)
        self._optimizer.apply_gradients(zip(gradients, self.variables, strict=True))
        return loss

    def _loss(self) -> tf.Tensor:
        """Compute the loss, paper Eq. LOGLIKELIHOOD with the prior on the summed model."""
        real, imaginary, u_real, u_imaginary = self.variables
        a_real, a_imaginary = tf.gather(real, self._first), tf.gather(imaginary, self._first)
        b_real, b_imaginary = tf.gather(real, self._second), tf.gather(imaginary, self._second)
        f_real = tf.reduce_sum(u_real * self._basis, axis=0)
        f_imaginary = tf.reduce_sum(u_imaginary * self._basis, axis=0)
        product_real = a_real * b_real + a_imaginary * b_imaginary
        product_imaginary = a_imaginary * b_real - a_real * b_imaginary
        model_real = product_real * f_real - product_imaginary * f_imaginary
        model_imaginary = product_imaginary * f_real + product_real * f_imaginary
        misfit = tf.square(self._data[0] - model_real) + tf.square(self._data[1] - model_imaginary)
        prior = tf.square(tf.reduce_sum(f_real * self._weights) - self._target[0])
        prior += tf.square(tf.reduce_sum(f_imaginary * self._weights) - self._target[1])
        return tf.reduce_sum(misfit * self._weights) + prior
