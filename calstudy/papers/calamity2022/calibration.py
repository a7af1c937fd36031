"""Claims on gains, foreground models, their products and single baselines (paper §Simulation Results)."""

from __future__ import annotations

from dataclasses import replace

from calstudy.results.reader import Results
from calstudy.verdicts.criterion import AtLeast, AtMost, Finding, Within
from calstudy.verdicts.statement import Sentence, Source

RESULTS = Source("Simulation Results", ("minimally_redundant",))
SIMULATED = replace(RESULTS, tests_simulation=True)
FACTOR_OF_TWO = "the paper's 'similar', 'about' and 'roughly' are read as within a factor of two"
TWOFOLD = (Within(0.5, 2), FACTOR_OF_TWO)
ORDER_10_PERCENT = (Within(0.05, 0.2), FACTOR_OF_TWO)
ORDER_10_TO_20_PERCENT = (Within(0.05, 0.4), FACTOR_OF_TWO)


def median(run: Results, name: str) -> Finding:
    found = run.measured(name)
    return Finding(found.value, found.scatter, "scatter")


GAINS = Sentence(
    "gains-agree",
    "our fitted gains do not agree particularly well with the true gains, only on the ≲ 20 % level on all delays",
)
GAINS_CAPTION = Sentence("gain-residuals", "their residuals are on the order of 10 %")


@RESULTS.states(
    GAINS, "rms of g - ĝ over rms of g, free of phase and scale that no fit can know; median", AtMost(0.2), "≲ 20 %"
)
def gains_within_20_percent(run: Results) -> Finding:
    return median(run, "gains_aligned")


@RESULTS.states(GAINS, "rms of g - ĝ over rms of g, gains as fitted; median", AtMost(0.2), "≲ 20 %")
def gains_within_20_percent_raw(run: Results) -> Finding:
    return median(run, "gains_raw")


@RESULTS.states(
    GAINS,
    "rms over antennas of the transform of g - ĝ over that of g (Blackman-Harris), free of phase and scale that no fit "
    "can know; median of delays",
    AtMost(0.2),
    "≲ 20 %",
)
def gains_within_20_percent_at_typical_delay(run: Results) -> Finding:
    return median(run, "gains_by_delay")


@RESULTS.states(
    GAINS,
    "rms over antennas of the transform of g - ĝ over that of g, free of phase and scale that no fit can know; at the "
    "worst delay",
    AtMost(0.2),
    "≲ 20 % on all delays",
)
def gains_within_20_percent_at_every_delay(run: Results) -> Finding:
    return median(run, "gains_worst_delay")


@RESULTS.states(GAINS_CAPTION, "rms of g - ĝ over rms of g, free of phase and scale; median", *ORDER_10_PERCENT)
def gains_of_order_10_percent(run: Results) -> Finding:
    return median(run, "gains_aligned")


GAINS_BY_DELAY = Sentence(
    "gain-residuals-by-delay", "even in the delay domain, the residuals are at 10 % at all delays"
)


@RESULTS.states(
    GAINS_BY_DELAY,
    "rms over antennas of the transform of g - ĝ over that of g (Blackman-Harris), gains as fitted; median of delays",
    *ORDER_10_PERCENT,
)
def gains_of_order_10_percent_at_typical_delay(run: Results) -> Finding:
    return median(run, "gains_raw_by_delay")


@RESULTS.states(
    GAINS_BY_DELAY,
    "rms over antennas of the transform of g - ĝ over that of g (Blackman-Harris), gains as fitted; at the worst delay",
    *ORDER_10_PERCENT,
)
def gains_of_order_10_percent_at_every_delay(run: Results) -> Finding:
    return median(run, "gains_raw_worst_delay")


@RESULTS.states(
    GAINS_BY_DELAY,
    "rms over antennas of the transform of g - ĝ over that of g (Blackman-Harris), free of phase and scale that no fit "
    "can know; median of delays",
    *ORDER_10_PERCENT,
)
def gains_of_order_10_percent_at_typical_delay_aligned(run: Results) -> Finding:
    return median(run, "gains_by_delay")


