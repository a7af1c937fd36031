"""Constants of physics, of the calendar and of statistics, without imports."""

HYDROGEN_LINE = 1420405751.768
"""Rest frequency of the 21 cm line, Hz."""
SPEED_OF_LIGHT = 299_792_458.0
"""Speed of light, m/s."""
BOLTZMANN = 1.380649e-23
"""Boltzmann constant, J/K."""
SECONDS_PER_DAY = 86400.0
SIDEREAL_DAY = 0.99726956633
"""Days after which the stars are at the same place."""
SAME_LENGTH = 1e-3
"""Lengths on the ground that differ by at most this, m, are the same but for rounding."""
UNEVEN = 1e-3
"""Channels whose distances differ by at most this part of the mean are equally spaced: files round them."""
SIGMAS_95 = 1.96
"""Half-width of a 95 % interval, in standard deviations."""
