"""The beams of antennas, one in each module."""
