"""The calibrator: foregrounds modelled by DPSS, gains without restriction (paper §Method)."""
