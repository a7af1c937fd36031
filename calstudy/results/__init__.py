"""Results of finished runs: the folder of a run, and the one reader of spectra, T, scores and the other tables."""