@RESULTS.states(GAINS_CAPTION, "rms of g - ĝ over rms of g, gains as fitted; median", *ORDER_10_PERCENT)
def gains_of_order_10_percent_raw(run: Results) -> Finding:
    return median(run, "gains_raw")


MODEL = Sentence(
    "model-residual",
    "the residual is on the order of ≈ 10-20 % and significantly exceeds the level of the thermal noise",
)


@RESULTS.states(MODEL, "rms of F - F̂ over rms of F, on the scale of the true gains; median", *ORDER_10_TO_20_PERCENT)
def model_of_order_10_to_20_percent(run: Results) -> Finding:
    return median(run, "model_aligned")


@RESULTS.states(MODEL, "rms of F - F̂ over rms of F, model as fitted; median", *ORDER_10_TO_20_PERCENT)
def model_of_order_10_to_20_percent_raw(run: Results) -> Finding:
    return median(run, "model_raw")


@RESULTS.states(MODEL, "rms of F - F̂ over rms of N; median", AtLeast(2), "more than 'similar', a factor of two")
def model_error_exceeds_noise(run: Results) -> Finding:
    return median(run, "model_over_noise")


PRODUCT = Sentence(
    "visibility-model",
    "while fitted gains and foregrounds alone only agree at the 10 % level, our visibility model is accurate at the "
    "0.1 % level and at a similar level to the thermal noise at all delays",
)


@RESULTS.states(
    "the products of the gains and foregrounds are identical to within the uncertainties from thermal noise",
    "rms of V - ĝĝ*F̂ over rms of the noise in V; median",
    *TWOFOLD,
)
def product_at_noise(run: Results) -> Finding:
    return median(run, "product_over_noise")


@RESULTS.states(
    PRODUCT, "rms of V - ĝĝ*F̂ over that of the noise, at the worst delay", AtMost(2), "at all delays; " + FACTOR_OF_TWO
)
def product_at_noise_at_every_delay(run: Results) -> Finding:
    return median(run, "product_worst_delay")


@RESULTS.states(PRODUCT, "rms of V - ĝĝ*F̂ over rms of V; median", AtMost(0.002), "0.1 %; " + FACTOR_OF_TWO)
def product_at_tenth_of_percent(run: Results) -> Finding:
    return median(run, "product_over_data")


@RESULTS.states(
    PRODUCT,
    "relative error of the gains over that of the product",
    Within(10**1.5, 10**2.5),
    "10 % over 0.1 % is a hundred, to half an order of magnitude",
)
def product_far_better_than_gains(run: Results) -> Finding:
    gains, product = run.measured("gains_aligned"), run.measured("product_over_data")
    ratio = gains.value / product.value
    return Finding(ratio, ratio * product.scatter / product.value, "scatter")


@RESULTS.states(
    "the gain correction ratio is smooth at the level of the thermal noise fluctuations",
    "rms beyond the wedge of g_a g_b*/(ĝ_a ĝ_b*) - 1 over that of N / rms(F); median",
    AtMost(2),
    FACTOR_OF_TWO,
)
def correction_is_smooth(run: Results) -> Finding:
    return median(run, "correction_over_noise_outside")


@RESULTS.states(
    "outside of the wedge, the RMS amplitudes of our calibrated residuals are reasonably consistent with thermal noise",
    "rms over time of R over that of N, delays outside the wedge; median",
    *TWOFOLD,
)
def residual_at_noise_outside_wedge(run: Results) -> Finding:
    return median(run, "residual_over_noise_outside")


@RESULTS.states(
    "there is a noticeable reduction in amplitude inside of the wedge",
    "rms over time of R over that of N, delays inside the wedge; median",
    AtMost(1, 2),
    "a reduction is noticeable if it exceeds twice the scatter over baselines",
)
def residual_reduced_inside_wedge(run: Results) -> Finding:
    return median(run, "residual_over_noise_inside")


@RESULTS.states(
    "R̃ is orders of magnitude lower than the injected gain features",
    "rms over time of V over that of R, delays outside the wedge; median",
    AtLeast(100),
    "orders of magnitude are two at least",
)
def residual_far_below_gain_features(run: Results) -> Finding:
    return median(run, "data_over_residual_outside")
