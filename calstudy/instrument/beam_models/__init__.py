"""The beams of antennas: formulas and tables."""
