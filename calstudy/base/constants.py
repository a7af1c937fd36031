"""Constants of nature that light modules need too."""

HYDROGEN_LINE = 1420405751.768
"""Rest frequency of the 21 cm line, in Hz."""
SPEED_OF_LIGHT = 299_792_458.0
"""m/s."""
BOLTZMANN = 1.380649e-23
"""J/K."""
